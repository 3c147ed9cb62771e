"""Which way to turn a receiver's elements so that they hear their transmitters best.

What arrives does not depend on how the receiver is turned; what its directive elements make of it does. So the waves are asked
of a trained field once, and turning is a closed form of them, with a gradient.
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
from wbgs_jax.radio.antenna import Antenna, antenna_field, pattern_exponents, zenith_vector
from wbgs_jax.radio.array import squared_magnitude
from wbgs_jax.radio.channel import Arrivals, decibels
from wbgs_jax.types import Query, make_receiver

Turned = Callable[[Float[Array, "k 2"]], Float[Array, "k tx"]]
"""Azimuth and elevation (radians, world frame) of where the elements look -> power (dB) from every transmitter."""
STEP = 0.3
"""Radians between directions that are tried first."""
FINEST = 0.01
"""Of the last steps, radians."""
STEPS = 40
HIGHEST = 1.55
"""Largest elevation, radians."""


def boresight_quaternion(angles: Float[Array, "2"]) -> Float[Array, "4"]:
    """Returns the quaternion (wxyz) of a receiver whose +x, where directive elements look, has this azimuth and elevation
    (radians, world frame) and whose y axis stays level."""
    (ca, ce), (sa, se) = jnp.cos(angles / 2), jnp.sin(angles / 2)
    return jnp.stack([ca * ce, sa * se, -ca * se, sa * ce])


def arrivals_anywhere(field: Field, params: Params, receiver: Any, transmitters: Any, frequency_hz: float) -> Arrivals:
    """Returns what reaches an isotropic element at a place from n transmitters, over every path; its frame is the world's.

    Args:
        field, params: a trained field that knows paths; of it the part that holds anywhere (`Field.receiver_independent`).
        receiver: (3,), world frame, metres.
        transmitters: (n, 3), the same.
        frequency_hz: hertz.

    Raises:
        UserError: the field knows no paths, or holds nowhere else than at its receivers.
    """
    if "paths" not in outputs_of(field):
        raise UserError(f"the {field.name} field knows no paths; train the default one on data with a mesh")
    field, params = field.receiver_independent(params)
    plan = field.plan(params, make_receiver(receiver, element_positions=np.zeros((1, 3))))
    places = jnp.atleast_2d(jnp.asarray(transmitters, jnp.float32))
    return paths_of(field, params, plan, Query(places, jnp.full(len(places), frequency_hz, jnp.float32)))


def power_when_turned(arrived: Arrivals, pattern: str = "tr38901") -> Turned:
    """Returns the mean power over all elements (dB) of waves by where the elements look; differentiable.

    The powers of all paths are added, as the mean over places around the receiver: interference is not what an array is turned
    for.

    Args:
        arrived: at isotropic elements whose frame is the world's, with a leading axis of transmitters (`arrivals_anywhere`).
        pattern: of the elements: "tr38901", "dipole", "hw_dipole", or "iso", which no turn changes but for polarisation.
    """
    assert arrived.polarised is not None, "arrivals of traced paths have it"
    direction, amplitude = arrived.direction, arrived.polarised
    along_theta = zenith_vector(direction)
    vector = amplitude[..., :1] * along_theta + amplitude[..., 1:] * jnp.cross(direction, along_theta)
    exponents = jnp.array(pattern_exponents(pattern), jnp.float32)

    def one(angles: Float[Array, "2"]) -> Float[Array, " tx"]:
        heard = antenna_field(Antenna(boresight_quaternion(angles), exponents), direction)
        return decibels(jnp.sum(squared_magnitude(jnp.sum(vector * heard, -1)), -1))

    return jax.vmap(one)


def turn_array(
    powers: Turned, aim: Callable[[Float[Array, "k tx"]], Float[Array, " k"]] = soft_minimum, starts: int = 4
) -> Descended:
    """Returns where elements should look: `place` (starts, 2), azimuth and elevation in radians, the best one first, and
    `loss`, minus the aim (dB).

    The best directions of a grid over the sphere that stand apart are followed by gradient steps.

    Args:
        powers: of the transmitters by direction, as `power_when_turned` makes it, or any function like it.
        aim: of the powers, to be as large as possible, as in `place_antenna`.
        starts: directions that gradient steps begin from.
    """
    sphere = np.array([[-np.pi, -HIGHEST], [np.pi, HIGHEST]])
    tried = jnp.asarray(grid_over(sphere, STEP))
    low_high = jnp.array([[-2 * np.pi, -HIGHEST], [2 * np.pi, HIGHEST]])  # azimuths go on beyond half a turn

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
