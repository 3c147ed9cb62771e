"""The receiver's mirror images: every chain of facets that a wave can be reflected by on its way to a fixed receiver.

A chain (f1, ..., fm) names the facets in the order in which the wave meets them; its images are the receiver mirrored in fm,
then in f(m-1), and so on: towards them the wave travels in straight lines. The receiver is fixed, so all chains are found once,
on the host, and serve every transmitter and frequency. A chain is kept if its facets can be seen through one another from the
image: occlusion is the business of `paths.py`.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from wbgs_jax.pytree import pytree
from wbgs_jax.wave.edges import Edges
from wbgs_jax.wave.facets import CORNERS, AnyArray, Facets, areas

SIDE = 1e-4
"""Metres: points nearer to a plane than this are on neither side."""


@pytree
class Chains:
    """All chains of one order m >= 1."""

    facet: Int[AnyArray, "chains m"]
    """In the order in which the wave meets them."""
    image: Float[AnyArray, "chains m 3"]
    """Where the wave heads for before it meets facet j: the receiver, mirrored in facets m ... j."""


@pytree
class DiffractedChains:
    """Pairs of a mirror and an edge. A mirror behind the edge can be seen from the receiver; one in front of it may be any
    large facet, because the transmitter may be anywhere."""

    after: Int[AnyArray, "a 2"]
    """(facet, edge): first diffracted, then reflected."""
    after_image: Float[AnyArray, "a 3"]
    """The receiver mirrored in the facet."""
    before: Int[AnyArray, "b 2"]
    """(facet, edge): first reflected, then diffracted."""


def diffracted_chains(
    facets: Facets, edges: Edges, rx: Float[np.ndarray, "3"], after_area: float, before_area: float, slack: float = 0.05
) -> DiffractedChains:
    """Mirrors of at least so many square metres, behind and in front of every edge."""
    area = areas(facets)
    corners, normal, offset = (np.asarray(a, np.float64) for a in (facets.corners, facets.normal, facets.offset))
    start, end = edges.start, edges.start + edges.direction * edges.length[:, None]
    segment = np.stack([start, end, end, end], 1)
    after, images = [], []
    for facet in np.flatnonzero(area >= after_area):
        height = normal[facet] @ rx - offset[facet]
        if abs(height) > SIDE:
            image = rx - 2 * height * normal[facet]
            seen = np.arange(len(segment))
            seen = seen[_in_beam(image, rx, facet, segment, corners, normal, offset, slack)]
            after.append(np.stack([np.full(len(seen), facet), seen], 1))
            images.append(np.broadcast_to(image, (len(seen), 3)))
    mirrors = np.flatnonzero(area >= before_area)
    before = np.stack(np.meshgrid(mirrors, np.arange(len(segment)), indexing="ij"), -1).reshape(-1, 2)
    pairs = np.concatenate([np.zeros((0, 2), int), *after])
    arrays: Any = (pairs.astype(np.int32), np.concatenate([np.zeros((0, 3)), *images]), before.astype(np.int32))
    return DiffractedChains(*arrays)


def receiver_chains(
    facets: Facets, rx: Float[np.ndarray, "3"], min_areas: tuple[float, ...], slack: float = 0.05
) -> tuple[Chains, ...]:
    """Chains of orders 1, 2, ... len(min_areas). `min_areas[m - 1]` (square metres) is the smallest facet of a chain of order
    m; `slack` (metres) widens the facets, so that rounding loses none."""
    area = areas(facets)
    corners, normal, offset = (np.asarray(a, np.float64) for a in (facets.corners, facets.normal, facets.offset))
    chains = []
    arrays: Any
    facet = np.zeros((1, 0), np.int64)
    image = np.broadcast_to(np.asarray(rx, np.float64), (1, 1, 3))  # the last one of a row is the receiver
    for smallest in min_areas:
        large = np.flatnonzero(area >= smallest)
        keep = np.isin(facet, large).all(-1)
        facet, image = _prepend(facet[keep], image[keep], large, corners, normal, offset, slack)
        arrays = (facet.astype(np.int32), image[:, :-1])
        chains.append(Chains(*arrays))
    return tuple(chains)


def _prepend(facet, image, candidates, corners, normal, offset, slack):
    """Every chain with every facet in front of it that its beam reaches."""
    grown_facet, grown_image = [], []
    for chain, images in zip(facet, image, strict=True):
        source = images[0]
        visible = candidates
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
    """Which candidates (four corners each) are not wholly outside the beam from the image `source` through the facet `window`:
    on the side of the window where `before`, which `source` is the mirror image of, lies, and inside the planes through the
    source and the window's edges."""
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
