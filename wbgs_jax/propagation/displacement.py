"""First-order changes of path lengths when surfaces and receivers are displaced from their nominal positions, and the remaining
coherence of paths when these displacements are unknown.

By Fermat's principle the vertices of a path need not be traced again: if mirrors and edges move by m at the point where the
path meets them, and the receiver by r, the path grows by

    dL = sum over reflections and diffractions of (u - v) . m  +  u_last . r

with u and v the unit directions of the wave before and after. Transmissions change nothing. A rigid motion of a surface is a
shift and a rotation about its centre. Transmitters stay fixed: they define the frame, since a common error of all of them is
equivalent to the opposite displacement of everything else.

If the shifts of all rigid bodies are independent normal variables with standard deviations s, dL is normal too, and the mean
product of two amplitudes is reduced by exp(-k^2 Var(dL_i - dL_j) / 2): the spectrum is that of partially coherent waves.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from wbgs_jax._util.pytree import AnyArray, pytree
from wbgs_jax.mesh.facets import centres
from wbgs_jax.propagation.image_method import Surfaces
from wbgs_jax.propagation.mechanisms import MECHANISMS
from wbgs_jax.propagation.paths import MAX_ORDER, PathGeometry, TracedPaths, is_vertex, on_edge
from wbgs_jax.propagation.transport import last_segment, segments_of
from wbgs_jax.radio.array import EXACT


@pytree
class Motion:
    """Small rigid displacements from the nominal positions, relative to the transmitters, world frame."""

    shift: Float[AnyArray, "*t m 3"]
    """Shift of every rigid body (`Facets.mover`), metres, ..."""
    turn: Float[AnyArray, "*t m 3"]
    """... and its rotation vector about the body's centre (`facets.centres`), radians."""
    receiver: Float[AnyArray, "*r 3"]
    """Shift of the receivers, metres, ..."""
    receiver_turn: Float[AnyArray, "*r 3"]
    """... and their rotation vectors, radians."""

    def of_receiver(self, number: int | Int[Array, ""]) -> "Motion":
        """Returns the motion with only the receiver `number` in it."""
        return dataclasses.replace(self, receiver=self.receiver[number], receiver_turn=self.receiver_turn[number])


def still(rigid_bodies: int, receivers: int = 1) -> Motion:
    """Returns the motion without any displacement (float32)."""
    nothing, none = np.zeros((rigid_bodies, 3), np.float32), np.zeros((receivers, 3), np.float32)
    return Motion(nothing, nothing, none, none)


@jax.jit
def length_changes(paths: PathGeometry, surfaces: Surfaces, motion: Motion) -> Float[Array, " k"]:
    """Returns the growth (metres) of the K paths from one transmitter to one receiver under a motion of surfaces and of that
    receiver (`Motion.of_receiver`); rotating the receiver changes no length."""
    turn, rigid_body = _direction_changes(paths, surfaces)
    arm = _lever_arms(paths, surfaces, rigid_body, len(motion.shift))
    own = jnp.asarray(motion.shift)[rigid_body] + jnp.cross(jnp.asarray(motion.turn)[rigid_body], arm)
    return jnp.sum(turn * own, (-2, -1)) + jnp.matmul(_arrival_directions(paths), motion.receiver, precision=EXACT)


def length_terms(
    paths: PathGeometry, surfaces: Surfaces, rigid_bodies: int
) -> tuple[Int[Array, "k terms"], Float[Array, "k terms"]]:
    """Returns the indices of the entries of a motion (of one receiver, in the order of `ravel_pytree`) that the lengths of K
    paths depend on, and the derivatives of `length_changes` with respect to them. If an index occurs twice, its derivatives
    add."""
    turn, rigid_body = _direction_changes(paths, surfaces)
    lever = jnp.cross(_lever_arms(paths, surfaces, rigid_body, rigid_bodies), turn)
    # A segment ends at one vertex at most.
    segments = [(paths.interaction_segment == segment) & jnp.any(turn != 0, -1) for segment in range(MAX_ORDER)]
    here = jnp.stack(segments, 1)
    bends = [jnp.sum(jnp.where(here[..., None], of[:, None], 0), 2) for of in (turn, lever)]
    first = 3 * jnp.sum(jnp.where(here, rigid_body[:, None], 0), 2)
    shift = first[..., None] + jnp.arange(3)
    receiver = jnp.broadcast_to(6 * rigid_bodies + jnp.arange(3), (len(turn), 3))
    number = jnp.stack([shift, shift + 3 * rigid_bodies], 1).reshape(len(turn), 6 * MAX_ORDER)
    derivative = jnp.stack(bends, 1).reshape(number.shape)
    return jnp.concatenate([number, receiver], 1), jnp.concatenate([derivative, _arrival_directions(paths)], 1)


def length_gradient(paths: PathGeometry, surfaces: Surfaces, rigid_bodies: int) -> Float[Array, "k places 3"]:
    """Returns the derivatives of the K path lengths of one transmitter with respect to the shifts of all rigid bodies and,
    last, of the transmitter."""
    turn, rigid_body = _direction_changes(paths, surfaces)
    departing = -segments_of(paths).direction[:, :1]
    return jnp.concatenate([_by_rigid_body(turn, rigid_body, rigid_bodies), departing], 1)


def _by_rigid_body(
    values: Float[Array, "k 5 3"], rigid_body: Int[Array, "k 5"], rigid_bodies: int
) -> Float[Array, "k rigid_bodies 3"]:
    """Returns values at the interactions of paths, summed over interactions with the same rigid body."""
    return jnp.zeros((len(values), rigid_bodies, 3)).at[jnp.arange(len(values))[:, None], rigid_body].add(values)


def coherence(gradient: Float[Array, "k m 3"], spread: Float[Array, " m"], wavenumber: Float[Array, ""]) -> Float[Array, "k k"]:
    """Returns the remaining mean product of two paths' amplitudes, relative to fully coherent paths (0..1), when the positions
    that their lengths depend on are uncertain.

    Args:
        gradient: derivatives of the lengths with respect to the positions (`length_gradient`).
        spread: standard deviation of every position along each axis, metres.
        wavenumber: radians per metre.
    """
    phase = (wavenumber * gradient * spread[:, None]).reshape(len(gradient), 3 * gradient.shape[1])
    variance = jnp.sum(phase**2, -1)
    both = jnp.matmul(phase, phase.T, precision=EXACT)
    return jnp.exp(-0.5 * jnp.maximum(variance[:, None] + variance - 2 * both, 0))


@jax.jit
def path_coherence(
    paths: TracedPaths, surfaces: Surfaces, spread: Float[Array, " places"], wavenumber: Float[Array, ""]
) -> Float[Array, "k k"]:
    """Returns the `coherence` of all paths of one transmitter, at a cost that does not grow with the number of rigid bodies:
    only a path's own mirrors and edges are visited.

    Args:
        paths: of one transmitter.
        surfaces: surfaces in which the paths were found.
        spread: standard deviation of the position of every rigid body and, last, of the transmitter along each axis, metres.
        wavenumber: radians per metre.
    """
    most = max(MECHANISMS[some.mechanism].vertices for some in paths.sets)
    both = _phase_covariance(_bends(paths.together, surfaces, most), (wavenumber * spread) ** 2)
    own = jnp.diagonal(both)
    found = jnp.exp(-0.5 * jnp.maximum(own[:, None] + own - 2 * both, 0))
    if all(MECHANISMS[some.mechanism].coherent for some in paths.sets):
        return found
    adds = jnp.concatenate([jnp.full(some.alive.shape, MECHANISMS[some.mechanism].coherent) for some in paths.sets])
    return jnp.where(adds[:, None] & adds | jnp.eye(len(adds), dtype=bool), found, 0)


class _Bends(NamedTuple):
    """Reflections and diffractions of K paths, at most V of each path."""

    turn: Float[Array, "v k 3"]
    """Change of direction (incoming minus outgoing unit vector) at the vertex; 0 where there is none."""
    rigid_body: Int[Array, "v k"]
    """Index of the rigid body."""
    departing: Float[Array, "k 3"]
    """Unit vector opposite to the direction in which the wave leaves the transmitter."""


def _bends(paths: PathGeometry, surfaces: Surfaces, most: int) -> _Bends:
    """Returns the changes of direction of paths, segment by segment; transmissions change no direction."""
    turn, rigid_body = _direction_changes(paths, surfaces)
    here = jnp.any(turn != 0, -1) & (paths.interaction_segment == jnp.arange(most)[:, None, None])
    found = (jnp.sum(jnp.where(here[..., None], turn, 0), -2), jnp.sum(jnp.where(here, rigid_body, 0), -1))
    return _Bends(*found, -segments_of(paths).direction[:, 0])


def _phase_covariance(bends: _Bends, variance: Float[Array, " places"]) -> Float[Array, "k k"]:
    """Returns the covariance of the phases of K paths. The sums over vertices and components are written out, so that no array
    larger than K K is ever stored."""
    total = _dot_products(variance[-1] * bends.departing, bends.departing)
    for turn, rigid_body in zip(bends.turn, bends.rigid_body, strict=True):
        weighted = turn * variance[rigid_body][:, None]
        for other, its in zip(bends.turn, bends.rigid_body, strict=True):
            total += jnp.where(rigid_body[:, None] == its, _dot_products(weighted, other), 0)
    return total


@jax.custom_jvp
def _dot_products(a: Float[Array, "k 3"], b: Float[Array, "l 3"]) -> Float[Array, "k l"]:
    """Returns the dot products of all pairs of rows. Written out they are fused with what follows; their derivatives are matrix
    products, since a CPU takes ten times as long for the sums over rows that the written form would lead to."""
    return a[:, None, 0] * b[:, 0] + a[:, None, 1] * b[:, 1] + a[:, None, 2] * b[:, 2]


@partial(_dot_products.defjvp, symbolic_zeros=True)
def _dot_products_jvp(primals: Any, tangents: Any) -> tuple[Float[Array, "k l"], Float[Array, "k l"]]:
    (a, b), (da, db) = primals, tangents
    parts = [jnp.matmul(da, b.T, precision=EXACT)] if not isinstance(da, SymbolicZero) else []
    parts += [jnp.matmul(a, db.T, precision=EXACT)] if not isinstance(db, SymbolicZero) else []
    value = _dot_products(a, b)
    return value, sum(parts, jnp.zeros_like(value))


def _lever_arms(
    paths: PathGeometry, surfaces: Surfaces, rigid_body: Int[Array, "k 5"], rigid_bodies: int
) -> Float[Array, "k 5 3"]:
    """Returns the points of interaction relative to the centres of the rigid bodies that they lie on."""
    segment = jnp.minimum(paths.interaction_segment, paths.points.shape[1] - 2)
    point = jnp.take_along_axis(paths.points, segment[..., None] + 1, 1)
    return point - centres(surfaces.facets, rigid_bodies)[rigid_body]


def _arrival_directions(paths: PathGeometry) -> Float[Array, "k 3"]:
    """Returns the directions of the last segments."""
    return jnp.take_along_axis(segments_of(paths).direction, last_segment(paths)[:, None, None], 1)[:, 0]


def _direction_changes(paths: PathGeometry, surfaces: Surfaces) -> tuple[Float[Array, "k 5 3"], Int[Array, "k 5"]]:
    """Returns the change of direction at every interaction (zero for transmissions), and the index of its rigid body."""
    direction = segments_of(paths).direction
    path, segment = jnp.arange(len(direction))[:, None], jnp.minimum(paths.interaction_segment, direction.shape[1] - 2)
    turn = direction[path, segment] - direction[path, segment + 1]
    bends, at_edge, number = is_vertex(paths.interaction_type), on_edge(paths.interaction_type), paths.interaction_facet
    facet = jnp.where(bends & ~at_edge, number, 0)
    if surfaces.edges.facet.shape[0]:
        facet = jnp.where(at_edge, surfaces.edges.facet[jnp.where(at_edge, number, 0)], facet)
    return jnp.where(bends[..., None], turn, 0), surfaces.facets.mover[facet]
