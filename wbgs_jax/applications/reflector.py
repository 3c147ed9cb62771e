"""Placement of a flat metal plate that covers positions poorly served by the transmitter.

The wave reflected by a plate comes from the transmitter's mirror image in the plate's plane, as far as the plate extends around
the point of reflection. That point, the path length and the fraction of the wave that the plate reflects are closed-form
functions of the plate's pose, and so is their gradient; the attenuation by walls between the plate and the ends is predicted by
a trained field. The plate is not part of the field's mesh: waves that interact with both it and another wall are not included.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.applications.antenna_placement import NARROWEST_M, Powers, soft_minimum
from wbgs_jax.applications.multistart import Descended, best_apart, descend, grid_over, in_blocks, shrinking
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params, outputs_of, paths_of
from wbgs_jax.fields.calibratable import at_isotropic_antennas
from wbgs_jax.propagation.paths import is_vertex
from wbgs_jax.radio.antenna import zenith_vector
from wbgs_jax.radio.array import EXACT, SPEED_OF_LIGHT, squared_magnitude
from wbgs_jax.radio.channel import decibels, free_space_db
from wbgs_jax.types import make_query, make_receiver

STEEPEST = 1.45
"""Largest angle of the normal above or below the horizon, radians: the azimuth of a vertical normal is undefined."""
NEAREST_M = 1e-3
"""Lower bound on distances, so that gradients stay finite."""


@dataclass(frozen=True)
class Reflector:
    """A flat rectangular metal plate between one transmitter and users. Create it with `make_reflector`.

    A pose is (5,): the plate's centre x, y, z (world frame, metres), and azimuth and elevation of its normal (radians). Two of
    its sides are horizontal.
    """

    transmitter: Float[Array, "3"]
    users: Float[Array, "users 3"]
    size: Float[Array, "2"]
    """Length of the horizontal and of the other sides, metres."""
    frequencies_hz: Float[Array, " f"]
    legs: Powers | None
    """(plate positions (k, 3), smoothing length) -> powers (dB) of the straight paths from there to the transmitter and to
    every user; None for an unobstructed scene."""

    def power_db(self, poses: Float[Array, "k 5"], blur: Any = 0.0) -> Float[Array, "k users"]:
        """Returns the power that every user receives via the plate (dB relative to the transmitted power, mean over the
        frequencies); differentiable in reverse mode.

        Args:
            poses: of the plate.
            blur: metres by which the plate's edges are smoothed, so that a plate that just misses a user has a gradient.
        """
        return self._over(poses, self._in_the_way(poses[:, :3], blur), blur)

    def aimed(self, centres: Float[Array, "k 3"]) -> Float[Array, "k users 5"]:
        """Returns the poses of plates at K positions that reflect the transmitter's wave to one user each: the normal bisects
        the directions to the two ends."""
        to_tx = _unit(self.transmitter - centres)[:, None]
        normal = _unit(to_tx + _unit(self.users - centres[:, None]))
        angles = [jnp.arctan2(normal[..., 1], normal[..., 0]), jnp.arcsin(jnp.clip(normal[..., 2], -1, 1))]
        at = jnp.broadcast_to(centres[:, None], normal.shape)
        return jnp.concatenate([at, angles[0][..., None], jnp.clip(angles[1], -STEEPEST, STEEPEST)[..., None]], -1)

    def best_aimed(self, centres: Float[Array, "k 3"], loss: Callable[[Array], Array], blur: Any) -> Any:
        """Returns, for K positions, the pose (k, 5) of lowest loss among those aimed at one user, and its loss (k,)."""
        poses, in_the_way = self.aimed(centres), self._in_the_way(centres, blur)
        tried = jax.vmap(lambda some: loss(self._over(some, in_the_way, blur)), 1, 1)(poses)
        best = jnp.argmin(tried, 1)[:, None]
        return jnp.take_along_axis(poses, best[..., None], 1)[:, 0], jnp.take_along_axis(tried, best, 1)[:, 0]

    def _in_the_way(self, centres: Float[Array, "k 3"], blur: Any) -> Float[Array, "k users"]:
        """Returns the attenuation by walls (dB, at most 0) on both segments together, for a plate at K positions."""
        if self.legs is None:
            return jnp.zeros((len(centres), len(self.users)))
        ends = jnp.concatenate([self.transmitter[None], self.users])
        away = _length(centres[:, None] - ends)
        free = jnp.mean(_friis(away, self.frequencies_hz), -1)
        lost = jnp.minimum(self.legs(centres, blur) - free, 0)
        return lost[:, :1] + lost[:, 1:]

    def _over(self, poses: Float[Array, "k 5"], in_the_way: Float[Array, "k users"], blur: Any) -> Float[Array, "k users"]:
        one = jax.vmap(self._share_of_one, (None, 0, 0, None))  # over users
        power = jax.vmap(one, (0, None, 0, None))(poses, self.users, in_the_way, jnp.asarray(blur, poses.dtype))
        return jnp.mean(power, -1)

    def _share_of_one(
        self, pose: Float[Array, "5"], user: Float[Array, "3"], in_the_way: Float[Array, ""], blur: Array
    ) -> Float[Array, " f"]:
        """Returns the power of one user via one plate at all frequencies, dB."""
        normal, level, up = plate_axes(pose[3:])
        here, there = (end - pose[:3] for end in (self.transmitter, user))
        before, behind = _along(here, normal), _along(there, normal)
        image = here - 2 * before * normal
        # Point where the line from the mirror image to the user meets the plane; weights are used to avoid dividing by 0.
        share = jnp.abs(before) / jnp.maximum(jnp.abs(before) + jnp.abs(behind), NEAREST_M)
        point = image + share * (there - image)
        first, second, whole = _length(point - here), _length(there - point), _length(there - image)
        arriving = (point - here) / first
        # Squared cosines of tilt in the planes of the two axes; their Fresnel zones are those of an area seen at the cosine.
        wide, high = (jnp.maximum(1 - _along(arriving, axis) ** 2, NEAREST_M) for axis in (level, up))
        cosine, focal = jnp.abs(_along(arriving, normal)), first * second / whole
        caught = [
            _caught(_along(point, axis), half, cosine * jnp.sqrt(ratio), focal, self.frequencies_hz, blur)
            for axis, half, ratio in ((level, self.size[0] / 2, wide / high), (up, self.size[1] / 2, high / wide))
        ]
        leaving = (there - point) / second
        field = zenith_vector(arriving)
        mirrored = 2 * _along(field, normal) * normal - field  # electric field reflected by a metal
        copolarised = _along(mirrored, zenith_vector(-leaving))
        amplitude = jnp.where(before * behind > 0, caught[0] * caught[1] * copolarised, 0)
        return decibels(amplitude**2) + _friis(whole, self.frequencies_hz) + in_the_way


def make_reflector(
    transmitter: Any,
    users: Any,
    size: tuple[float, float],
    frequencies_hz: Any,
    field: Field | None = None,
    params: Params = None,
) -> Reflector:
    """Returns a metal plate between a transmitter and users, whose powers are a function of its pose.

    Antennas are isotropic and vertically polarised.

    Args:
        transmitter: (3,), world frame, metres.
        users: (users, 3), world frame, metres.
        size: of the plate, metres: horizontal sides, and the others.
        frequencies_hz: (f,) or one, hertz.
        field, params: a trained field that predicts paths, used for the walls between the plate and the ends; by default there
            are no walls. Every end is planned and compiled separately: a dozen take a minute.

    Returns:
        The plate; `power_db` is the function of its pose.

    Raises:
        UserError: a side is not longer than 0, or the field predicts no paths, or only at the receivers it was trained for.
    """
    if not min(size) > 0:
        raise UserError(f"a plate of {size[0]:g} m x {size[1]:g} m has no area; give two sides above 0")
    ends = np.concatenate([np.reshape(transmitter, (1, 3)), np.atleast_2d(users)]).astype(np.float32)
    frequencies = jnp.atleast_1d(jnp.asarray(frequencies_hz, jnp.float32))
    legs = None if field is None else straight_powers(field, params, ends, frequencies)
    return Reflector(jnp.asarray(ends[0]), jnp.asarray(ends[1:]), jnp.asarray(size, jnp.float32), frequencies, legs)


def straight_powers(field: Field, params: Params, ends: Any, frequencies_hz: Any) -> Powers:
    """Returns a function for the powers (dB, mean over the frequencies) of straight paths from any position to given ends,
    through all walls in between but without reflections or diffraction.

    Args:
        field, params: a trained field that predicts paths, of which the receiver-independent part is used.
        ends: (ends, 3), world frame, metres.
        frequencies_hz: (f,) or one, hertz.

    Returns:
        The function: positions (k, 3) in metres and a smoothing length in metres -> powers (k, ends), dB.

    Raises:
        UserError: the field predicts no paths, or only at the receivers it was trained for.
    """
    if "paths" not in outputs_of(field):
        raise UserError(f"the {field.name} field predicts no paths; train the default one on data with a mesh")
    field, params = at_isotropic_antennas(field, params)
    one = np.zeros((1, 3))  # a single antenna
    plans = [field.plan(params, make_receiver(end, element_positions=one)) for end in np.atleast_2d(ends)]
    frequencies = jnp.atleast_1d(jnp.asarray(frequencies_hz, jnp.float32))

    def at(plan: Any, places: Float[Array, "k 3"], frequency_hz: Float[Array, ""]) -> Float[Array, " k"]:
        arrived = paths_of(field, params, plan, make_query(places, frequency_hz))
        assert arrived.interaction is not None, "arrivals of traced paths have interactions"
        straight = ~jnp.any(is_vertex(arrived.interaction), -1)
        return decibels(jnp.sum(jnp.where(straight, squared_magnitude(arrived.amplitude), 0), -1))

    def powers(places: Any, blur: Any = 0.0) -> Float[Array, "k ends"]:
        places = jnp.asarray(places, jnp.float32)
        each = [jnp.mean(jax.vmap(lambda f, plan=plan: at(plan, places, f))(frequencies), 0) for plan in plans]
        return jnp.stack(each, -1)

    return powers


def place_reflector(
    plate: Reflector,
    without_db: Any,
    box: Any,
    aim: Callable[[Float[Array, "k users"]], Float[Array, " k"]] = soft_minimum,
    step: float = 0.5,
    starts: int = 4,
) -> Descended:
    """Returns the plate poses that serve the users best: `place` (starts, 5), the best one first, and `loss`, minus the
    objective.

    At every grid point the plate is aimed at each user in turn; the best poses that are not close together are refined by
    gradient steps in all five numbers, with the plate's edges smoothed less and less.

    Args:
        plate: from `make_reflector`.
        without_db: (users,), power of every user without the plate, dB (`power_at_users` at the transmitter); powers are added.
        box: (2, 3), lowest and highest corner of the possible centres, metres.
        aim: objective to maximise, as in `place_antenna`.
        step: grid spacing, metres.
        starts: number of starting poses of the gradient steps.

    Returns:
        `place` (starts, 5), metres and radians (`Reflector`), and `loss` (starts,), dB.
    """
    before = 10 ** (jnp.asarray(without_db, jnp.float32) / 10)
    centres = grid_over(np.asarray(box, np.float32), step)
    low_high = jnp.concatenate([jnp.asarray(box, jnp.float32), jnp.array([[-10.0, -STEEPEST], [10.0, STEEPEST]])], 1)
    count = min(starts, len(centres))

    def loss_of(over_plate_db: Float[Array, "k users"]) -> Float[Array, " k"]:
        return -aim(decibels(before + 10 ** (over_plate_db / 10)))

    def loss(poses: Float[Array, "k 5"], blur: Any) -> Float[Array, " k"]:
        return loss_of(plate.power_db(poses, blur))

    steps = 60  # gradient steps

    @jax.jit
    def search(centres: Float[Array, "n 3"]) -> Descended:
        def tried(block: Float[Array, "k 3"]) -> Float[Array, "k 6"]:
            poses, losses = plate.best_aimed(block, loss_of, step / 2)
            return jnp.concatenate([poses, losses[:, None]], -1)

        found = in_blocks(tried, centres)
        chosen = best_apart(centres, found[:, 5], count, 1.5 * step)
        return descend(loss, found[chosen, :5], low_high, shrinking(step / 2, min(NARROWEST_M, step / 2), steps))

    return search(jnp.asarray(centres))


def plate_axes(angles: Float[Array, "2"]) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "3"]]:
    """Returns unit vectors of a plate whose normal has this azimuth and elevation (radians): the normal, along the horizontal
    sides, and along the others."""
    (ca, ce), (sa, se) = jnp.cos(angles), jnp.sin(angles)
    zero = jnp.zeros_like(ca)
    return jnp.stack([ce * ca, ce * sa, se]), jnp.stack([-sa, ca, zero]), jnp.stack([-se * ca, -se * sa, ce])


def _caught(
    aside: Array, half: Array, tilt: Array, focal: Array, frequencies_hz: Float[Array, " f"], blur: Array
) -> Float[Array, " f"]:
    """Returns the fraction of the wave's amplitude that a plate reflects, along one axis: 1 if it extends over many Fresnel
    zones on both sides, 1/2 at its edge.

    This is the Fresnel integral without its ripples: an error function with the same limits for plates large and small compared
    with the first Fresnel zone; the square of the latter is the radar equation of a flat plate.

    Args:
        aside: distance along the axis from the plate's centre to the point of reflection, metres.
        half: half the side, metres.
        tilt: curvature of the wave's phase along the axis, relative to that at normal incidence.
        focal: product of both path lengths over their sum, metres.
        frequencies_hz: hertz.
        blur: smoothing length, metres.
    """
    zone = SPEED_OF_LIGHT / frequencies_hz * focal / jnp.maximum(tilt, NEAREST_M)
    width = jnp.sqrt(zone / jnp.pi + blur**2)
    return (jax.scipy.special.erf((half - aside) / width) + jax.scipy.special.erf((half + aside) / width)) / 2


def _friis(metres: Float[Array, "*n"], frequencies_hz: Float[Array, " f"]) -> Float[Array, "*n f"]:
    return free_space_db(*jnp.broadcast_arrays(metres[..., None], frequencies_hz))


def _along(vector: Float[Array, "3"], axis: Float[Array, "3"]) -> Float[Array, ""]:
    return jnp.matmul(vector, axis, precision=EXACT)


def _length(vectors: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    return jnp.sqrt(jnp.maximum(jnp.sum(vectors**2, -1), NEAREST_M**2))


def _unit(vectors: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    return vectors / _length(vectors)[..., None]
