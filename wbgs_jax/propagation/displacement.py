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

Rigid bodies and receivers that move far need the image tree of every instant of a movement (`tree_at`). Surfaces, edges and
images are then moved exactly, and paths are traced again at every instant, so that they appear and vanish. A movement is a
`Motion` with a leading axis of instants. The reflection sequences that may occur are found once, on the host, at instants
between which nothing moves by more than `STEP_M`; what remains is a pure function of the instant.
"""

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from wbgs_jax._util.pytree import AnyArray, pytree, to_device
from wbgs_jax.mesh.edges import Edges, about_edges
from wbgs_jax.mesh.facets import Facets, HalfPlanes, centres, half_planes_of, moved
from wbgs_jax.propagation.image_method import (
    SLACK,
    DiffractedPairs,
    ImageTree,
    ReflectionSequences,
    Surfaces,
    diffracted_pairs,
    grouped,
    reflection_sequences,
)
from wbgs_jax.propagation.mechanisms import MECHANISMS
from wbgs_jax.propagation.occlusion import hierarchy_of, moved_hierarchy
from wbgs_jax.propagation.paths import MAX_ORDER, PathGeometry, TracedPaths, is_vertex, nearly_valid, on_edge
from wbgs_jax.propagation.transport import last_segment, segments_of
from wbgs_jax.radio.array import EXACT
from wbgs_jax.radio.geometry import rotation_matrix, rotation_quaternion


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


STEP_M = 0.25
"""Metres by which anything moves between instants at which reflection sequences are found; facets and edges are enlarged by as
much, so that none is missed in between."""

Rows = Int[np.ndarray, "_ _"]


@dataclasses.dataclass(frozen=True)
class _Rigid:
    """Rigid displacements of K points or planes: rotations about centres, then shifts."""

    rotation: Float[Array, "k 3 3"]
    centre: Float[Array, "k 3"]
    shift: Float[Array, "k 3"]

    def of(self, index: Int[AnyArray, " n"]) -> "_Rigid":
        return _Rigid(self.rotation[index], self.centre[index], self.shift[index])

    def vectors(self, vectors: Float[AnyArray, "*n k 3"]) -> Float[Array, "*n k 3"]:
        return jnp.einsum("kij,...kj->...ki", self.rotation, jnp.asarray(vectors), precision=EXACT)

    def points(self, points: Float[AnyArray, "*n k 3"]) -> Float[Array, "*n k 3"]:
        points = jnp.asarray(points)
        arms = points - self.centre
        return points + (self.vectors(arms) - arms) + self.shift  # exact where nothing moves

    def offsets(
        self, before: Float[AnyArray, "*n k 3"], after: Float[Array, "*n k 3"], offset: Float[AnyArray, "*n k"]
    ) -> Float[Array, "*n k"]:
        """Offsets of planes whose normals were `before` and are `after`."""
        return jnp.asarray(offset) + jnp.sum((after - before) * self.centre + after * self.shift, -1)


def tree_over_time(
    facets: Facets,
    edges: Edges,
    receiver_position: Float[AnyArray, "3"],
    tx_position: Float[AnyArray, "t 3"],
    motion: Motion,
    mirror_areas: tuple[float, ...],
    mirror_area_after_edge: float,
    mirror_area_before_edge: float,
) -> ImageTree:
    """Returns an image tree with all reflection sequences and pairs that may occur during a movement (host).

    Args:
        facets, edges: at their nominal positions.
        receiver_position: nominal position, world frame, metres.
        tx_position: of the transmitter at T instants.
        motion: displacements from the nominal positions at these instants, (t, m, 3) and (t, 3).
        mirror_areas, mirror_area_after_edge, mirror_area_before_edge: as in `image_method.make_image_tree`.

    Returns:
        The tree at the nominal positions; `tree_at` moves it.
    """
    rx = np.asarray(receiver_position, np.float64)
    instants = _instants(facets, rx, tx_position, motion)
    movement = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64)[instants], motion)
    sequences, after = [], []
    for number in range(len(instants)):
        now = jax.tree.map(lambda leaf, i=number: leaf[i], movement)
        there, here = moved(facets, now.shift, now.turn), rx + now.receiver
        wedges = jax.tree.map(np.asarray, _moved_edges(edges, facets, now))
        sequences.append([one.facet for one in reflection_sequences(there, here, mirror_areas, SLACK + STEP_M)])
        pairs = diffracted_pairs(there, wedges, here, mirror_area_after_edge, mirror_area_before_edge, SLACK + STEP_M)
        after.append(np.asarray(pairs.after))
    *reflecting, behind = (_united(rows) for rows in (*zip(*sequences, strict=True), after))
    in_front = np.asarray(pairs.before)  # the same at all instants
    half_planes, hierarchy = half_planes_of(facets), hierarchy_of(facets)

    def tree_of(places: list[ReflectionSequences], after: Rows, before: Rows) -> ImageTree:
        """`tree_at` sets the images."""
        diffracted = DiffractedPairs(after, np.zeros((len(after), 3)), np.zeros((2, len(after))), before)
        found: ImageTree = to_device(ImageTree(facets, edges, rx, half_planes, hierarchy, tuple(places), diffracted))
        return found

    tree = tree_of([ReflectionSequences(one, np.zeros((*one.shape, 3))) for one in reflecting], behind, in_front)
    ever = _ever_valid(tree, to_device(np.asarray(tx_position)[instants]), to_device(movement))
    *of_facets, of_behind, of_front = map(np.asarray, ever)
    count = max(edges.length.size, 1)
    of_mirror = np.repeat(of_front.reshape(-1, count).any(1), count)  # all edges of one mirror stay together
    places = [_in_groups(one[mask], facets) for one, mask in zip(reflecting, of_facets, strict=True)]
    return tree_of(places, behind[of_behind], in_front[of_mirror])


def _in_groups(rows: Rows, facets: Facets) -> ReflectionSequences:
    """Returns sequences in groups (`image_method.grouped`). Padding reflects at one facet again and again, which is never a
    path, wherever the facet moves."""
    found = grouped(ReflectionSequences(rows, np.full((*rows.shape, 3), np.nan)), facets)
    real = np.isnan(found.image[:, :1, 0])
    return ReflectionSequences(np.where(real, found.facet, found.facet[:, :1]), np.zeros(found.image.shape))


def _united(rows: Iterable[Rows]) -> Rows:
    """Returns the different rows of several arrays."""
    return np.unique(np.concatenate(list(rows)), axis=0)


@jax.jit
def _ever_valid(tree: ImageTree, tx_position: Float[Array, "t 3"], motion: Motion) -> tuple[Bool[Array, " rows"], ...]:
    """Returns `nearly_valid` at any of T instants."""
    found = jax.lax.map(lambda now: nearly_valid(now[0], tree_at(tree, now[1]), STEP_M), (tx_position, motion))
    return jax.tree.map(lambda mask: mask.any(0), found)


def _instants(
    facets: Facets, rx: Float[np.ndarray, "3"], tx_position: Float[AnyArray, "t 3"], motion: Motion
) -> Int[np.ndarray, " n"]:
    """Returns instants between which nothing moves by more than `STEP_M`: the first, the last, and some in between. A body that
    turns moves whatever is seen in it, up to the farthest corner of the box around surfaces and ends of the link."""
    middles = np.asarray(centres(facets, motion.shift.shape[1]))
    ends = np.asarray(tx_position), rx + np.asarray(motion.receiver), np.asarray(facets.corners).reshape(-1, 3)
    low, high = (reach(np.concatenate(ends), axis=0) for reach in (np.min, np.max))
    radius = np.linalg.norm(np.maximum(high - middles, middles - low), axis=-1)
    places = motion.shift, motion.turn, motion.receiver, tx_position
    shift, turn, receiver, tx = (np.linalg.norm(np.diff(np.asarray(a, np.float64), axis=0), axis=-1) for a in places)
    furthest = np.maximum((shift + radius * turn).max(1, initial=0), np.maximum(receiver, tx))
    travelled = np.concatenate([[0.0], np.cumsum(furthest)])
    _, first = np.unique(np.floor(travelled / STEP_M), return_index=True)
    return np.unique(np.append(first, len(travelled) - 1))


def tree_at(tree: ImageTree, motion: Motion) -> ImageTree:
    """Returns the image tree (`tree_over_time`) at one instant of a movement; pure.

    Args:
        tree: at the nominal positions.
        motion: displacements at this instant, (m, 3) and (3,).
    """
    facets = tree.facets
    rigid = _rigid(facets, motion)
    own = rigid.of(facets.mover)
    normal = own.vectors(facets.normal)
    corners = jnp.moveaxis(own.points(jnp.moveaxis(facets.corners, 1, 0)), 0, 1)
    inward = jnp.moveaxis(tree.half_planes.inward, 1, 0)
    turned = own.vectors(inward)
    half_planes = HalfPlanes(jnp.moveaxis(turned, 0, 1), own.offsets(inward, turned, tree.half_planes.offset.T).T)
    there = dataclasses.replace(
        facets, corners=corners, normal=normal, offset=own.offsets(facets.normal, normal, facets.offset)
    )
    planes = tree.hierarchy.planes.reshape(*tree.hierarchy.planes.shape[:2], -1)
    in_leaves = rigid.of(facets.mover[tree.hierarchy.facet.reshape(-1)])
    sides = jnp.moveaxis(planes[:, :3], 1, 2)
    moved_sides = in_leaves.vectors(sides)
    offsets = in_leaves.offsets(sides, moved_sides, planes[:, 3])
    planes = jnp.concatenate([jnp.moveaxis(moved_sides, 2, 1), offsets[:, None]], 1).reshape(tree.hierarchy.planes.shape)
    rx = jnp.asarray(tree.receiver_position + motion.receiver)
    edges, after = _moved_edges(tree.edges, facets, motion), tree.diffracted.after
    image = _mirrored(there, after[:, 0], rx)
    reach = jnp.stack(about_edges(image.T, jax.tree.map(lambda leaf: leaf[after[:, 1]], edges)))
    return dataclasses.replace(
        tree,
        facets=there,
        edges=edges,
        receiver_position=rx,
        half_planes=half_planes,
        hierarchy=moved_hierarchy(tree.hierarchy, planes, corners),
        sequences=tuple(ReflectionSequences(one.facet, _images(there, one.facet, rx)) for one in tree.sequences),
        diffracted=dataclasses.replace(tree.diffracted, after_image=image, after_reach=reach),
    )


def _rigid(facets: Facets, motion: Motion) -> _Rigid:
    rotation = rotation_matrix(rotation_quaternion(jnp.asarray(motion.turn, jnp.float32)))
    return _Rigid(rotation, centres(facets, len(motion.shift)), jnp.asarray(motion.shift, jnp.float32))


def _moved_edges(edges: Edges, facets: Facets, motion: Motion) -> Edges:
    own = _rigid(facets, motion).of(jnp.asarray(facets.mover)[edges.facet])
    vectors = {name: own.vectors(getattr(edges, name)) for name in ("direction", "normal_0", "normal_n")}
    return dataclasses.replace(edges, start=own.points(edges.start), **vectors)


def _mirrored(facets: Facets, mirror: Int[AnyArray, " n"], point: Float[Array, "*n 3"]) -> Float[Array, "n 3"]:
    """Returns points mirrored in the planes of facets."""
    normal = facets.normal[mirror]
    return point - 2 * (jnp.sum(normal * point, -1) - facets.offset[mirror])[:, None] * normal


def _images(facets: Facets, mirrors: Int[AnyArray, "n m"], rx: Float[Array, "3"]) -> Float[Array, "n m 3"]:
    """Returns the images of the receiver in reflection sequences (`ReflectionSequences.image`)."""
    images, image = [], rx
    for mirror in reversed(mirrors.T):
        image = _mirrored(facets, mirror, image)
        images.append(image)
    return jnp.stack(images[::-1], 1)
