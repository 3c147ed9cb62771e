"""Orientation of a receiver's directive elements for the best reception of its transmitters.

The arriving waves do not depend on the orientation of the receiver; the response of its directive elements does. The waves are
therefore predicted once by a trained field, and the response is a closed-form, differentiable function of the orientation.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.applications.antenna_placement import soft_minimum
from wbgs_jax.applications.multistart import Descended, best_apart, descend, grid_over, in_blocks, shrinking
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params, outputs_of, paths_of
from wbgs_jax.fields.calibratable import at_isotropic_antennas
from wbgs_jax.radio.antenna import Antenna, pattern_exponents, zenith_vector
from wbgs_jax.radio.array import squared_magnitude
from wbgs_jax.radio.channel import Paths, decibels
from wbgs_jax.types import make_query, make_receiver

PowerByBoresight = Callable[[Float[Array, "k 2"]], Float[Array, "k tx"]]
"""Azimuth and elevation of the boresight (radians, world frame) -> power (dB) from every transmitter."""
STEP = 0.3
"""Spacing of the directions that are tried first, radians."""
FINEST = 0.01
"""Size of the last steps, radians."""
STEPS = 40
HIGHEST = 1.55
"""Largest elevation, radians."""


def boresight_quaternion(angles: Any) -> Float[Array, "*b 4"]:
    """Returns the quaternion (wxyz) of a receiver whose +x, the boresight of directive elements, has this azimuth and elevation
    (radians, world frame) and whose y axis stays horizontal.

    Args:
        angles: (*b, 2), azimuth and elevation, radians.

    Returns:
        Unit quaternions (*b, 4), for `make_receiver(orientation=...)`.

    Raises:
        ValueError: the last axis is not azimuth and elevation.
    """
    half = jnp.asarray(angles) / 2
    if half.shape[-1:] != (2,):
        raise ValueError(f"angles have shape {half.shape}; pass (..., 2), azimuth and elevation in radians")
    (ca, ce), (sa, se) = (jnp.moveaxis(part, -1, 0) for part in (jnp.cos(half), jnp.sin(half)))
    return jnp.stack([ca * ce, sa * se, -ca * se, sa * ce], -1)


def predict_isotropic_paths(field: Field, params: Params, receiver: Any, transmitters: Any, frequency_hz: float) -> Paths:
    """Returns the waves that reach an isotropic element from n transmitters over all paths; its local frame is the world frame.

    Args:
        field, params: a trained field that predicts paths, of which the receiver-independent part is used
            (`Field.receiver_independent`).
        receiver: (3,), world frame, metres.
        transmitters: (n, 3), world frame, metres.
        frequency_hz: hertz.

    Returns:
        `wbgs_jax.Paths` with arrays (n, k, ...).

    Raises:
        UserError: the field predicts no paths, or only at the receivers it was trained for.
    """
    if "paths" not in outputs_of(field):
        raise UserError(f"the {field.name} field predicts no paths; train the default one on data with a mesh")
    field, params = at_isotropic_antennas(field, params)
    plan = field.plan(params, make_receiver(receiver, element_positions=np.zeros((1, 3))))
    places = jnp.atleast_2d(jnp.asarray(transmitters, jnp.float32))
    return paths_of(field, params, plan, make_query(places, frequency_hz))


def power_when_rotated(arrived: Paths, pattern: str = "tr38901") -> PowerByBoresight:
    """Returns a function for the mean received power over all elements (dB) in terms of the boresight; differentiable.

    The powers of all paths are added, as in a mean over positions around the receiver: interference should not determine the
    orientation.

    Args:
        arrived: at isotropic elements in the world frame, with a leading axis of transmitters (`predict_isotropic_paths`).
        pattern: of the elements: "tr38901", "dipole", "hw_dipole", or "iso", for which the orientation affects only the
            polarisation.

    Returns:
        The function: boresights (k, 2), azimuth and elevation in radians -> powers (k, tx), dB.
    """
    assert arrived.polarised is not None, "arrivals of traced paths have polarised amplitudes"
    direction, amplitude = arrived.direction, arrived.polarised
    along_theta = zenith_vector(direction)
    vector = amplitude[..., :1] * along_theta + amplitude[..., 1:] * jnp.cross(direction, along_theta)
    exponents = jnp.array(pattern_exponents(pattern), jnp.float32)

    def one(angles: Float[Array, "2"]) -> Float[Array, " tx"]:
        pattern_field = Antenna(boresight_quaternion(angles), exponents).field(direction)
        return decibels(jnp.sum(squared_magnitude(jnp.sum(vector * pattern_field, -1)), -1))

    return jax.vmap(one)


def rotate_array(
    powers: PowerByBoresight, aim: Callable[[Float[Array, "k tx"]], Float[Array, " k"]] = soft_minimum, starts: int = 4
) -> Descended:
    """Returns the best boresights: `place` (starts, 2), azimuth and elevation in radians, the best one first, and `loss`, minus
    the objective (dB).

    The best directions of a grid over the sphere that are not close together are refined by gradient steps.

    Args:
        powers: of the transmitters by boresight, from `power_when_rotated` or any similar function.
        aim: objective to maximise, as in `place_antenna`.
        starts: number of starting directions of the gradient steps.

    Returns:
        `place` (starts, 2), radians, and `loss` (starts,), dB.
    """
    sphere = np.array([[-np.pi, -HIGHEST], [np.pi, HIGHEST]])
    tried = jnp.asarray(grid_over(sphere, STEP))
    low_high = jnp.array([[-2 * np.pi, -HIGHEST], [2 * np.pi, HIGHEST]])  # azimuths may pass +-pi

    def loss(angles: Float[Array, "k 2"], blur: Any) -> Float[Array, " k"]:
        return -aim(powers(angles))

    @jax.jit
    def search(tried: Float[Array, "n 2"]) -> Descended:
        losses = in_blocks(lambda block: loss(block, 0.0), tried)
        chosen = best_apart(tried, losses, min(starts, len(tried)), 1.5 * STEP)
        return descend(loss, tried[chosen], low_high, shrinking(STEP / 2, FINEST, STEPS))

    found = search(tried)
    azimuth = jnp.mod(found.place[:, 0] + np.pi, 2 * np.pi) - np.pi
    return Descended(found.place.at[:, 0].set(azimuth), found.loss)
