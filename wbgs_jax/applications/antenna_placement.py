"""Placement of an antenna so that it covers a region, and orientation of an array.

A coherent field finds the mirror images of its receiver on the host, so its powers have no gradient with respect to the
receiver's position, but they have one with respect to the transmitter's. Channels are reciprocal: what an isotropic antenna at
p receives from a position q equals what q receives from p. The positions of the region therefore become receivers, which stay
fixed, and the antenna to be placed becomes the transmitter.

The orientation of a receiver's directive elements is found likewise (`rotate_array`). The arriving waves do not depend on it;
the response of the elements does. The waves are therefore predicted once by a trained field, and the response is a closed-form,
differentiable function of the orientation.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.applications.multistart import Descended, best_apart, descend, grid_over, in_blocks, shrinking
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params, outputs_of, paths_of
from wbgs_jax.fields.calibratable import at_isotropic_antennas
from wbgs_jax.radio.antenna import Antenna, pattern_exponents, zenith_vector
from wbgs_jax.radio.array import squared_magnitude
from wbgs_jax.radio.channel import Paths, decibels
from wbgs_jax.types import Query, Transmitter, make_query, make_receiver

Powers = Callable[[Any, Any], Float[Array, "k users"]]
"""(antenna positions (k, 3) or a `Transmitter`, smoothing length, metres) -> power (dB) that every user receives from each."""
SOFT_DB = 3.0
"""Powers that differ by less than this have nearly equal weight in `soft_minimum`."""
NARROWEST_M = 0.02
"""Final smoothing length, metres: variations over a few millimetres are fading, which does not matter for coverage."""


def soft_minimum(power_db: Any, soft_db: float = SOFT_DB) -> Float[Array, "*k"]:
    """Returns a smooth minimum over the users, between the lowest power and the mean of the decibels; it approaches the mean as
    `soft_db` grows.

    Args:
        power_db: (*k, users), powers of the users.
        soft_db: width of the transition, decibels.

    Returns:
        Decibels (*k,).

    Example:
        >>> import jax.numpy as jnp
        >>> round(float(soft_minimum(jnp.array([-60.0, -90.0]), 1.0)), 1)
        -89.3
    """
    power_db = jnp.asarray(power_db)
    return -soft_db * (jax.nn.logsumexp(-power_db / soft_db, -1) - jnp.log(power_db.shape[-1]))


def mean_power(power_db: Any) -> Float[Array, "*k"]:
    """Returns the mean over the users of their powers in dB.

    Args:
        power_db: (*k, users), powers of the users.

    Returns:
        Decibels (*k,).
    """
    return jnp.mean(jnp.asarray(power_db), -1)


def tenth_percentile(power_db: Any) -> Float[Array, "*k"]:
    """Returns the power that nine of ten users exceed; its gradient is that of the two adjacent users.

    Args:
        power_db: (*k, users), powers of the users.

    Returns:
        Decibels (*k,).
    """
    return jnp.quantile(jnp.asarray(power_db), 0.1, axis=-1)


def power_at_users(field: Field, params: Params, users: Any, frequencies_hz: Any) -> Powers:
    """Returns a function for the powers (dB, mean over the frequencies) that users receive from antennas at any positions, all
    antennas isotropic unless a `Transmitter` names its own; differentiable in reverse mode with respect to positions and
    orientations.

    Every user is a receiver that is planned here and compiled together with the function: a dozen take a minute, hundreds are
    too many.

    Args:
        field, params: a trained field, of which the receiver-independent part is used (`Field.receiver_independent`).
        users: (users, 3), world frame, metres.
        frequencies_hz: (f,) or one, hertz.

    Returns:
        The function: positions (k, 3) in metres, or k antennas as a `radio.Transmitter` with orientations and patterns, and a
        smoothing length in metres -> powers (k, users), dB relative to the transmitted powers.

    Raises:
        UserError: the field predicts no power, or only at the receivers it was trained for.
    """
    field, params = at_isotropic_antennas(field, params)
    if "power" not in outputs_of(field):
        raise UserError(f"the {field.name} field predicts only spectra, no power; train another field")
    one = np.zeros((1, 3))  # a single antenna
    places = np.atleast_2d(np.asarray(users, np.float32))
    plans = [field.plan(params, make_receiver(user, element_positions=one)) for user in places]
    frequencies = jnp.atleast_1d(jnp.asarray(frequencies_hz, jnp.float32))

    def at(plan: Any, antennas: Transmitter, blur: Any, frequency_hz: Float[Array, ""]) -> Float[Array, " k"]:
        query = Query(antennas, jnp.broadcast_to(frequency_hz, antennas.position.shape[:1]))
        power = field.render(field.smoothed(params, blur), plan, query).power_db
        assert power is not None, "the field predicts power"
        return power

    def powers(places: Any, blur: Any) -> Float[Array, "k users"]:
        antennas = places if isinstance(places, Transmitter) else Transmitter(jnp.asarray(places, jnp.float32))
        # Under `vmap` over frequencies, whatever depends on positions alone, such as paths, is computed only once.
        each = [jnp.mean(jax.vmap(partial(at, plan, antennas, blur))(frequencies), 0) for plan in plans]
        return jnp.stack(each, -1)

    return powers


def place_antenna(
    powers: Powers,
    box: Any,
    aim: Callable[[Float[Array, "k users"]], Float[Array, " k"]] = soft_minimum,
    step: float = 0.5,
    starts: int = 4,
) -> Descended:
    """Returns the antenna positions that serve the users best: `place` (starts, 3), the best one first, and `loss`, minus the
    objective (dB).

    The best points of a grid that are not close together are refined by gradient steps on powers that are smoothed over shorter
    and shorter distances, down to two centimetres.

    Args:
        powers: of the users, from `power_at_users` or any similar function.
        box: (2, 3), lowest and highest corner of the possible antenna positions, metres.
        aim: objective to maximise, a function of the users' powers: `soft_minimum`, `mean_power`, `tenth_percentile`, or any
            smooth function (k, users) -> (k,).
        step: grid spacing, metres.
        starts: number of starting points of the gradient steps.

    Returns:
        `place` (starts, 3), world frame, metres, and `loss` (starts,), dB.
    """
    low_high = jnp.asarray(box, jnp.float32)
    places = grid_over(np.asarray(box, np.float32), step)

    def loss(tried: Float[Array, "k 3"], blur: Any) -> Float[Array, " k"]:
        return -aim(powers(tried, blur))

    @jax.jit
    def search(places: Float[Array, "n 3"]) -> Descended:
        losses = in_blocks(lambda block: loss(block, step / 2), places)
        chosen = best_apart(places, losses, min(starts, len(places)), 1.5 * step)
        return descend(loss, places[chosen], low_high, shrinking(step / 2, min(NARROWEST_M, step / 2), 30))

    return search(jnp.asarray(places))


PowerByBoresight = Callable[[Float[Array, "k 2"]], Float[Array, "k tx"]]
"""Azimuth and elevation of the boresight (radians, world frame) -> power (dB) from every transmitter."""
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
    step = 0.3  # spacing of the directions that are tried first, radians
    tried = jnp.asarray(grid_over(sphere, step))
    low_high = jnp.array([[-2 * np.pi, -HIGHEST], [2 * np.pi, HIGHEST]])  # azimuths may pass +-pi

    def loss(angles: Float[Array, "k 2"], blur: Any) -> Float[Array, " k"]:
        return -aim(powers(angles))

    finest = 0.01  # size of the last steps, radians

    @jax.jit
    def search(tried: Float[Array, "n 2"]) -> Descended:
        losses = in_blocks(lambda block: loss(block, 0.0), tried)
        chosen = best_apart(tried, losses, min(starts, len(tried)), 1.5 * step)
        return descend(loss, tried[chosen], low_high, shrinking(step / 2, finest, 40))

    found = search(tried)
    azimuth = jnp.mod(found.place[:, 0] + np.pi, 2 * np.pi) - np.pi
    return Descended(found.place.at[:, 0].set(azimuth), found.loss)
