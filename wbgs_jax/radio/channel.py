"""Channel quantities: received power, beamforming gain, K-factor, delay and angular spread, and correlation of snapshots.

All functions are pure. A `snapshot` holds the complex voltages of the receiver's elements, `Paths` the amplitudes and
geometry of all paths. Leading axes are batch axes.

Links of several transmitters to common receivers have noise, SINR and the bound of Shannon on the throughput. Their powers are
in dBm, with transmitters along the last axis; leading axes are those of receivers, frequencies or places. Definitions are those
of Sionna RT's `RadioMap`: the received power of the strongest transmitter is its `rss`, and the SINR its `sinr`, with the noise
of a temperature and a bandwidth.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from wbgs_jax._util.checks import concrete
from wbgs_jax.radio.antenna import off_the_axis
from wbgs_jax.radio.array import EXACT, SPEED_OF_LIGHT, squared_magnitude, steering_vector, wide_covariance_to_pas


class Paths(NamedTuple):
    """Amplitudes and geometry of K paths at a receiver.

    `cir`, `cfr` and `taps` are the impulse response, the frequency response and the taps of the channel from the transmitter to
    an element at the array's centre, with the definitions of Sionna RT's `Paths` and for one instant.
    """

    amplitude: Complex[Array, "*b k"]
    """Complex amplitude at the array's centre, including the carrier phase; 0 for padding."""
    direction: Float[Array, "*b k 3"]
    """Unit vectors in the receiver's frame, towards the direction of arrival."""
    length: Float[Array, "*b k"]
    """Length of the whole path, metres."""
    departure: Float[Array, "*b k 3"] | None = None
    """Unit vectors in the world frame in which the wave leaves the transmitter."""
    arrival: Float[Array, "*b k 3"] | None = None
    """Unit vectors in the world frame in which the wave travels on arrival."""
    polarised: Complex[Array, "*b k 2"] | None = None
    """Amplitudes at isotropic elements polarised along theta-hat and along phi-hat of the receiver's frame."""
    interaction: Int[Array, "*b k 5"] | None = None
    """Types of interaction in order: `propagation.paths.InteractionType`; 0 beyond the last."""
    material: Int[Array, "*b k 5"] | None = None
    """Index of the material at each interaction; -1 beyond the last."""
    spherical_wave: Float[Array, "*b"] | None = None
    """1 for spherical waves at the array, 0 for plane waves (`propagation.transport.element_voltages`)."""
    points: Float[Array, "*b k 5 3"] | None = None
    """Transmitter, points of reflection or diffraction, receiver; the receiver fills the rest. World frame, metres."""

    def cir(self, normalize_delays: bool = True) -> tuple[Complex[Array, "*b k"], Float[Array, "*b k"]]:
        """Returns the impulse response: sum over k of a_k delta(t - tau_k), in complex baseband around the carrier.

        Args:
            normalize_delays: whether the delays of every link are counted from its first path.

        Returns:
            Amplitudes a (*b, k), with the phase of the carrier at every path's full length, and 0 for padding; delays tau
            (*b, k), seconds, and -1 for padding.
        """
        amplitude = jnp.asarray(self.amplitude)
        valid, tau = amplitude != 0, jnp.asarray(self.length) / SPEED_OF_LIGHT
        if normalize_delays:
            first = jnp.min(jnp.where(valid, tau, jnp.inf), -1, keepdims=True, initial=jnp.inf)
            tau = tau - jnp.where(jnp.isfinite(first), first, 0)
        return amplitude, jnp.where(valid, tau, -1)

    def cfr(self, frequencies_hz: Any, normalize_delays: bool = True, normalize: bool = False) -> Complex[Array, "*b f"]:
        """Returns the frequency response in complex baseband: sum over k of a_k exp(-2 pi j f tau_k).

        The amplitudes are those at the carrier: over a band in which materials change, query the field at every frequency.

        Args:
            frequencies_hz: (f,) or one, relative to the carrier, such as those of OFDM subcarriers.
            normalize_delays: whether the delays of every link are counted from its first path.
            normalize: whether the mean of |H|^2 over the frequencies is 1 for every link (links without paths stay 0).

        Returns:
            H (*b, f), relative to the transmitted amplitude unless it is normalised.

        Example:
            >>> import jax.numpy as jnp, wbgs_jax as wb
            >>> one = wb.Paths(jnp.array([1.0 + 0j, 0.5]), jnp.zeros((2, 3)), jnp.array([3.0, 3.0 + 299.792458]))
            >>> [round(float(abs(h)), 3) for h in one.cfr(jnp.array([0.0, 0.5e6]))]  # one path is a microsecond later
            [1.5, 0.5]
        """
        a, tau = self.cir(normalize_delays)
        cycles = jnp.atleast_1d(jnp.asarray(frequencies_hz, tau.dtype))[:, None] * tau[..., None, :]
        response = jnp.sum(a[..., None, :] * jnp.exp(-2j * jnp.pi * (cycles - jnp.round(cycles))), -1)
        return _with_energy(response, response.shape[-1]) if normalize else response

    def taps(
        self,
        bandwidth_hz: float,
        l_min: int = -6,
        l_max: int | None = None,
        normalize_delays: bool = True,
        normalize: bool = False,
    ) -> Complex[Array, "*b taps"]:
        """Returns the taps of the channel sampled at the bandwidth, by sinc interpolation: h_l = sum over k of
        a_k sinc(l - W tau_k).

        Args:
            bandwidth_hz: bandwidth W; taps are 1 / W apart.
            l_min: index of the first tap; negative, because a sinc begins before its path arrives.
            l_max: index of the last tap; by default 6 taps after the last path, which is not possible under `jax.jit`.
            normalize_delays: whether the delays of every link are counted from its first path.
            normalize: whether the sum of |h_l|^2 is 1 for every link (links without paths stay 0).

        Returns:
            h (*b, l_max - l_min + 1), relative to the transmitted amplitude unless it is normalised.

        Example:
            >>> import jax.numpy as jnp, wbgs_jax as wb
            >>> one = wb.Paths(jnp.array([1.0 + 0j, 0.5]), jnp.zeros((2, 3)), jnp.array([3.0, 3.0 + 299.792458]))
            >>> [round(float(abs(h)), 3) for h in one.taps(2e6, l_min=0, l_max=3)]  # one path is two samples later
            [1.0, 0.0, 0.5, 0.0]
        """
        a, tau = self.cir(normalize_delays)
        last = int(np.ceil(bandwidth_hz * float(jnp.max(tau, initial=0)))) + 6 if l_max is None else l_max
        index = jnp.arange(l_min, last + 1, dtype=tau.dtype)
        taps = jnp.sum(a[..., None, :] * jnp.sinc(index[:, None] - bandwidth_hz * tau[..., None, :]), -1)
        return _with_energy(taps, 1) if normalize else taps


def _with_energy(values: Complex[Array, "*b n"], energy: int) -> Complex[Array, "*b n"]:
    """Returns values scaled so that their squared magnitudes sum to `energy` along the last axis; zeros stay zeros."""
    strongest = jnp.max(jnp.abs(values), -1, keepdims=True)
    relative = values / jnp.where(strongest > 0, strongest, 1)  # squares of faint amplitudes would underflow
    total = jnp.sum(squared_magnitude(relative), -1, keepdims=True)
    return relative * jnp.sqrt(energy / jnp.where(total > 0, total, 1))


FAINTEST = 1e-30
"""Amplitude that counts as zero; its square would underflow in single precision."""
SMALLEST = 1e-30
"""Power that counts as zero, so that decibels stay finite."""
NO_PATH_DB = -250.0
"""Received powers at or below this value (dB) mean that no path was found; they do not measure a weak one."""


def decibels(power: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Returns 10 log10 of powers."""
    return 10 * jnp.log10(jnp.maximum(power, SMALLEST))


def received_power_db(snapshot: Any) -> Float[Array, "*b"]:
    """Returns the mean received power per element relative to the transmitted power (dB), the negative path loss.

    Args:
        snapshot: (*b, elements), complex voltages of the elements, relative to the transmitted amplitude.

    Returns:
        Decibels (*b,).
    """
    return decibels(jnp.mean(squared_magnitude(jnp.asarray(snapshot)), -1))


def free_space_db(distance: Any, frequency_hz: Float[Array, "*b"] | float) -> Float[Array, "*b"]:
    """Returns the power received by an isotropic element over a free line of sight, relative to the transmitted power (dB;
    Friis).

    Args:
        distance: (*b,), metres.
        frequency_hz: of the carrier.

    Returns:
        Decibels (*b,), negative beyond a tenth of a wavelength; infinite at distance 0.

    Example:
        >>> round(float(free_space_db(jnp.array(10.0), jnp.array(2.4e9))), 1)
        -60.1
    """
    return 20 * jnp.log10(SPEED_OF_LIGHT / (4 * jnp.pi * frequency_hz * jnp.asarray(distance)))


def beyond_free_space_db(
    power_db: Float[Array, "*b"],
    tx_position: Float[Array, "*b 3"],
    rx_position: Float[Array, "*rx 3"],
    frequency_hz: Float[Array, "*b"],
) -> Float[Array, "*b"]:
    """Returns received powers relative to those of a free line of sight (dB), a measure of how deeply a link is shadowed.

    Args:
        power_db: relative to the transmitted power.
        tx_position, rx_position: world frame, metres.
        frequency_hz: of the carrier.
    """
    distance = jnp.sqrt(jnp.sum((tx_position - rx_position) ** 2, -1) + 1e-4)
    return power_db - free_space_db(distance, frequency_hz)


def beamforming_gain_db(snapshot: Complex[Array, "*b elements"], peak: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Returns the power of the best conventional beam relative to one element (dB), at most 10 log10 of the number of elements.

    Args:
        snapshot: complex voltages of the elements.
        peak: largest |a^H y| over all directions.
    """
    strongest = jax.lax.stop_gradient(jnp.max(jnp.abs(snapshot), -1))
    strongest = jnp.where(strongest > 0, strongest, 1)
    mean = jnp.mean(squared_magnitude(snapshot / strongest[..., None]), -1)  # relative: no underflow
    return decibels((peak / strongest) ** 2 / snapshot.shape[-1] / jnp.maximum(mean, SMALLEST))


def k_factor_db(arrivals: Paths) -> Float[Array, "*b"]:
    """Returns the Rician K-factor: the power of the strongest path over that of all others (dB).

    Args:
        arrivals: paths.

    Returns:
        Decibels (*b,); infinite with a single path, NaN without any.
    """
    power, _ = _shares(arrivals.amplitude)
    power = jnp.pad(power, [(0, 0)] * (power.ndim - 1) + [(0, 1)])  # one without power: of no paths none is the strongest
    strongest, largest = jnp.max(power, -1), jnp.argmax(power, -1, keepdims=True)
    others = jnp.sum(jnp.where(jnp.arange(power.shape[-1]) == largest, 0, power), -1)
    several = others > 0
    ratio = decibels(strongest / jnp.where(several, others, 1))
    return jnp.where(several, ratio, jnp.where(strongest > 0, jnp.inf, jnp.nan))


def delay_spread_s(arrivals: Paths) -> Float[Array, "*b"]:
    """Returns the power-weighted r.m.s. delay spread (seconds).

    Args:
        arrivals: paths.

    Returns:
        Seconds (*b,); 0 with a single path, NaN without any.
    """
    weight, received = _shares(arrivals.amplitude)
    delay = arrivals.length / SPEED_OF_LIGHT
    mean = jnp.sum(weight * delay, -1, keepdims=True)
    variance = jnp.sum(weight * (delay - mean) ** 2, -1)
    return jnp.where(received, _root(variance), jnp.nan)


def angular_spread_deg(arrivals: Paths) -> Float[Array, "*b 2"]:
    """Returns the power-weighted circular spreads of azimuth and zenith of arrival (in this order) in the receiver's frame,
    degrees (3GPP TR 38.901, annex A).

    Args:
        arrivals: paths.

    Returns:
        Azimuth and zenith spread (*b, 2), degrees; NaN without any path.
    """
    weight, received = _shares(arrivals.amplitude)
    x, y, z = jnp.moveaxis(off_the_axis(arrivals.direction), -1, 0)
    level = jnp.sqrt(x * x + y * y)
    unit = jnp.stack([jnp.stack([x / level, y / level], -1), jnp.stack([z, level], -1)], -3)  # (*b, 2, k, 2)
    mean = jnp.sum(weight[..., None, :, None] * unit, -2)
    length = jnp.maximum(jnp.sum(mean**2, -1), SMALLEST)
    spread = jnp.where(length < 1, jnp.degrees(jnp.sqrt(-jnp.log(jnp.where(length < 1, length, 0.5)))), 0)
    return jnp.where(received[..., None], spread, jnp.nan)


def _shares(amplitude: Any) -> tuple[Float[Array, "*b k"], Bool[Array, "*b"]]:
    """Returns the shares of paths in the power of their link, which add up to 1, and whether there are any paths."""
    strongest = jax.lax.stop_gradient(jnp.max(jnp.abs(jnp.asarray(amplitude)), -1, keepdims=True, initial=0))
    power = squared_magnitude(amplitude / jnp.where(strongest > 0, strongest, 1))  # those of faint amplitudes would underflow
    total = jnp.sum(power, -1, keepdims=True)
    return power / jnp.where(total > 0, total, 1), total[..., 0] > 0


def _root(power: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Returns the square root, with gradient 0 at 0."""
    return jnp.where(power > 0, jnp.sqrt(jnp.where(power > 0, power, 1)), 0)


def doppler_hz(
    arrivals: Paths, frequency_hz: Float[Array, ""], tx_velocity: Float[Array, "3"], rx_velocity: Float[Array, "3"]
) -> Float[Array, "*b k"]:
    """Returns the Doppler shifts of all paths (hertz).

    Args:
        arrivals: of traced paths, with directions of departure and arrival.
        frequency_hz: of the carrier.
        tx_velocity, rx_velocity: metres per second, world frame.

    Returns:
        Hertz (*b, k), positive if the path gets shorter.

    Raises:
        ValueError: more than one frequency or velocity of an end; use `jax.vmap` for several.
    """
    ends = ("frequency_hz", frequency_hz, ()), ("tx_velocity", tx_velocity, (3,)), ("rx_velocity", rx_velocity, (3,))
    for name, value, shape in ends:
        if jnp.shape(value) != shape:
            raise ValueError(f"{name} has shape {jnp.shape(value)}; expected {shape}, and use jax.vmap for several")
    assert arrivals.departure is not None and arrivals.arrival is not None, (
        "only arrivals of traced paths have these directions"
    )
    along_departure = jnp.sum(arrivals.departure * tx_velocity, -1)
    return frequency_hz / SPEED_OF_LIGHT * (along_departure - jnp.sum(arrivals.arrival * rx_velocity, -1))


def unit_snapshots(
    snapshots: Complex[Array, "*b elements"],
) -> tuple[Complex[Array, "*b elements"], Float[Array, "*b 1"]]:
    """Returns snapshots scaled to norm 1 (zero snapshots stay zero) and their norms."""
    norm = _root(jnp.sum(squared_magnitude(snapshots), -1, keepdims=True))
    return snapshots / jnp.where(norm > 0, norm, 1), norm


def correlation(a: Any, b: Any) -> Float[Array, "*b"]:
    """Returns |a^H b| / (|a| |b|): 1 for snapshots that are equal up to a common phase and scale; 0 for a zero snapshot.

    Args:
        a, b: (*b, elements), complex voltages of the same elements.

    Returns:
        Values (*b,) from 0 to 1.
    """
    # Computed from unit vectors: the squared product of weak snapshots would underflow in single precision.
    (unit_a, _), (unit_b, _) = (unit_snapshots(jnp.asarray(one)) for one in (a, b))
    return _root(squared_magnitude(jnp.sum(unit_a.conj() * unit_b, -1)))


def added_powers(arrivals: Paths, elements: Float[Array, "elements 3"]) -> Float[Array, "90 360"]:
    """Returns the spectrum, scaled to a maximum of 1, that an array measures of one transmitter if the powers of its paths are
    added instead of their amplitudes. Element positions are in wavelengths."""
    strongest = jax.lax.stop_gradient(jnp.max(jnp.abs(arrivals.amplitude)))
    power = squared_magnitude(arrivals.amplitude / jnp.where(strongest > FAINTEST, strongest, 1))  # relative: no underflow
    steering = steering_vector(elements, arrivals.direction)
    weighted = steering * (power / jnp.maximum(jnp.sum(power), FAINTEST**0.5))[:, None]
    covariance = jnp.matmul(steering.T, weighted.conj(), precision=EXACT)
    return wide_covariance_to_pas(covariance[None], elements[None])[0]


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
