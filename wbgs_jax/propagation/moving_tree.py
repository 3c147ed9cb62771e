"""Rigid bodies and receivers that move far: the image tree of every instant of a movement.

`displacement.py` changes the lengths of known paths to first order. Here surfaces, edges and images are moved exactly, and
paths are traced again at every instant, so that they appear and vanish. A movement is a `Motion` with a leading axis of
instants. The reflection sequences that may occur are found once, on the host, at instants between which nothing moves by more
than `STEP_M`; what remains is a pure function of the instant (`tree_at`).
"""

import dataclasses
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from wbgs_jax._util.pytree import to_device
from wbgs_jax.mesh.edges import Edges, about_edges
from wbgs_jax.mesh.facets import AnyArray, Facets, HalfPlanes, centres, half_planes_of, moved
from wbgs_jax.propagation.displacement import Motion
from wbgs_jax.propagation.image_method import (
    SLACK,
    DiffractedPairs,
    ImageTree,
    ReflectionSequences,
    diffracted_pairs,
    grouped,
    reflection_sequences,
)
from wbgs_jax.propagation.occlusion import hierarchy_of, moved_hierarchy
from wbgs_jax.propagation.paths import nearly_valid
from wbgs_jax.radio.array import EXACT
from wbgs_jax.radio.geometry import rotation_matrix, rotation_quaternion

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
    instants = _instants(facets, tx_position, motion)
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


def _instants(facets: Facets, tx_position: Float[AnyArray, "t 3"], motion: Motion) -> Int[np.ndarray, " n"]:
    """Returns instants between which nothing moves by more than `STEP_M`: the first, the last, and some in between."""
    bodies = motion.shift.shape[1]
    arms = np.linalg.norm(
        np.asarray(facets.corners) - np.asarray(centres(facets, bodies))[np.asarray(facets.mover)][:, None], axis=-1
    )
    radius = np.zeros(bodies)
    np.maximum.at(radius, np.asarray(facets.mover), arms.max(1))
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
