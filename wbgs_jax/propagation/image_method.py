"""The receiver's mirror images: every chain of facets that a wave can be reflected by on its way to a fixed receiver.

A chain (f1, ..., fm) names the facets in the order in which they reflect the wave; its images are the receiver mirrored in fm,
then in f(m-1), and so on: towards them the wave travels in straight lines. The receiver is fixed, so all chains are found once,
on the host, and serve every transmitter and frequency (`make_search`). A chain is kept if its facets can be seen through one
another from the image: occlusion is the business of `paths.py`.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wbgs_jax._util.pytree import pytree
from wbgs_jax.propagation.edges import Edges
from wbgs_jax.propagation.facets import CORNERS, AnyArray, Facets, Outline, areas, outline_of

SIDE = 1e-4
"""Metres: points nearer to a plane than this are on neither side."""
SLACK = 0.05
"""Metres by which facets are widened, so that rounding loses no chain."""


@pytree
class Chains:
    """All chains of one order m >= 1."""

    facet: Int[AnyArray, "chains m"]
    """In the order in which they reflect the wave."""
    image: Float[AnyArray, "chains m 3"]
    """Where the wave heads for before facet j reflects it: the receiver, mirrored in facets m ... j. World frame, metres."""


@pytree
class DiffractedChains:
    """Pairs of a mirror and an edge.

    A mirror behind the edge can be seen from the receiver; one in front of it may be any large facet, because the transmitter
    may be anywhere.
    """

    after: Int[AnyArray, "a 2"]
    """(facet, edge): first diffracted, then reflected."""
    after_image: Float[AnyArray, "a 3"]
    """The receiver mirrored in the facet. World frame, metres."""
    before: Int[AnyArray, "b 2"]
    """(facet, edge): first reflected, then diffracted."""


@pytree
class Search:
    """What a receiver's paths are searched in: independent of the transmitter and of the frequency."""

    receiver_position: Float[AnyArray, "3"]
    """World frame, metres."""
    facets: Facets
    outline: Outline
    edges: Edges
    chains: tuple[Chains, ...]
    """Of orders 1, 2, ..."""
    diffracted: DiffractedChains


def make_search(
    facets: Facets,
    edges: Edges,
    receiver_position: Float[AnyArray, "3"],
    mirror_areas: Sequence[float],
    mirror_area_after_edge: float,
    mirror_area_before_edge: float,
) -> Search:
    """Returns what the paths of a receiver are searched in; found on the host in double precision, so not under `jax.jit`.

    Args:
        facets, edges: of the scene, on the host or on the device.
        receiver_position: world frame, metres.
        mirror_areas: smallest facets that reflect on paths of 1, 2, ... reflections, square metres each.
        mirror_area_after_edge: smallest facet that reflects a wave after an edge has diffracted it, square metres.
        mirror_area_before_edge: smallest facet that reflects a wave before an edge diffracts it, square metres.

    Returns:
        float32 and int32 arrays on the device.
    """
    facets, edges = jax.tree.map(_on_host, (facets, edges))
    rx = np.asarray(receiver_position, np.float64)
    search = Search(
        rx,
        facets,
        outline_of(facets),
        edges,
        receiver_chains(facets, rx, mirror_areas),
        diffracted_chains(facets, edges, rx, mirror_area_after_edge, mirror_area_before_edge),
    )
    return jax.tree.map(_on_device, search)


def _on_host(leaf: AnyArray) -> np.ndarray:
    """Returns an array with float64 positions or int32 indices."""
    array = np.asarray(leaf)
    return array.astype(np.float64 if np.issubdtype(array.dtype, np.floating) else np.int32)


def _on_device(leaf: AnyArray) -> Array:
    """Returns an array with float32 positions or int32 indices."""
    return jnp.asarray(leaf, jnp.float32 if np.issubdtype(leaf.dtype, np.floating) else jnp.int32)


def receiver_chains(
    facets: Facets, rx: Float[np.ndarray, "3"], min_areas: Sequence[float], slack: float = SLACK
) -> tuple[Chains, ...]:
    """Returns the chains of orders 1, 2, ... len(min_areas) as float64 and int32 NumPy arrays.

    Args:
        facets: of the scene.
        rx: position of the receiver, world frame, metres.
        min_areas: `min_areas[m - 1]` (square metres) is the smallest facet of a chain of order m.
        slack: metres by which facets are widened, so that rounding loses none.
    """
    area = areas(facets)
    corners, normal, offset = (np.asarray(a, np.float64) for a in (facets.corners, facets.normal, facets.offset))
    chains = []
    facet = np.zeros((1, 0), np.int64)
    image = np.broadcast_to(np.asarray(rx, np.float64), (1, 1, 3))  # the last one of a row is the receiver
    for smallest in min_areas:
        large = np.flatnonzero(area >= smallest)
        keep = np.isin(facet, large).all(-1)
        facet, image = _prepend(facet[keep], image[keep], large, corners, normal, offset, slack)
        chains.append(Chains(facet.astype(np.int32), image[:, :-1]))
    return tuple(chains)


def diffracted_chains(
    facets: Facets, edges: Edges, rx: Float[np.ndarray, "3"], after_area: float, before_area: float, slack: float = SLACK
) -> DiffractedChains:
    """Returns the mirrors of at least so many square metres behind and in front of every edge (float64 and int32 NumPy arrays).

    Args:
        facets, edges: of the scene.
        rx: position of the receiver, world frame, metres.
        after_area, before_area: smallest mirror behind an edge and in front of one, square metres.
        slack: metres by which facets are widened, so that rounding loses none.
    """
    area = areas(facets)
    corners, normal, offset = (np.asarray(a, np.float64) for a in (facets.corners, facets.normal, facets.offset))
    start, end = edges.start, edges.start + edges.direction * edges.length[:, None]
    segment = np.stack([start, end, end, end], 1)
    after, images = [np.zeros((0, 2), int)], [np.zeros((0, 3))]
    for facet in np.flatnonzero(area >= after_area):
        height = normal[facet] @ rx - offset[facet]
        if abs(height) > SIDE:
            image = rx - 2 * height * normal[facet]
            seen = np.flatnonzero(_in_beam(image, rx, facet, segment, corners, normal, offset, slack))
            after.append(np.stack([np.full(len(seen), facet), seen], 1))
            images.append(np.broadcast_to(image, (len(seen), 3)))
    mirrors = np.flatnonzero(area >= before_area)
    before = np.stack(np.meshgrid(mirrors, np.arange(len(segment)), indexing="ij"), -1).reshape(-1, 2)
    return DiffractedChains(np.concatenate(after).astype(np.int32), np.concatenate(images), before.astype(np.int32))


def _prepend(facet, image, candidates, corners, normal, offset, slack):
    """Returns every chain with every facet in front of it that its beam reaches: facets and images."""
    grown_facet = [np.zeros((0, facet.shape[1] + 1), np.int64)]
    grown_image = [np.zeros((0, image.shape[1] + 1, 3))]
    for chain, images in zip(facet, image, strict=True):
        source = images[0]
        height = normal[candidates] @ source - offset[candidates]
        visible = candidates[np.abs(height) > SIDE]
        if len(chain):
            visible = visible[visible != chain[0]]
            visible = visible[_in_beam(source, images[1], chain[0], corners[visible], corners, normal, offset, slack)]
        mirrored = source - 2 * (normal[visible] @ source - offset[visible])[:, None] * normal[visible]
        grown_facet.append(np.concatenate([visible[:, None], np.broadcast_to(chain, (len(visible), len(chain)))], 1))
        grown_image.append(np.concatenate([mirrored[:, None], np.broadcast_to(images, (len(visible), *images.shape))], 1))
    return np.concatenate(grown_facet), np.concatenate(grown_image)


def _in_beam(source, before, window, candidates, corners, normal, offset, slack):
    """Returns which candidates (four corners each) are not wholly outside the beam from the image `source` through a facet.

    The beam is on the side of the facet `window` where `before`, which `source` is the mirror image of, lies, and inside the
    planes through the source and the window's sides.
    """
    centre = corners[window].mean(0)
    planes, distances = [], []
    side = np.sign(normal[window] @ before - offset[window])
    planes.append(side * normal[window])
    distances.append(side * offset[window])
    for i in range(CORNERS):
        a, b = corners[window][i], corners[window][(i + 1) % CORNERS]
        across = np.cross(a - source, b - source)
        length = np.linalg.norm(across)
        if length < 1e-12:
            continue
        across = across / length
        across = across if across @ (centre - source) > 0 else -across
        planes.append(across)
        distances.append(across @ source)
    height = candidates @ np.array(planes).T - np.array(distances)  # (candidates, 4, planes)
    return (height.max(1) > np.array([SIDE] + [-slack] * (len(planes) - 1))).all(-1)
