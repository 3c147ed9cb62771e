"""Links of several transmitters to common receivers: noise, SINR and the bound of Shannon on the throughput.

All functions are pure. Powers are in dBm and have transmitters along their last axis; leading axes are those of receivers,
frequencies or places. Definitions are those of Sionna RT's `RadioMap`: the received power of the strongest transmitter is its
`rss`, and the SINR its `sinr`, with the noise of a temperature and a bandwidth.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax._util.checks import concrete
from wbgs_jax.radio.array import EXACT

BOLTZMANN = 1.380649e-23
"""Joules per kelvin."""


def noise_dbm(
    bandwidth_hz: Float[Array, "*b"] | float,
    noise_figure_db: Float[Array, "*b"] | float = 0.0,
    temperature_k: Float[Array, "*b"] | float = 293.0,
) -> Float[Array, "*b"]:
    """Returns the noise power k T B of a receiver, raised by its noise figure.

    Args:
        bandwidth_hz: bandwidth B.
        noise_figure_db: of the receiver.
        temperature_k: temperature T; the default is that of Sionna RT.

    Returns:
        dBm (*b,).

    Raises:
        ValueError: a negative bandwidth.

    Example:
        >>> round(float(noise_dbm(100e6, 7.0, 290.0)), 1)
        -87.0
    """
    _check_bandwidth(bandwidth_hz)
    return 10 * jnp.log10(jnp.asarray(bandwidth_hz, float) * temperature_k) + 10 * jnp.log10(BOLTZMANN * 1e3) + noise_figure_db


def sinr_db(
    received_dbm: Any,
    noise_dbm: Float[Array, "*#b"] | float,
    load: Any = 1.0,
) -> Float[Array, "*b tx"]:
    """Returns the signal-to-interference-and-noise ratio of a receiver that is served by each of the transmitters, while all
    others interfere.

    Args:
        received_dbm: (*b, tx), power received from every transmitter.
        noise_dbm: power of the noise (`noise_dbm`).
        load: (tx,) or one, mean activity of the transmitters as interferers, 0 to 1.

    Returns:
        Decibels (*b, tx), minus infinity where nothing is received. The best server is `jnp.argmax(received_dbm, -1)`.

    Raises:
        ValueError: a load is not within 0 to 1.

    Example:
        >>> import jax.numpy as jnp
        >>> [round(float(ratio), 2) for ratio in sinr_db(jnp.array([-60.0, -60.0]), -60.0)]  # twice the power interferes
        [-3.01, -3.01]
    """
    received_dbm, load = jnp.asarray(received_dbm), jnp.asarray(load)
    known = concrete(load)
    if known is not None and not np.all((known >= 0) & (known <= 1)):
        raise ValueError(f"load is {known}; activities are from 0 to 1")
    # Relative to the strongest, so that squares of faint amplitudes do not underflow; of the others only, since the difference
    # of a sum and its largest term is lost in rounding.
    strongest = jnp.max(received_dbm, -1, keepdims=True)
    strongest = jnp.where(strongest > -jnp.inf, strongest, 0)
    power = 10 ** ((received_dbm - strongest) / 10)
    others = jnp.broadcast_to(load, received_dbm.shape[-1:])[:, None] * (1 - jnp.eye(received_dbm.shape[-1]))
    interference = jnp.matmul(power, others, precision=EXACT)
    noise = 10 ** ((jnp.asarray(noise_dbm)[..., None] - strongest) / 10)
    return received_dbm - strongest - 10 * jnp.log10(interference + noise)


def throughput_bps(sinr_db: Any, bandwidth_hz: Float[Array, "*b"] | float) -> Float[Array, "*b"]:
    """Returns the largest rate without errors, B log2(1 + SINR) (Shannon 1948).

    Args:
        sinr_db: (*b,), signal-to-interference-and-noise ratio, decibels.
        bandwidth_hz: bandwidth B.

    Returns:
        Bits per second (*b,).

    Raises:
        ValueError: a negative bandwidth.

    Example:
        >>> round(float(throughput_bps(jnp.array(0.0), 100e6)) / 1e6)
        100
    """
    _check_bandwidth(bandwidth_hz)
    return bandwidth_hz * jnp.log1p(10 ** (jnp.asarray(sinr_db) / 10)) / jnp.log(2)


def _check_bandwidth(bandwidth_hz: Any) -> None:
    known = concrete(bandwidth_hz)
    if known is not None and not np.all(known >= 0):
        raise ValueError(f"bandwidth_hz is {known}; bandwidths are in hertz and not negative")
