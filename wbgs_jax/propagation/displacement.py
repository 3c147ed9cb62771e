"""How the lengths of paths change where things stand elsewhere than they are said to, to first order, and what is left of
interference where nobody knows by how much.

By Fermat's principle the points of a path need not follow: if mirrors and edges move by m where the path meets them and the
receiver by r, it grows by

    dL = sum over reflections and diffractions of (u - v) . m  +  u_last . r

with u and v the unit directions of the wave before and after. What it passes through changes nothing. A rigid motion of a
surface is a shift and a rotation about its centre. Transmitters stay: they are what all else is measured from, and if all of
them were off alike, everything else would be off the other way.

Where the shifts of all movers are unknown, independent and normal with standard deviations s, dL is normal too, and the mean
product of two amplitudes loses exp(-k^2 Var(dL_i - dL_j) / 2): the spectrum is that of partially coherent waves.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wbgs_jax._util.pytree import pytree
from wbgs_jax.mesh.facets import AnyArray, centres
from wbgs_jax.propagation.image_method import Surfaces
from wbgs_jax.propagation.paths import DIFFRACTED, MAX_ORDER, REFLECTED, Paths, TracedPaths
from wbgs_jax.propagation.transport import last_leg, legs_of
from wbgs_jax.radio.array import EXACT


@pytree
class Motion:
    """How far things stand from where they are said to stand, seen from the transmitters: small rigid motions, world frame."""

    shift: Float[AnyArray, "m 3"]
    """Of every mover of the facets, metres, ..."""
    turn: Float[AnyArray, "m 3"]
    """... and its rotation vector about its centre (`facets.centres`), radians."""
    receiver: Float[AnyArray, "*r 3"]
    """Of the receivers, metres, ..."""
    receiver_turn: Float[AnyArray, "*r 3"]
    """... and their rotation vectors, radians."""

    def of_receiver(self, number: int | Int[Array, ""]) -> "Motion":
        """Returns it as one of the receivers sees it, without the others'."""
        return dataclasses.replace(self, receiver=self.receiver[number], receiver_turn=self.receiver_turn[number])


def still(movers: int, receivers: int = 1) -> Motion:
    """Returns the motion of what stands where it is said to (float32)."""
    nothing, none = np.zeros((movers, 3), np.float32), np.zeros((receivers, 3), np.float32)
    return Motion(nothing, nothing, none, none)


@jax.jit
def length_changes(paths: Paths, surfaces: Surfaces, motion: Motion) -> Float[Array, " k"]:
    """Returns by how much the K paths of one transmitter to one receiver grow (metres) if things and that receiver
    (`Motion.of_receiver`) move by so much; turning the receiver changes no length."""
    turn, mover = _turns(paths, surfaces)
    arm = _arms(paths, surfaces, mover, len(motion.shift))
    own = jnp.asarray(motion.shift)[mover] + jnp.cross(jnp.asarray(motion.turn)[mover], arm)
    return jnp.sum(turn * own, (-2, -1)) + jnp.matmul(_arriving(paths), motion.receiver, precision=EXACT)


def length_terms(paths: Paths, surfaces: Surfaces, movers: int) -> tuple[Int[Array, "k terms"], Float[Array, "k terms"]]:
    """Returns the numbers of a motion (of one receiver), as `ravel_pytree` orders them, that the lengths of K paths depend on,
    and the derivatives of `length_changes` with respect to them. A number may be there twice; its derivatives add."""
    turn, mover = _turns(paths, surfaces)
    lever = jnp.cross(_arms(paths, surfaces, mover, movers), turn)
    legs = [(paths.interaction_leg == leg) & jnp.any(turn != 0, -1) for leg in range(MAX_ORDER)]  # a leg ends in one bend
    here = jnp.stack(legs, 1)
    bends = [jnp.sum(jnp.where(here[..., None], of[:, None], 0), 2) for of in (turn, lever)]
    first = 3 * jnp.sum(jnp.where(here, mover[:, None], 0), 2)
    shift = first[..., None] + jnp.arange(3)
    receiver = jnp.broadcast_to(6 * movers + jnp.arange(3), (len(turn), 3))
    number = jnp.stack([shift, shift + 3 * movers], 1).reshape(len(turn), 6 * MAX_ORDER)
    derivative = jnp.stack(bends, 1).reshape(number.shape)
    return jnp.concatenate([number, receiver], 1), jnp.concatenate([derivative, _arriving(paths)], 1)


def length_gradient(paths: Paths, surfaces: Surfaces, movers: int) -> Float[Array, "k places 3"]:
    """Returns the derivative of the K path lengths of one transmitter with respect to the shifts of all movers of the facets
    and, last, of the transmitter."""
    turn, mover = _turns(paths, surfaces)
    departing = -legs_of(paths).direction[:, :1]
    return jnp.concatenate([_by_mover(turn, mover, movers), departing], 1)


def _by_mover(values: Float[Array, "k 5 3"], mover: Int[Array, "k 5"], movers: int) -> Float[Array, "k movers 3"]:
    """Returns what paths have at their interactions, summed over those with the same mover."""
    return jnp.zeros((len(values), movers, 3)).at[jnp.arange(len(values))[:, None], mover].add(values)


def coherence(gradient: Float[Array, "k m 3"], spread: Float[Array, " m"], wavenumber: Float[Array, ""]) -> Float[Array, "k k"]:
    """Returns what is left, 0 to 1, of the mean product of two paths' amplitudes where the places that their lengths depend on
    are unknown.

    Args:
        gradient: of the lengths with respect to the places (`length_gradient`).
        spread: standard deviation of every place along each axis, metres.
        wavenumber: radians a metre.
    """
    phase = (wavenumber * gradient * spread[:, None]).reshape(len(gradient), 3 * gradient.shape[1])
    variance = jnp.sum(phase**2, -1)
    both = jnp.matmul(phase, phase.T, precision=EXACT)
    return jnp.exp(-0.5 * jnp.maximum(variance[:, None] + variance - 2 * both, 0))


@jax.jit
def path_coherence(
    paths: TracedPaths, surfaces: Surfaces, spread: Float[Array, " places"], wavenumber: Float[Array, ""]
) -> Float[Array, "k k"]:
    """Returns the `coherence` of all paths of one transmitter, the specular ones first, at a cost that does not grow with the
    number of movers: a path has its mirrors and edges, and no others.

    Args:
        paths: of one transmitter.
        surfaces: that they were found in.
        spread: standard deviation of the place of every mover and, last, of the transmitter along each axis, metres.
        wavenumber: radians a metre.
    """
    specular, diffracted = _bends(paths.specular, surfaces, MAX_ORDER), _bends(paths.diffracted, surfaces, MAX_ORDER - 1)
    variance = (wavenumber * spread) ** 2
    mixed = _shared(specular, diffracted, variance)
    rows = [[_shared(specular, specular, variance), mixed], [mixed.T, _shared(diffracted, diffracted, variance)]]
    both = jnp.block(rows)
    own = jnp.diagonal(both)
    return jnp.exp(-0.5 * jnp.maximum(own[:, None] + own - 2 * both, 0))


class _Bends(NamedTuple):
    """Where K paths are reflected or diffracted, at most V times each."""

    turn: Float[Array, "v k 3"]
    """By how much the direction turns there; 0 where there is nothing."""
    mover: Int[Array, "v k"]
    departing: Float[Array, "k 3"]
    """Against the direction in which the wave leaves the transmitter."""


def _bends(paths: Paths, surfaces: Surfaces, most: int) -> _Bends:
    """Returns where paths bend, leg by leg: what they pass through turns nothing."""
    turn, mover = _turns(paths, surfaces)
    here = jnp.any(turn != 0, -1) & (paths.interaction_leg == jnp.arange(most)[:, None, None])
    found = (jnp.sum(jnp.where(here[..., None], turn, 0), -2), jnp.sum(jnp.where(here, mover, 0), -1))
    return _Bends(*found, -legs_of(paths).direction[:, 0])


def _shared(first: _Bends, second: _Bends, variance: Float[Array, " places"]) -> Float[Array, "k l"]:
    """Returns the covariance of the phases of K paths with those of L others. Written out over bends and components, so that
    nothing of more than K L numbers is ever stored."""
    total = variance[-1] * _products(first.departing, second.departing)
    for turn, mover in zip(first.turn, first.mover, strict=True):
        weighted = turn * variance[mover][:, None]
        for other, its in zip(second.turn, second.mover, strict=True):
            total += jnp.where(mover[:, None] == its, _products(weighted, other), 0)
    return total


def _products(a: Float[Array, "k 3"], b: Float[Array, "l 3"]) -> Float[Array, "k l"]:
    return a[:, None, 0] * b[:, 0] + a[:, None, 1] * b[:, 1] + a[:, None, 2] * b[:, 2]


def _arms(paths: Paths, surfaces: Surfaces, mover: Int[Array, "k 5"], movers: int) -> Float[Array, "k 5 3"]:
    """Returns where paths meet what they interact with, seen from the centres that these turn about."""
    leg = jnp.minimum(paths.interaction_leg, paths.points.shape[1] - 2)
    point = jnp.take_along_axis(paths.points, leg[..., None] + 1, 1)
    return point - centres(surfaces.facets, movers)[mover]


def _arriving(paths: Paths) -> Float[Array, "k 3"]:
    """Returns the directions of the last legs."""
    return jnp.take_along_axis(legs_of(paths).direction, last_leg(paths)[:, None, None], 1)[:, 0]


def _turns(paths: Paths, surfaces: Surfaces) -> tuple[Float[Array, "k 5 3"], Int[Array, "k 5"]]:
    """Returns how paths turn at what they interact with, zero where they do not, and the mover that it belongs to."""
    direction = legs_of(paths).direction
    path, leg = jnp.arange(len(direction))[:, None], jnp.minimum(paths.interaction_leg, direction.shape[1] - 2)
    turn = direction[path, leg] - direction[path, leg + 1]
    reflects, diffracts = paths.interaction_type == REFLECTED, paths.interaction_type == DIFFRACTED
    number = paths.interaction_facet
    facet = jnp.where(reflects, number, 0)
    if surfaces.edges.facet.shape[0]:
        facet = jnp.where(diffracts, surfaces.edges.facet[jnp.where(diffracts, number, 0)], facet)
    return jnp.where((reflects | diffracts)[..., None], turn, 0), surfaces.facets.mover[facet]
