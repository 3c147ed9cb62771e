"""Image method: every sequence of facets that can reflect a wave on its way to a fixed receiver.

A reflection sequence (`ReflectionSequences`) names its facets (f1, ..., fm) in the order in which they reflect the wave. Its
images are the receiver mirrored in fm, then in f(m-1), and so on; the wave travels in straight lines towards them. The receiver
is fixed, so all sequences are found once, on the host, and serve every transmitter and frequency (`make_image_tree`). A
sequence is kept if its facets are visible through one another from the image; occlusion is tested in `paths.py`.
"""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from wbgs_jax._util.pytree import AnyArray, pytree, to_device
from wbgs_jax.mesh.edges import Edges, about_edges, filled
from wbgs_jax.mesh.facets import CORNERS, Facets, HalfPlanes, areas, half_planes_of
from wbgs_jax.propagation.occlusion import FacetHierarchy, hierarchy_of

SIDE = 1e-4
"""Metres: points nearer to a plane than this count as lying on neither side."""
SLACK = 0.05
"""Metres by which facets are enlarged, so that rounding loses no sequence."""
GROUP = 8
"""Reflection sequences in a group, which begin with the same facet."""
MOST_TRIED = 10_000_000
"""Maximum number of pairs of a sequence and a further mirror that are examined per order, ..."""
MOST_PAIRS = 1_000_000
"""... and of pairs of a mirror and an edge. If there are more, as between the facades of a whole city, the smallest mirrors are
left out."""


@pytree
class ReflectionSequences:
    """All reflection sequences of one order m >= 1."""

    facet: Int[AnyArray, "sequences m"]
    """Indices of the facets in the order in which they reflect the wave."""
    image: Float[AnyArray, "sequences m 3"]
    """Point that the wave heads for before facet j reflects it: the receiver, mirrored in facets m ... j. World frame,
    metres."""


@pytree
class DiffractedPairs:
    """Pairs of a mirror and an edge.

    A mirror behind the edge must be visible from the receiver; one in front of it may be any large facet, because the
    transmitter may be anywhere.
    """

    after: Int[AnyArray, "a 2"]
    """(facet, edge): first diffracted, then reflected."""
    after_image: Float[AnyArray, "a 3"]
    """The receiver mirrored in the facet. World frame, metres."""
    after_reach: Float[AnyArray, "2 a"]
    """Where this image lies along the edge, and its distance from the edge's line, metres (`about_edges`)."""
    before: Int[AnyArray, "b 2"]
    """(facet, edge): first reflected, then diffracted. All edges, of one mirror after the other."""


@pytree
class Surfaces:
    """Facets and edges that waves interact with; the same for every receiver. Paths refer to them by index."""

    facets: Facets
    edges: Edges


@pytree
class ImageTree(Surfaces):
    """Image tree of a receiver, in which its paths are searched: independent of the transmitter and of the frequency."""

    receiver_position: Float[AnyArray, "3"]
    """World frame, metres."""
    half_planes: HalfPlanes
    """Half-planes along the sides of the facets."""
    hierarchy: FacetHierarchy
    """The facets in boxes, for the test of occlusion."""
    sequences: tuple[ReflectionSequences, ...]
    """Reflection sequences of orders 1, 2, ..."""
    diffracted: DiffractedPairs


def make_image_tree(
    facets: Facets,
    edges: Edges,
    receiver_position: Float[AnyArray, "3"],
    mirror_areas: Sequence[float],
    mirror_area_after_edge: float,
    mirror_area_before_edge: float,
    padded: bool = False,
) -> ImageTree:
    """Returns the image tree of a receiver, computed on the host in double precision (not under `jax.jit`).

    Args:
        facets, edges: of the scene, on the host or on the device.
        receiver_position: world frame, metres.
        mirror_areas: smallest facet that reflects on paths of 1, 2, ... reflections, square metres each.
        mirror_area_after_edge: smallest facet that reflects a wave after an edge has diffracted it, square metres.
        mirror_area_before_edge: smallest facet that reflects a wave before an edge diffracts it, square metres.
        padded: whether sequences and pairs are padded to sizes that rarely change (mesh/edges.py).

    Returns:
        float32 and int32 arrays on the device.
    """
    facets, edges = jax.tree.map(_on_host, (facets, edges))
    rx = np.asarray(receiver_position, np.float64)
    sequences = tuple(grouped(one, facets) for one in reflection_sequences(facets, rx, mirror_areas))
    pairs = diffracted_pairs(facets, edges, rx, mirror_area_after_edge, mirror_area_before_edge)
    if padded:
        sequences, pairs = tuple(_padded(one, facets) for one in sequences), _padded_pairs(pairs, facets)
    found: ImageTree = to_device(ImageTree(facets, edges, rx, half_planes_of(facets), hierarchy_of(facets), sequences, pairs))
    return found


def grouped(sequences: ReflectionSequences, facets: Facets) -> ReflectionSequences:
    """Returns sequences of more than one facet in groups of `GROUP` that begin with the same one (host), with padding that
    reflects nothing: its images lie in the planes of its facets."""
    if sequences.facet.shape[1] == 1:
        return sequences
    count = np.unique(sequences.facet[:, 0], return_counts=True)[1]
    room = -(-count // GROUP) * GROUP
    place = np.arange(room.sum()) - np.repeat(np.cumsum(room) - room, room)  # in the groups of one facet
    order = np.argsort(sequences.facet[:, 0], kind="stable")
    row = order[np.repeat(np.cumsum(count) - count, room) + np.minimum(place, np.repeat(count, room) - 1)]
    facet, there = sequences.facet[row], place < np.repeat(count, room)
    nowhere = np.asarray(facets.corners)[facet, 0]
    return ReflectionSequences(facet, np.where(there[:, None, None], sequences.image[row], nowhere))


def _padded(sequences: ReflectionSequences, facets: Facets) -> ReflectionSequences:
    """Returns the sequences, followed by padding that reflects nothing; groups stay whole."""
    group = GROUP if sequences.facet.shape[1] > 1 else 1
    facet = filled(sequences.facet.reshape(-1, group, sequences.facet.shape[1])).reshape(-1, sequences.facet.shape[1])
    return ReflectionSequences(facet, _in_the_plane(sequences.image, facets, facet))


def _padded_pairs(pairs: DiffractedPairs, facets: Facets) -> DiffractedPairs:
    """Returns the pairs; those with a mirror behind the edge are followed by padding that reflects nothing. The number of the
    others already follows from the padded edges."""
    after = filled(pairs.after)
    reach = np.pad(pairs.after_reach, ((0, 0), (0, len(after) - len(pairs.after))), constant_values=np.nan)
    return DiffractedPairs(after, _in_the_plane(pairs.after_image, facets, after[:, 0]), reach, pairs.before)


def _in_the_plane(image: Float[AnyArray, "*n 3"], facets: Facets, mirror: Int[np.ndarray, "*k"]) -> Float[np.ndarray, "*k 3"]:
    """Returns images, followed by points in the mirrors' own planes, which no wave heads for."""
    return np.concatenate([image, np.asarray(facets.corners)[mirror[len(image) :], 0]])


def _on_host(leaf: AnyArray) -> np.ndarray:
    """Returns an array on the host, with float64 positions or int32 indices."""
    array = np.asarray(leaf)
    return array.astype(np.float64 if np.issubdtype(array.dtype, np.floating) else np.int32)


def reflection_sequences(
    facets: Facets, rx: Float[np.ndarray, "3"], min_areas: Sequence[float], slack: float = SLACK
) -> tuple[ReflectionSequences, ...]:
    """Returns the reflection sequences of orders 1, 2, ... len(min_areas) as float64 and int32 NumPy arrays.

    Args:
        facets: of the scene.
        rx: position of the receiver, world frame, metres.
        min_areas: `min_areas[m - 1]` (square metres) is the smallest facet in a sequence of order m.
        slack: metres by which facets are enlarged, so that rounding loses no sequence.
    """
    area = areas(facets)
    largest_first = np.argsort(-area, kind="stable")
    corners, normal, offset = (np.asarray(a, np.float64) for a in (facets.corners, facets.normal, facets.offset))
    sequences = []
    facet = np.zeros((1, 0), np.int64)
    image = np.broadcast_to(np.asarray(rx, np.float64), (1, 1, 3))  # the last one of a row is the receiver
    for smallest in min_areas:
        large, keep = _limit_mirrors(facet, largest_first[: np.count_nonzero(area >= smallest)])
        facet, image = _prepend(facet[keep], image[keep], large, corners, normal, offset, slack)
        sequences.append(ReflectionSequences(facet.astype(np.int32), image[:, :-1]))
    return tuple(sequences)


def _limit_mirrors(
    facet: Int[np.ndarray, "sequences m"], mirrors: Int[np.ndarray, " k"]
) -> tuple[Int[np.ndarray, " large"], Bool[np.ndarray, " sequences"]]:
    """Returns as many of the mirrors (largest first) as can be tried in front of every sequence made of them alone within
    `MOST_TRIED` pairs, in ascending order; and a mask of those sequences."""
    rank = np.full(max(facet.max(initial=-1), mirrors.max(initial=-1)) + 1, len(mirrors))
    rank[mirrors] = np.arange(len(mirrors))
    worst = rank[facet].max(-1, initial=-1)  # rank of the smallest mirror of every sequence
    sequences_of = np.cumsum(np.bincount(worst + 1, minlength=len(mirrors) + 1))  # made of the first 0, 1, ... mirrors
    count = int(np.searchsorted(np.arange(len(mirrors) + 1) * sequences_of[: len(mirrors) + 1], MOST_TRIED, "right")) - 1
    return np.sort(mirrors[:count]), worst < count


def diffracted_pairs(
    facets: Facets, edges: Edges, rx: Float[np.ndarray, "3"], after_area: float, before_area: float, slack: float = SLACK
) -> DiffractedPairs:
    """Returns the pairs of an edge and a mirror behind or in front of it (float64 and int32 NumPy arrays).

    Args:
        facets, edges: of the scene.
        rx: position of the receiver, world frame, metres.
        after_area, before_area: smallest mirror behind an edge and in front of one, square metres.
        slack: metres by which facets are enlarged, so that rounding loses none.
    """
    area = areas(facets)
    corners, normal, offset = (np.asarray(a, np.float64) for a in (facets.corners, facets.normal, facets.offset))
    start, end = edges.start, edges.start + edges.direction * edges.length[:, None]
    segment = np.stack([start, end, end, end], 1)
    real = edges.length > 0  # the others are padding
    most = MOST_PAIRS // max(int(np.count_nonzero(real)), 1)
    largest_first = np.argsort(-area, kind="stable")
    mirrors = np.sort(largest_first[: min(np.count_nonzero(area >= after_area), most)])
    height = normal[mirrors] @ rx - offset[mirrors]
    image = rx - 2 * height[:, None] * normal[mirrors]
    inside = _inside_beams(image, np.broadcast_to(rx, image.shape), mirrors, segment, corners, normal, offset, slack)
    place, edge = np.nonzero(inside & (np.abs(height) > SIDE)[:, None] & real)
    after = np.stack([mirrors[place], edge], 1)
    mirrors = np.sort(largest_first[: min(np.count_nonzero(area >= before_area), most)])
    before = np.stack(np.meshgrid(mirrors, np.arange(len(segment)), indexing="ij"), -1).reshape(-1, 2)
    reach = np.stack(about_edges(image[place].T, jax.tree.map(lambda leaf: leaf[edge], edges)))
    return DiffractedPairs(after.astype(np.int32), image[place], reach, before.astype(np.int32))


def _prepend(facet, image, candidates, corners, normal, offset, slack):
    """Returns facets and images of every sequence, extended by every facet that its beam reaches."""
    source = image[:, 0]
    height = source @ normal[candidates].T - offset[candidates]  # (sequences, candidates)
    visible = np.abs(height) > SIDE
    if facet.shape[1]:
        visible &= candidates != facet[:, :1]
        visible &= _inside_beams(source, image[:, 1], facet[:, 0], corners[candidates], corners, normal, offset, slack)
    sequence, place = np.nonzero(visible)
    mirror = candidates[place]
    mirrored = source[sequence] - 2 * height[sequence, place, None] * normal[mirror]
    return np.column_stack([mirror, facet[sequence]]), np.concatenate([mirrored[:, None], image[sequence]], 1)


def _inside_beams(source, before, window, candidates, corners, normal, offset, slack):
    """Returns which candidates (four corners each) are not wholly outside the beams from images through facets.

    The beam of an image `source` passes through its facet `window`. It lies on that side of the facet where `before` lies, the
    point of which `source` is the mirror image, and inside the planes through the source and the window's sides.
    """
    planes, distances = _beams(source, before, window, corners, normal, offset)
    lowest = np.array([SIDE] + [-slack] * CORNERS, np.float32)[:, None]
    points = candidates.swapaxes(0, 1).reshape(-1, 3).astype(np.float32)
    inside = np.zeros((len(source), len(candidates)), bool)
    beams_at_once = 64  # beams tested together: few enough for a CPU's cache
    for start in range(0, len(source), beams_at_once):
        some = slice(start, start + beams_at_once)
        height = planes[some].astype(np.float32) @ points.T - distances[some, :, None].astype(np.float32)
        highest = height.reshape(*height.shape[:2], CORNERS, -1).max(-2)
        inside[some] = (highest > lowest).all(1)
    return inside


def _beams(source, before, window, corners, normal, offset):
    """Returns the unit normals into beams (beams, 5, 3) and the offsets of their bounding planes; 0 and -1 for a side of zero
    length."""
    own, first = normal[window], corners[window]
    side = np.sign(np.sum(own * before, -1) - offset[window])
    across = np.cross(first - source[:, None], np.roll(first, -1, 1) - source[:, None])
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    inward = np.sign(np.sum(across * (first.mean(1) - source)[:, None], -1, keepdims=True))
    # Square metres: lower bound on twice the area of the triangle of an image and a facet side that bounds a beam.
    no_length = 1e-12
    across = np.where(length > no_length, across * np.where(inward > 0, 1, -1) / np.maximum(length, no_length), 0)
    distance = np.where(length[..., 0] > no_length, np.sum(across * source[:, None], -1), -1)
    planes = np.concatenate([(side[:, None] * own)[:, None], across], 1)
    return planes, np.concatenate([(side * offset[window])[:, None], distance], 1)
