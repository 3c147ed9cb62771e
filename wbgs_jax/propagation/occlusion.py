"""Intersections of straight segments with facets: one bit for every segment and facet, 32 facets per word.

A segment from p to q crosses a convex facet if p and q lie on different sides of its plane, h(p) h(q) < 0, and the point
between them, (|h(q)| p + |h(p)| q) / (|h(p)| + |h(q)|), lies inside its four sides. The sum represents the point, so no
division is needed. Only the bits are kept: counting them is cheap, and the few facets that a path crosses are read from them
afterwards.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from wbgs_jax.mesh.facets import CORNERS, AnyArray, Facets, half_planes_of

NEAR = 1e-3
"""Metres: a segment does not cross facets within this distance of its ends (those that reflect it)."""
WORD = 32
"""Facets per word."""
NOWHERE = 1.0
"""Offset (metres) of the padding of the last word: a plane without a normal, which nothing crosses."""


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


def crossed(
    points: Float[Array, "p 3"], planes: Float[AnyArray, "5 4 f"], near: float = NEAR
) -> UInt32[Array, "segments words"]:
    """Returns which facets the segments between consecutive points cross, one bit each: facet f is bit f % 32 of word f // 32.

    Args:
        points: world frame, metres.
        planes: of the facets (`planes_of`).
        near: metres from the ends of a segment within which it crosses nothing.
    """
    start, end, planes = points[:-1, :, None], points[1:, :, None], jnp.asarray(planes)
    here, there = _height(start, planes[0]), _height(end, planes[0])
    before, behind = jnp.abs(here), jnp.abs(there)
    nearest = near / jnp.maximum(jnp.linalg.norm(end - start, axis=1), near) * (before + behind)
    inside = (here * there < 0) & (before > nearest) & (behind > nearest)
    for side in planes[1:]:
        inside &= _height(start, side) * behind + _height(end, side) * before >= 0
    return _packed(inside)


def _height(point: Float[Array, "segments 3 1"], plane: Float[Array, "4 f"]) -> Float[Array, "segments f"]:
    """Returns signed distances of points from planes. Written out, so that it is fused into its uses and never stored."""
    return point[:, 0] * plane[0] + point[:, 1] * plane[1] + point[:, 2] * plane[2] - plane[3]


def _packed(bits: Bool[Array, "*n f"]) -> UInt32[Array, "*n words"]:
    values = jnp.left_shift(jnp.uint32(1), jnp.arange(WORD, dtype=jnp.uint32))
    return jnp.sum(jnp.where(bits.reshape(*bits.shape[:-1], -1, WORD), values, 0), -1, dtype=jnp.uint32)


def counted(words: UInt32[Array, "*n words"]) -> Int[Array, "*n"]:
    """Returns the number of bits that are set."""
    return jnp.sum(jax.lax.population_count(words).astype(jnp.int32), -1)


def first_of(words: UInt32[Array, " words"], most: int) -> tuple[Int[Array, " most"], Bool[Array, " most"]]:
    """Returns the indices of the first `most` set bits, ascending, and a mask of those that exist; 0 for the others."""
    place = jnp.arange(len(words))

    def take(left, _):
        word = jnp.min(jnp.where(left != 0, place, len(words) - 1))  # a plain minimum: argmin takes ten times as long on a CPU
        bits = left[word]
        lowest = jax.lax.population_count(~bits & (bits - 1)).astype(jnp.int32)
        return left.at[word].set(bits & (bits - 1)), (jnp.where(bits != 0, word * WORD + lowest, 0), bits != 0)

    return jax.lax.scan(take, words, length=most)[1]


def crossing_share(
    start: Float[Array, "*n 3"], end: Float[Array, "*n 3"], facet: Int[Array, "*n"], planes: Float[AnyArray, "5 4 f"]
) -> Float[Array, "*n"]:
    """Returns the fraction of their length at which segments meet the planes of facets; undefined for a segment in the
    plane."""
    normal, offset = planes[0, :3].T[facet], planes[0, 3][facet]
    here, there = (jnp.sum(normal * point, -1) - offset for point in (start, end))
    return here / jnp.where(here == there, 1, here - there)
