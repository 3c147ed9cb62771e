"""Intersections of straight segments with facets.

A segment from p to q crosses a convex facet if p and q lie on different sides of its plane, h(p) h(q) < 0, and the point
between them, (|h(q)| p + |h(p)| q) / (|h(p)| + |h(q)|), lies inside its four sides. The sum represents the point, so no
division is needed.

`crossed` tests every segment with every facet: the reference. `crossings` finds the same intersections in a hierarchy of boxes
(`hierarchy_of`), where a segment visits only what is inside the boxes that it meets (Kay and Kajiya, SIGGRAPH 1986). The tests
of a level give one bit per box; the bits of all segments together are the visits of the next level, which are made in chunks,
so that they need no memory of their own.

A set of unknown size has no place in a compiled program. Its bits do (`packed`), and `in_chunks` goes through them a fixed
number at a time, as often as there are any.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from wbgs_jax._util.pytree import AnyArray, pytree
from wbgs_jax.mesh.facets import CORNERS, Facets, half_planes_of

WORD = 32
"""Bits per word."""


class Members(NamedTuple):
    """Bits that are set in words, numbered from the lowest of the first word to the highest of the last."""

    words: UInt32[Array, " n"]
    ends: Int[Array, " n"]
    """Number of them in a word and all before it."""


def packed(bits: Bool[Array, "*n f"], width: int = WORD) -> UInt32[Array, "*n words"]:
    """Returns bits in words of a width, padded to whole words: bit f is bit f % width of word f // width."""
    bits = jnp.pad(bits, [(0, 0)] * (bits.ndim - 1) + [(0, -bits.shape[-1] % width)])
    values = jnp.left_shift(jnp.uint32(1), jnp.arange(width, dtype=jnp.uint32))
    return jnp.sum(jnp.where(bits.reshape(*bits.shape[:-1], bits.shape[-1] // width, width), values, 0), -1, dtype=jnp.uint32)


def first_of(words: UInt32[Array, " words"], most: int) -> tuple[Int[Array, " most"], Bool[Array, " most"]]:
    """Returns the indices of the first `most` set bits, ascending, and a mask of those that exist; 0 for the others."""
    place = jnp.arange(len(words))

    def take(left, _):
        word = jnp.min(jnp.where(left != 0, place, len(words) - 1))  # a plain minimum: argmin takes ten times as long on a CPU
        bits = left[word]
        lowest = jax.lax.population_count(~bits & (bits - 1)).astype(jnp.int32)
        return left.at[word].set(bits & (bits - 1)), (jnp.where(bits != 0, word * WORD + lowest, 0), bits != 0)

    return jax.lax.scan(take, words, length=most)[1]


def members(words: UInt32[Array, " n"]) -> Members:
    """Returns the bits that are set."""
    return Members(words, jnp.cumsum(jax.lax.population_count(words).astype(jnp.int32)))


def located(some: Members, number: Int[Array, " k"]) -> tuple[Int[Array, " k"], Int[Array, " k"], Bool[Array, " k"]]:
    """Returns the word of each bit by its number, its place in the word, and whether there is such a bit."""
    word = jnp.minimum(jnp.searchsorted(some.ends, number, side="right"), len(some.words) - 1)
    bits, place = some.words[word], jnp.zeros_like(number)
    rank = number - (some.ends[word] - jax.lax.population_count(bits).astype(jnp.int32))
    for half in (16, 8, 4, 2, 1):
        lower = jax.lax.population_count((bits >> place.astype(jnp.uint32)) & jnp.uint32((1 << half) - 1)).astype(jnp.int32)
        beyond = rank >= lower
        place, rank = place + jnp.where(beyond, half, 0), rank - jnp.where(beyond, lower, 0)
    return word, place, number < some.ends[-1]


def in_chunks(
    some: Members, size: int, function: Callable[[Int[Array, " k"], Int[Array, " k"], Bool[Array, " k"], Any], Any], found: Any
) -> Any:
    """Returns what a function has found after all bits: it receives word and place of `size` bits at a time, a mask of those
    that exist, and what was found before. It cannot be differentiated in reverse mode."""

    if not len(some.words):
        return found

    def further(state: Any) -> Any:
        first, found = state
        return first + size, function(*located(some, first + jnp.arange(size)), found)

    return jax.lax.while_loop(lambda state: state[0] < some.ends[-1], further, (jnp.zeros((), int), found))[1]


NEAR = 1e-3
"""Metres: a segment does not cross facets within this distance of its ends (those that reflect it)."""
LEAF = 8
"""Facets per leaf."""
NOWHERE = 1.0
"""Offset (metres) of padding: a plane without a normal, which nothing crosses."""
FEW_BLOCKS = 8
"""Blocks up to which all leaves are tested: fewer steps."""


@pytree
class FacetHierarchy:
    """Facets in leaves of `LEAF`, and leaves in blocks of `WORD`, with boxes around them. World frame, metres."""

    block_low: Float[AnyArray, "3 words"]
    """Lowest corners of the blocks, padded to whole words, ..."""
    block_high: Float[AnyArray, "3 words"]
    """... and highest."""
    leaf_low: Float[AnyArray, "blocks 3 32"]
    leaf_high: Float[AnyArray, "blocks 3 32"]
    planes: Float[AnyArray, "5 4 leaves 8"]
    """Planes of the facets of a leaf (`planes_of`)."""
    facet: Int[AnyArray, "leaves 8"]
    """Their indices."""


class Crossings(NamedTuple):
    """Facets that N paths cross."""

    total: Int[Array, " n"]
    """Number of intersections."""
    visit: Int[Array, "n most"]
    """The first leaves in which there are any, in the order of segments: index of the segment times the number of leaves, plus
    index of the leaf."""
    bits: UInt32[Array, "n most"]
    """Which facets of that leaf are crossed, a bit each."""


def planes_of(facets: Facets) -> Float[np.ndarray, "5 4 f"]:
    """Returns the planes of all facets and the half-planes of their four sides (float64): unit normals and offsets, with facets
    along the last axis, padded to whole words."""
    half_planes = half_planes_of(facets)
    rows = np.zeros((CORNERS + 1, 4, -(-len(facets.offset) // WORD) * WORD))
    rows[:, 3] = NOWHERE
    count = len(facets.offset)
    rows[0, :3, :count], rows[0, 3, :count] = np.asarray(facets.normal).T, facets.offset
    rows[1:, :3, :count], rows[1:, 3, :count] = np.moveaxis(np.asarray(half_planes.inward), 0, -1), half_planes.offset.T
    return rows


def hierarchy_of(facets: Facets) -> FacetHierarchy:
    """Returns the hierarchy of facets (float64 and int32 NumPy arrays)."""
    corners = np.asarray(facets.corners, np.float64)
    order = _clustered(np.concatenate([corners.min(1), corners.max(1)], 1), np.arange(len(corners)))
    blocks = max(-(-len(order) // (LEAF * WORD)), 1)
    there = np.arange(blocks * WORD * LEAF) < len(order)
    facet = np.append(order, np.zeros(len(there) - len(order), int)).astype(np.int32)
    planes = np.where(there, planes_of(facets)[..., facet], np.array([0, 0, 0, NOWHERE])[:, None])
    leaves = facet.reshape(-1, LEAF)
    boxes = _boxes(corners, leaves, there.reshape(-1, LEAF), np)
    return FacetHierarchy(*boxes, planes.reshape(CORNERS + 1, 4, -1, LEAF), leaves)


def moved_hierarchy(
    hierarchy: FacetHierarchy, planes: Float[Array, "5 4 leaves 8"], corners: Float[Array, "f 4 3"]
) -> FacetHierarchy:
    """Returns the hierarchy of the same facets elsewhere; pure.

    Args:
        hierarchy: of the facets where they were.
        planes: where they are, in the order of `FacetHierarchy.planes`.
        corners: where they are, in the order of the facets.
    """
    there = jnp.any(planes[0, :3] != 0, 0)  # padding has no normal
    return FacetHierarchy(*_boxes(corners, hierarchy.facet, there, jnp), planes, hierarchy.facet)


def _boxes(
    corners: Float[AnyArray, "f 4 3"], facet: Int[AnyArray, "leaves 8"], there: Bool[AnyArray, "leaves 8"], xp: Any
) -> tuple[
    Float[AnyArray, "3 words"], Float[AnyArray, "3 words"], Float[AnyArray, "blocks 3 32"], Float[AnyArray, "blocks 3 32"]
]:
    """Returns lowest and highest corners of blocks, then of leaves (`FacetHierarchy`). `there` excludes padding; `xp` is the
    module of the arrays."""
    # Boxes are enlarged by millimetres and by a fraction of the largest coordinate, so that rounding loses no intersection.
    margin, own, real = 2e-3 + 1e-5 * xp.max(xp.abs(corners)), corners[facet], there[..., None]
    far = 1e9  # coordinates (metres) of the boxes of padding, which no segment reaches
    low = xp.where(real, own.min(2) - margin, far).min(1).reshape(-1, WORD, 3)
    high = xp.where(real, own.max(2) + margin, -far).max(1).reshape(-1, WORD, 3)
    both = (low.min(1), high.max(1)), (low, high)
    of_blocks, of_leaves = ((lowest, xp.where(highest < lowest, far, highest)) for lowest, highest in both)  # padding: nowhere
    missing = (0, -len(low) % WORD), (0, 0)
    block_low, block_high = (xp.pad(box, missing, constant_values=far).T for box in of_blocks)
    leaf_low, leaf_high = (box.swapaxes(1, 2) for box in of_leaves)
    return block_low, block_high, leaf_low, leaf_high


def _clustered(box: Float[np.ndarray, "f 6"], facet: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """Returns facets in an order in which neighbours share a leaf and neighbouring leaves a block: halved, again and again,
    where their boxes differ most. Boxes differ in size, too, so that large facets do not enlarge the leaves of small ones."""
    if len(facet) <= LEAF:
        return facet
    size = LEAF * WORD if len(facet) > LEAF * WORD else LEAF
    half = -(-len(facet) // (2 * size)) * size
    parts = np.argpartition(box[facet, np.ptp(box[facet], 0).argmax()], half - 1)
    return np.concatenate([_clustered(box, facet[some]) for some in (parts[:half], parts[half:])])


def crossings(
    points: Float[Array, "n p 3"], living: Bool[Array, " n"], hierarchy: FacetHierarchy, most: int, near: float = NEAR
) -> Crossings:
    """Returns which facets the segments of paths cross; not differentiated.

    Args:
        points: consecutive points of N paths, world frame, metres; segments without a length cross nothing.
        living: paths that are tested; the others cross nothing.
        hierarchy: of the facets.
        most: number of leaves returned for each path.
        near: metres from the ends of a segment within which it crosses nothing.
    """
    points = jax.lax.stop_gradient(points)
    count, each, leaves = len(points), points.shape[1] - 1, len(hierarchy.facet)
    start, end = points[:, :-1].reshape(-1, 3), points[:, 1:].reshape(-1, 3)
    real = jnp.repeat(living, each) & jnp.any(start != end, -1)

    blocks_at_once, leaves_at_once = 512, 1024  # visits in a chunk

    def in_leaves(visits: Members, place: _Place, found: _Found) -> _Found:
        def further(word: Array, bit: Array, there: Array, found: _Found) -> _Found:
            own, leaf = place(word, bit)
            planes = [[part[leaf] for part in plane] for plane in hierarchy.planes]
            hit = _inside(start[own, :, None], end[own, :, None], planes, near) & there[:, None]
            return _noted(found, own // each, own % each * leaves + leaf, packed(hit, LEAF)[:, 0])

        return in_chunks(visits, leaves_at_once, further, found)

    def in_blocks(visits: Members, place: _Place, found: _Found) -> _Found:
        def further(word: Array, bit: Array, there: Array, found: _Found) -> _Found:
            own, block = place(word, bit)
            met = _meets(start[own], end[own], hierarchy.leaf_low[block], hierarchy.leaf_high[block]) & there[:, None]
            return in_leaves(members(packed(met)[:, 0]), lambda word, bit: (own[word], block[word] * WORD + bit), found)

        return in_chunks(visits, blocks_at_once, further, found)

    low, high, visit = hierarchy.block_low, hierarchy.block_high, in_blocks
    if len(hierarchy.leaf_low) <= FEW_BLOCKS:
        low, high = (jnp.moveaxis(jnp.asarray(box), 1, 0).reshape(3, -1) for box in (hierarchy.leaf_low, hierarchy.leaf_high))
        visit = in_leaves
    words = packed(_meets(start, end, low, high) & real[:, None])
    width = words.shape[1]
    nothing = jnp.zeros(count, int), jnp.zeros(count, int), jnp.zeros((count, most), int), jnp.zeros((count, most), jnp.uint32)
    total, _, visited, bits = visit(
        members(words.reshape(-1)), lambda word, bit: (word // width, word % width * WORD + bit), nothing
    )
    return Crossings(total, visited, bits)


def listed(
    found: Crossings, hierarchy: FacetHierarchy
) -> tuple[Int[Array, "n most"], Int[Array, "n most"], Bool[Array, "n most"]]:
    """Returns segment and facet of the first crossings of every path, and which of them there are, in ascending order."""
    most, leaves = found.visit.shape[1], len(hierarchy.facet)
    number, there = jax.vmap(lambda bits: first_of(bits, most))(found.bits)
    segment, leaf = jnp.divmod(jnp.take_along_axis(found.visit, number // WORD, 1), leaves)
    facet = hierarchy.facet[leaf, number % WORD]
    order = jnp.lexsort((facet, segment, ~there), axis=-1)
    return tuple(jnp.take_along_axis(of, order, 1) for of in (segment, facet, there))  # type: ignore[return-value]


_Found = tuple[Array, ...]
"""Fields of `Crossings`, and after the first of them the number of leaves that they have."""
_Place = Callable[[Array, Array], tuple[Array, Array]]
"""(word, place of a bit in it) -> segment, and what the bit stands for."""


def _noted(found: _Found, path: Int[Array, " k"], visit: Int[Array, " k"], word: UInt32[Array, " k"]) -> _Found:
    """Returns what is found with further visits, in the order of paths, and the bits of each: those without a bit are left
    out, and those that a path has no room for are only counted."""
    total, used, visits, bits = found
    some = (word != 0).astype(jnp.int32)
    before = jnp.cumsum(some) - some
    first = jnp.full(total.shape, len(path)).at[path].min(before)  # that of the path in this chunk
    slot = jnp.where(some > 0, used[path] + before - first[path], visits.shape[1])
    return (
        total.at[path].add(jax.lax.population_count(word).astype(jnp.int32)),
        used.at[path].add(some),
        visits.at[path, slot].set(visit, mode="drop"),
        bits.at[path, slot].set(word, mode="drop"),
    )


def _meets(
    start: Float[Array, "s 3"], end: Float[Array, "s 3"], low: Float[AnyArray, "*s 3 b"], high: Float[AnyArray, "*s 3 b"]
) -> Bool[Array, "s b"]:
    """Returns which segments meet which boxes: those that are inside between all three pairs of planes at once."""
    extent = end - start
    no_extent = 1e-12  # metres: smallest extent of a segment along an axis, since it is divided by
    inverse = 1 / jnp.where(jnp.abs(extent) < no_extent, no_extent, extent)
    enter, leave = jnp.zeros((), start.dtype), jnp.ones((), start.dtype)
    for axis in range(3):
        sides = [(side[..., axis, :] - start[:, axis, None]) * inverse[:, axis, None] for side in (low, high)]
        enter, leave = jnp.maximum(enter, jnp.minimum(*sides)), jnp.minimum(leave, jnp.maximum(*sides))
    return enter <= leave


def crossed(
    points: Float[Array, "p 3"], planes: Float[AnyArray, "5 4 f"], near: float = NEAR
) -> UInt32[Array, "segments words"]:
    """Returns which facets the segments between consecutive points cross, one bit each: facet f is bit f % 32 of word f // 32.

    Args:
        points: world frame, metres.
        planes: of the facets (`planes_of`).
        near: metres from the ends of a segment within which it crosses nothing.
    """
    return packed(_inside(points[:-1, :, None], points[1:, :, None], jnp.asarray(planes), near))


def _inside(
    start: Float[Array, "segments 3 1"], end: Float[Array, "segments 3 1"], planes: Any, near: float
) -> Bool[Array, "segments f"]:
    """Returns whether segments cross facets."""
    here, there = _height(start, planes[0]), _height(end, planes[0])
    before, behind = jnp.abs(here), jnp.abs(there)
    nearest = near / jnp.maximum(jnp.linalg.norm(end - start, axis=1), near) * (before + behind)
    inside = (here * there < 0) & (before > nearest) & (behind > nearest)
    for side in planes[1:]:
        inside &= _height(start, side) * behind + _height(end, side) * before >= 0
    return inside


def _height(point: Float[Array, "segments 3 1"], plane: Any) -> Float[Array, "segments f"]:
    """Returns signed distances of points from planes. Written out, so that it is fused into its uses and never stored."""
    return point[:, 0] * plane[0] + point[:, 1] * plane[1] + point[:, 2] * plane[2] - plane[3]


def crossing_share(
    start: Float[Array, "*n 3"], end: Float[Array, "*n 3"], facet: Int[Array, "*n"], facets: Facets
) -> Float[Array, "*n"]:
    """Returns the fraction of their length at which segments meet the planes of facets; undefined for a segment in the
    plane."""
    normal, offset = facets.normal[facet], facets.offset[facet]
    here, there = (jnp.sum(normal * point, -1) - offset for point in (start, end))
    return here / jnp.where(here == there, 1, here - there)
