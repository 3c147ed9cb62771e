"""Geometry of the paths from a transmitter to the receiver: straight segments between facets that reflect the wave and edges
that diffract it, through facets that transmit it.

Every reflection sequence of `image_method.py` gives at most one specular path, every edge at most one diffracted path for each
mirror in front of it or behind it. The most promising candidates are tested for intersections with all facets, and the
strongest of those that pass are kept. The geometry depends neither on the frequency nor on the materials, and is not
differentiated.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from wbgs_jax._util.pytree import AnyArray, pytree, static, with_leaves
from wbgs_jax.mesh.edges import Edges, about_edges
from wbgs_jax.mesh.facets import CORNERS, Facets, HalfPlanes
from wbgs_jax.propagation.image_method import GROUP, ImageTree, ReflectionSequences
from wbgs_jax.propagation.occlusion import NEAR, WORD, crossing_share, crossings, in_chunks, listed, members, packed
from wbgs_jax.radio.array import EXACT

MAX_ORDER = 3
"""Maximum number of reflections and diffractions of a path."""
MAX_INTERACTIONS = 5
"""Maximum number of facets and edges that a path interacts with; a wave that has crossed more of them is negligible."""
FEW_ROWS, SCORED_AT_ONCE = 4096, 512
"""Rows up to which all are scored, and candidates scored together where there are more."""
SLACK = 5e-3
"""Metres by which facets and edges are enlarged in cheap tests, so that rounding loses no candidate."""
THROUGH = 0.5
"""Rough amplitude factor of a crossed or reflecting facet, used to rank paths."""


class InteractionType(IntEnum):
    """Type of the interaction of a wave with a facet or an edge."""

    word: str
    """Preposition of a description: through a wall, off a floor, around the edge of a cabinet."""
    sionna: int
    """Value of `sionna.rt.InteractionType`."""
    is_vertex: bool
    """Whether a segment of the path ends there."""
    on_edge: bool
    """Whether paths refer to the index of an edge, not of a facet."""

    def __new__(
        cls, value: int, word: str = "", sionna: int = 0, is_vertex: bool = False, on_edge: bool = False
    ) -> "InteractionType":
        kind = int.__new__(cls, value)
        kind._value_ = value
        kind.word, kind.sionna, kind.is_vertex, kind.on_edge = word, sionna, is_vertex, on_edge
        return kind

    NONE = 0
    TRANSMITTED = 1, "through", 4
    REFLECTED = 2, "off", 1, True
    DIFFRACTED = 3, "around", 8, True, True
    SCATTERED = 4, "scattered by", 2, True  # in paths of other programs


NONE, TRANSMITTED = InteractionType.NONE, InteractionType.TRANSMITTED
REFLECTED, DIFFRACTED = InteractionType.REFLECTED, InteractionType.DIFFRACTED


def is_vertex(interaction_type: Int[AnyArray, "*n"]) -> Bool[AnyArray, "*n"]:
    """Returns which interactions end a segment: all but transmissions and padding."""
    return functools.reduce(operator.or_, (interaction_type == kind for kind in InteractionType if kind.is_vertex))


def on_edge(interaction_type: Int[AnyArray, "*n"]) -> Bool[AnyArray, "*n"]:
    """Returns which interactions are with an edge."""
    return functools.reduce(operator.or_, (interaction_type == kind for kind in InteractionType if kind.on_edge))


@pytree
class PathGeometry:
    """K paths of one transmitter; leading axes are batch axes."""

    points: Float[Array, "*b k 5 3"]
    """Transmitter, points of reflection or diffraction, receiver; the receiver fills the rest. World frame, metres."""
    interaction_facet: Int[Array, "*b k 5"]
    """Indices of the facets (of edges, where the type is `on_edge`) in the order of interaction; 0 beyond the last."""
    interaction_type: Int[Array, "*b k 5"]
    """`InteractionType`; `NONE` beyond the last."""
    interaction_segment: Int[Array, "*b k 5"]
    """Index of the segment (0: the first) that ends or is crossed there."""
    alive: Bool[Array, "*b k"]
    """Which of the K entries are paths; the others are padding."""
    mechanism: str = static(default="specular")
    """Name of the mechanism of all of them (`mechanisms.MECHANISMS`)."""


@pytree
class TracedPaths:
    """All paths of one transmitter; leading axes are batch axes."""

    sets: tuple[PathGeometry, ...]
    """Paths of each mechanism, in the order of `mechanisms.MECHANISMS`."""

    def of(self, mechanism: str) -> PathGeometry:
        """Returns the paths of a mechanism by its name."""
        return next(paths for paths in self.sets if paths.mechanism == mechanism)

    @property
    def specular(self) -> PathGeometry:
        """Paths without diffraction, including the line of sight."""
        return self.of("specular")

    @property
    def diffracted(self) -> PathGeometry:
        """Paths with one diffraction each."""
        return self.of("diffracted")

    @property
    def together(self) -> PathGeometry:
        """Paths of all mechanisms, in order, as one set; of one transmitter, without batch axes."""
        leaves = (jnp.concatenate(parts) for parts in zip(*map(jax.tree.leaves, self.sets), strict=True))
        return with_leaves(self.sets[0], *leaves)

    @property
    def alive(self) -> Bool[Array, "*b k"]:
        """Which of the paths of all mechanisms, in order, are no padding."""
        return jnp.concatenate([paths.alive for paths in self.sets], -1)


class Candidates(NamedTuple):
    """Paths before the test of occlusion."""

    points: Float[Array, "c 5 3"]
    interaction_facet: Int[Array, "c 3"]
    interaction_type: Int[Array, "c 3"]
    score: Float[Array, " c"]
    """Rough amplitude; 0 for no path."""


def specular_paths(tx: Float[Array, "3"], tree: ImageTree, tried: int, kept: int) -> PathGeometry:
    """Returns the `kept` strongest paths without diffraction, including the line of sight, of at most `tried` candidates."""
    parts = [_direct(tx, tree.receiver_position)]
    parts += [promising(_mirrored, tx, tree, sequences, tried, _may_reflect) for sequences in tree.sequences]
    return select_paths("specular", parts, tree, tried, kept, MAX_ORDER + 1)


def diffracted_paths(tx: Float[Array, "3"], tree: ImageTree, tried: int, kept: int) -> PathGeometry:
    """Returns the `kept` strongest paths with one diffraction and at most one reflection, of at most `tried` candidates."""
    pairs, edge = tree.diffracted, jnp.arange(tree.edges.length.size)
    parts = [
        promising(_diffracted_only, tx, tree, edge, tried, _may_diffract),
        promising(_diffracted_then_mirrored, tx, tree, (pairs.after, pairs.after_image), tried, _may_diffract_first),
        promising(_mirrored_then_diffracted, tx, tree, pairs.before, tried, _may_diffract_last),
    ]
    return select_paths("diffracted", parts, tree, tried, kept, 3)


def nearly_valid(tx: Float[Array, "3"], tree: ImageTree, slack: float) -> tuple[Bool[Array, " rows"], ...]:
    """Returns masks of the reflection sequences of each order and, last, of the pairs behind and in front of edges: those that
    would give a candidate if facets and edges were larger by `slack` metres on all sides."""
    half_planes, edges = tree.half_planes, tree.edges
    larger = dataclasses.replace(
        tree,
        half_planes=dataclasses.replace(half_planes, offset=half_planes.offset - slack),
        edges=dataclasses.replace(
            edges,
            start=edges.start - slack * edges.direction,
            length=jnp.where(edges.length > 0, edges.length + 2 * slack, 0),
        ),
    )
    pairs = tree.diffracted
    found = [_mirrored(tx, larger, sequences) for sequences in tree.sequences]
    found.append(_diffracted_then_mirrored(tx, larger, (pairs.after, pairs.after_image)))
    found.append(_mirrored_then_diffracted(tx, larger, pairs.before))
    return tuple(one.score > 0 for one in found)


def _may_reflect(tx, tree: ImageTree, sequences: ReflectionSequences) -> Bool[Array, " c"]:
    """Returns which sequences may be those of a path: the line to the first image meets the first facet. Sequences of a group
    begin with the same one, so that its sides are read once."""
    group = GROUP if sequences.facet.shape[1] > 1 else 1
    facet = sequences.facet[::group, 0]
    x, y, z = (sequences.image[:, 0, axis].reshape(-1, group) for axis in range(3))

    def heights(normal, offset):
        """Returns the heights of the transmitter (groups, 1) and of the images (groups, size) above planes."""
        a, b, c = (normal[:, axis, None] for axis in range(3))
        return a * tx[0] + b * tx[1] + c * tx[2] - offset[:, None], a * x + b * y + c * z - offset[:, None]

    near, beyond = heights(tree.facets.normal[facet], tree.facets.offset[facet])
    may = near * beyond < 0
    for side in range(CORNERS):
        one, other = heights(tree.half_planes.inward[facet, side], tree.half_planes.offset[facet, side] - SLACK)
        may &= one * jnp.abs(beyond) + other * jnp.abs(near) >= 0
    return may.reshape(-1)


def _may_diffract(tx, tree: ImageTree, edge: Int[Array, " e"]) -> Bool[Array, " e"]:
    """Returns which edges may be those of a path: Keller's point lies on the edge, and both directions are outside the
    wedge."""
    source, goal = (about_edges(point[:, None], tree.edges) for point in (tx, jnp.asarray(tree.receiver_position)))
    return _on_edge(source, goal, tree.edges.length)


def _may_diffract_first(tx, tree: ImageTree, rows) -> Bool[Array, " c"]:
    """Returns the same for pairs of an edge and a mirror behind it."""
    edge = rows[0][:, 1]
    source = tuple(of[edge] for of in about_edges(tx[:, None], tree.edges))
    return _on_edge(source, tree.diffracted.after_reach, tree.edges.length[edge])


def _may_diffract_last(tx, tree: ImageTree, pairs) -> Bool[Array, " c"]:
    """Returns the same for pairs of an edge and a mirror in front of it."""
    images = _images(tx, tree.facets, pairs[:: tree.edges.length.size, 0])
    source, goal = (about_edges(p, tree.edges) for p in (images.T[:, :, None], tree.receiver_position[:, None]))
    return _on_edge(source, goal, tree.edges.length).reshape(-1)


def _on_edge(source, goal, length: Float[AnyArray, " c"]) -> Bool[Array, "*b c"]:
    """Returns whether Keller's points lie on edges, from the places and distances of both ends (`about_edges`)."""
    (t_in, r_in), (t_out, r_out) = source, goal
    t = t_in + (t_out - t_in) * r_in / (r_in + r_out)  # not a number within the wedge
    return (t > -SLACK) & (t < length + SLACK) & (length > 0)


def _diffracted_only(tx, tree: ImageTree, edge: Int[Array, " c"]) -> Candidates:
    """Returns one candidate per edge."""
    point, strength = _diffracted(tx, tree.receiver_position, edge, tree.edges)
    return make_candidates(tx, tree.receiver_position, [(point, edge, DIFFRACTED)], strength, edge.size)


def _diffracted_then_mirrored(tx, tree: ImageTree, rows) -> Candidates:
    """Returns one candidate per pair of an edge and a mirror behind it."""
    pairs, image = rows
    facet, edge = jnp.moveaxis(pairs, -1, 0)
    point, strength = _diffracted(tx, image, edge, tree.edges)
    mirror, valid = _on_mirror(point, image, tree.facets.normal[facet], tree.facets.offset[facet])
    strength = jnp.where(valid & _inside(mirror, tree.half_planes, facet), strength * THROUGH, 0)
    vertices = [(point, edge, DIFFRACTED), (mirror, facet, REFLECTED)]
    return make_candidates(tx, tree.receiver_position, vertices, strength, edge.size)


def _mirrored_then_diffracted(tx, tree: ImageTree, pairs) -> Candidates:
    """Returns one candidate per pair of an edge and a mirror in front of it."""
    facet, edge = jnp.moveaxis(pairs, -1, 0)
    normal, offset, image = tree.facets.normal[facet], tree.facets.offset[facet], _images(tx, tree.facets, facet)
    point, strength = _diffracted(image, tree.receiver_position, edge, tree.edges)
    # Relative to the image, the point must lie behind the mirror: the wave runs from the transmitter to the point of
    # reflection.
    mirror, valid = _on_mirror(point, image, normal, offset)
    strength = jnp.where(valid & _inside(mirror, tree.half_planes, facet), strength * THROUGH, 0)
    vertices = [(mirror, facet, REFLECTED), (point, edge, DIFFRACTED)]
    return make_candidates(tx, tree.receiver_position, vertices, strength, edge.size)


def _images(tx, facets: Facets, mirror: Int[Array, " c"]) -> Float[Array, "c 3"]:
    """Returns the transmitter mirrored in the planes of facets."""
    normal = facets.normal[mirror]
    return tx - 2 * (jnp.matmul(normal, tx, precision=EXACT) - facets.offset[mirror])[:, None] * normal


def make_candidates(tx, rx, vertices, score, count: int) -> Candidates:
    """Returns candidates from their vertices (point, facet or edge, type of interaction) in order."""

    def rows(value, shape):
        return jnp.broadcast_to(value, (count, *shape))

    points = [tx, *(point for point, _, _ in vertices)]
    points += [rx] * (MAX_ORDER + 2 - len(points))
    missing = MAX_ORDER - len(vertices)
    facet = jnp.stack([*(rows(facet, ()) for _, facet, _ in vertices), *[jnp.zeros(count, int)] * missing], 1)
    types = rows(jnp.array([of_type for _, _, of_type in vertices] + [NONE] * missing), (MAX_ORDER,))
    return Candidates(jnp.stack([rows(p, (3,)) for p in points], 1), facet, types, rows(score, ()))


def _direct(tx, rx) -> Candidates:
    """Returns the line of sight as a candidate; there is none if the transmitter is at the receiver's position."""
    distance = jnp.linalg.norm(jax.lax.stop_gradient(tx - rx))
    return make_candidates(tx, rx, [], jnp.where(distance > NEAR, 1 / jnp.maximum(distance, NEAR), 0), 1)


def _mirrored(tx, tree: ImageTree, sequences: ReflectionSequences) -> Candidates:
    """Returns one candidate per reflection sequence."""
    facets, (c, order) = tree.facets, sequences.facet.shape
    here, valid = jnp.broadcast_to(tx, (c, 3)), jnp.ones(c, bool)
    vertices = []
    for j in range(order):
        facet = sequences.facet[:, j]
        here, hits = _on_mirror(here, sequences.image[:, j], facets.normal[facet], facets.offset[facet])
        valid &= hits & _inside(here, tree.half_planes, facet)
        vertices.append((here, facet, REFLECTED))
    length = jnp.linalg.norm(sequences.image[:, 0] - tx, axis=-1)
    return make_candidates(tx, tree.receiver_position, vertices, valid * THROUGH**order / jnp.maximum(length, NEAR), c)


def _on_mirror(start, goal, normal, offset):
    """Returns the points where the lines from `start` to the images `goal` meet the planes of mirrors, and whether they do."""
    height, beyond = (jnp.sum(normal * p, -1) - offset for p in (start, goal))
    share = height / jnp.where(height == beyond, 1, height - beyond)
    valid = (height * beyond < 0) & (jnp.abs(height) > NEAR) & (jnp.abs(beyond) > NEAR)
    return start + jnp.clip(share, 0, 1)[..., None] * (goal - start), valid


def _length(vector: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    """Returns the lengths of vectors, at least `NEAR`: a zero length has no gradient, and nearer points are no candidates."""
    return jnp.sqrt(jnp.maximum(jnp.sum(vector**2, -1), NEAR**2))


def _inside(point: Float[Array, "*n 3"], half_planes: HalfPlanes, facet: Int[AnyArray, "*n"]) -> Bool[Array, "*n"]:
    """Returns whether points of a facet's plane lie inside its sides."""
    return (jnp.sum(half_planes.inward[facet] * point[..., None, :], -1) >= half_planes.offset[facet]).all(-1)


def _diffracted(source, goal, edge: Int[Array, " c"], edges: Edges):
    """Returns the point where the shortest path over an edge touches it (Keller's cone), and a rough amplitude, 0 if
    invalid."""
    start, along = edges.start[edge], edges.direction[edge]

    def place(p):
        t = jnp.sum((p - start) * along, -1)
        return t, _length(p - start - t[..., None] * along)

    (t_in, r_in), (t_out, r_out) = place(source), place(goal)
    t = t_in + (t_out - t_in) * r_in / jnp.maximum(r_in + r_out, NEAR)
    point = start + t[..., None] * along
    normal_0, normal_n = edges.normal_0[edge], edges.normal_n[edge]
    valid = (t > 0) & (t < edges.length[edge]) & (jnp.minimum(r_in, r_out) > NEAR)
    for p in (source, goal):
        valid &= jnp.maximum(jnp.sum((p - point) * normal_0, -1), jnp.sum((p - point) * normal_n, -1)) > NEAR
    before, after = (_length(p - point) for p in (source, goal))
    flat_in, flat_out = source - point, goal - point
    flat_in -= jnp.sum(flat_in * along, -1, keepdims=True) * along
    flat_out -= jnp.sum(flat_out * along, -1, keepdims=True) * along
    turn = jnp.sum(flat_in * flat_out, -1) / jnp.maximum(r_in * r_out, NEAR**2)
    # Keller's coefficient falls as the direction departs from the shadow boundary, along which the wave goes straight on.
    strength = 1 / jnp.sqrt(jnp.maximum(before * after * (before + after), NEAR)) / jnp.sqrt(0.5 * (1 + turn) + 0.02)
    return point, jnp.where(valid, strength, 0)


def select_paths(
    mechanism: str, parts: list[Candidates], tree: ImageTree, tried: int, kept: int, segments: int
) -> PathGeometry:
    """Returns the best paths of a mechanism among its best candidates, after these have been tested for intersections with all
    facets.

    Args:
        mechanism: its name.
        parts: candidates of all kinds.
        tree: image tree of the receiver.
        tried: number of candidates that are tested.
        kept: number of paths returned; fewer if fewer are tried.
        segments: largest number of segments of a path.
    """
    candidates = Candidates(*(jnp.concatenate(leaves) for leaves in zip(*parts, strict=True)))
    found = _best(candidates, candidates.score, tried)
    crossed = crossings(found.points[:, : segments + 1], found.score > 0, tree.hierarchy, MAX_INTERACTIONS)
    whole = crossed.total + jnp.sum(found.interaction_type != NONE, -1) <= MAX_INTERACTIONS
    score, best = jax.lax.top_k(jnp.where(whole, found.score * THROUGH**crossed.total, 0), min(kept, found.score.size))
    found, crossed = jax.tree.map(lambda leaf: leaf[best], (found, crossed))
    facet, types, segment = jax.vmap(lambda path, met: _in_order(path, met, tree.facets))(
        found, listed(crossed, tree.hierarchy)
    )
    return PathGeometry(found.points, facet, types, segment, score > 0, mechanism)


def promising(
    build: Callable[..., Candidates], tx, tree: ImageTree, rows: Any, most: int, may: Callable[..., Bool[Array, " c"]]
) -> Candidates:
    """Returns the best candidates of a kind.

    Args:
        build: (transmitter, image tree, rows) -> one candidate per row.
        tx, tree: the transmitter and the image tree of the receiver.
        rows: all rows.
        most: number of candidates.
        may: with the same arguments, a cheap test. If there are many rows, only those are scored that it leaves over, and only
            the best of them are built.
    """
    fixed, count = jax.lax.stop_gradient(tx), len(jax.tree.leaves(rows)[0])

    def further(word, bit, there, found):
        row = jnp.minimum(word * WORD + bit, count - 1)
        score = build(fixed, tree, _rows(rows, row)).score
        return found.at[jnp.where(there, row, count)].set(score, mode="drop")

    if count > FEW_ROWS:
        some = members(packed(may(fixed, tree, rows)))
        score = in_chunks(some, SCORED_AT_ONCE, further, jnp.zeros(count, tx.dtype))
    else:
        score = build(fixed, tree, rows).score
    return build(tx, tree, _rows(rows, jax.lax.top_k(score, min(most, count))[1]))


def _rows(tree: Any, row: Int[Array, " k"]) -> Any:
    return jax.tree.map(lambda leaf: leaf[row], tree)


def _best(candidates: Candidates, score: Float[Array, " c"], most: int) -> Candidates:
    """Returns the candidates with the highest scores, best first, together with these scores."""
    score, best = jax.lax.top_k(score, min(most, score.size))
    return jax.tree.map(lambda leaf: leaf[best], candidates)._replace(score=score)


def _in_order(candidate: Candidates, crossed, facets: Facets):
    """Returns the interactions of one path in order: facet or edge, type, segment."""
    segment, facet, crosses = crossed
    share = crossing_share(candidate.points[segment], candidate.points[segment + 1], facet, facets)
    vertex, types = jnp.arange(MAX_ORDER), candidate.interaction_type
    # Smallest fraction of a segment at which a crossing counts, so that it comes after the interaction at the segment's start.
    behind = 1e-6
    crossing = jnp.where(crosses, segment + jnp.clip(share, behind, 1), jnp.inf)
    order = jnp.argsort(jnp.concatenate([crossing, jnp.where(types != NONE, vertex + 1.0, jnp.inf)]))[:MAX_INTERACTIONS]
    interactions = jnp.where(crosses, TRANSMITTED, NONE), types
    met = jnp.where(crosses, facet, 0), candidate.interaction_facet
    types, facet, segment = (jnp.concatenate(both)[order] for both in (interactions, met, (segment, vertex)))
    return jnp.where(types != NONE, facet, 0), types, jnp.where(types != NONE, segment, 0)
