"""Diffracting edges: where two facets of one body meet at an outer angle (host).

Free edges of single sheets are not wedges and are omitted, as are inner corners of solids. Where two sheets meet, they diffract
the waves on that side on which the angle is an outer one: a room's own corners for waves outside, its reentrant ones within.

Edges, reflection sequences and pairs can be padded to sizes that rarely change: displaced surfaces have slightly different
numbers of them, and every new number would trigger a compilation. Padding never makes a path: padded edges have zero length,
and padded images lie in the plane of their mirror (`image_method.py`).
"""

import dataclasses
from collections import defaultdict
from itertools import combinations
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.spatial import cKDTree

from wbgs_jax._util.pytree import AnyArray, pytree
from wbgs_jax.mesh.facets import CORNERS, FLAT, WELD, Facets, half_planes_of, of_solids

SHARPEST = 0.05
"""Radians: edges with a smaller angle between the normals of their faces are part of a smooth surface."""


@pytree
class Edges:
    """E straight wedges with an exterior angle of more than half a turn."""

    start: Float[AnyArray, "e 3"]
    """World frame, metres."""
    direction: Float[AnyArray, "e 3"]
    """Unit vector; with the 0-face's normal it gives the tangent (normal x direction) that points into that face."""
    length: Float[AnyArray, " e"]
    """Metres."""
    normal_0: Float[AnyArray, "e 3"]
    """Normal of the 0-face that points out of the wedge: of a solid the outward one."""
    normal_n: Float[AnyArray, "e 3"]
    """The same of the n-face."""
    facet: Int[AnyArray, " e"]
    """Index of the 0-face; both faces belong to one body and hence have one material."""


def about_edges(point: Float[AnyArray, "3 *#p"], edges: Edges) -> tuple[Float[AnyArray, "*p"], Float[AnyArray, "*p"]]:
    """Returns where points lie along edges, and their distances from the edges' lines, metres; the distance is not a number
    within the wedge. Coordinates come first, and the edges are the last axis: on a CPU, loops over it are fast."""
    xp = np if isinstance(edges.start, np.ndarray) else jnp

    def dot(a, b):
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    start, direction, normal_0, normal_n = (
        xp.moveaxis(a, -1, 0) for a in (edges.start, edges.direction, edges.normal_0, edges.normal_n)
    )
    away = [point[axis] - start[axis] for axis in range(3)]
    along = dot(away, direction)
    across = [away[axis] - along * direction[axis] for axis in range(3)]
    free = xp.maximum(dot(away, normal_0), dot(away, normal_n)) > 0
    return along, xp.where(free, xp.sqrt(xp.maximum(dot(across, across), WELD**2)), np.nan)


class _Side(NamedTuple):
    """A facet side of non-zero length."""

    facet: int
    start: Float[np.ndarray, "3"]
    end: Float[np.ndarray, "3"]


def edges_of_facets(facets: Facets) -> Edges:
    """Returns the edges (float64 and int32 NumPy arrays) that two facets of one body share, wholly or in part."""
    body, solid, found = np.asarray(facets.body), of_solids(facets), []
    for on_line in _sides_by_line(facets):
        for first, second in combinations(on_line, 2):
            if body[first.facet] == body[second.facet]:
                found += _wedge(first, second, facets, bool(solid[first.facet] and solid[second.facet]))
    columns: Any = list(zip(*found, strict=True)) or [[]] * 6
    shapes = ((-1, 3), (-1, 3), (-1,), (-1, 3), (-1, 3), (-1,))
    arrays: Any = [np.array(column, np.float64).reshape(shape) for column, shape in zip(columns, shapes, strict=True)]
    arrays[5] = arrays[5].astype(np.int32)
    free = ~_covered(Edges(*arrays), facets)
    return Edges(*[array[free] for array in arrays])


def _sides_by_line(facets: Facets) -> list[list[_Side]]:
    """Returns the sides of all facets, grouped by material and straight line."""
    corners, material = np.asarray(facets.corners), np.asarray(facets.material)
    sides = defaultdict(list)
    for i, polygon in enumerate(corners):
        for k in range(CORNERS):
            a, b = polygon[k], polygon[(k + 1) % CORNERS]
            if (length := np.linalg.norm(b - a)) > WELD:
                sides[int(material[i]), *_line(a, (b - a) / length)].append(_Side(i, a, b))
    return list(sides.values())


def _line(point: Float[np.ndarray, "3"], along: Float[np.ndarray, "3"]) -> tuple[int, ...]:
    """Returns a hashable key of a straight line, the same for equal lines up to rounding."""
    first = along[np.argmax(np.abs(along) > 1e-3)]
    along = along if first > 0 else -along
    foot = point - (point @ along) * along
    odd = 0.137  # offset added before rounding, so that round coordinates do not lie on a rounding boundary
    return tuple(int(i) for i in np.round(np.concatenate([along, foot]) * 1e3 + odd))


def _wedge(first: _Side, second: _Side, facets: Facets, solid: bool) -> list[tuple[Any, ...]]:
    """Returns the edge (its fields) where two sides on one line overlap; none if they do not, or if the angle of a solid is an
    inner one. Two sheets have an outer angle on one side, whichever way they face."""
    i, a, b = first
    j, c, d = second
    normal_0, normal_n = np.asarray(facets.normal)[[i, j]]
    centre_0, centre_n = np.asarray(facets.corners)[[i, j]].mean(1)
    height_0, height_n = (centre_n - centre_0) @ normal_0, (centre_0 - centre_n) @ normal_n
    turn = np.arccos(np.clip(normal_0 @ normal_n, -1, 1))
    if solid or turn > np.pi - SHARPEST:  # or the two sides of a screen
        bends = max(height_0, height_n) < 0 and turn > SHARPEST
    else:
        bends = np.linalg.norm(np.cross(normal_0, normal_n)) > np.sin(SHARPEST)
        normal_0, normal_n = -np.sign(height_0) * normal_0, -np.sign(height_n) * normal_n
    if not bends:
        return []
    length = np.linalg.norm(b - a)
    along = (b - a) / length
    low, high = sorted((float((c - a) @ along), float((d - a) @ along)))
    low, high = max(low, 0.0), min(high, float(length))
    if high - low <= 10 * WELD:
        return []
    sign = 1 if np.cross(normal_0, along) @ (centre_0 - a) > 0 else -1
    start = a + along * (low if sign > 0 else high)
    return [(start, sign * along, high - low, normal_0, normal_n, i)]


def _covered(edges: Edges, facets: Facets) -> Bool[np.ndarray, " e"]:
    """Returns whether another surface closes the gap in front of an edge, or that an edge of sheets is the end of a third one
    between its two faces: neither joints between bodies nor junctions of walls diffract."""
    out = edges.normal_0 + edges.normal_n
    out = out / np.maximum(
        np.linalg.norm(out, axis=-1, keepdims=True), WELD
    )  # the outward direction between the two faces of a sheet is zero
    middle = edges.start + edges.direction * edges.length[:, None] / 2
    corners, half_planes = np.asarray(facets.corners), half_planes_of(facets)
    centre, covered, sheet = corners.mean(1), np.zeros(len(middle), bool), ~of_solids(facets)[edges.facet]
    gap = 0.006  # metres: surfaces nearer than this are joined
    radius = np.linalg.norm(corners - centre[:, None], axis=-1).max(1) + 2 * gap
    tree = cKDTree(middle)
    facets_at_once = 256  # facets whose neighbourhood is searched for edges together
    for first in range(0, len(centre) if len(middle) else 0, facets_at_once):
        some = np.arange(first, min(first + facets_at_once, len(centre)))
        near = tree.query_ball_point(centre[some], radius[some], return_sorted=False)
        facet, edge = np.repeat(some, [len(found) for found in near]), np.concatenate([*near, []]).astype(int)
        normal, point, way = np.asarray(facets.normal)[facet], middle[edge], out[edge]
        height, along = np.sum(normal * point, -1) - np.asarray(facets.offset)[facet], np.sum(normal * way, -1)
        distance = -height / np.where(along == 0, 1, along)
        closes = [((along != 0) & (distance > WELD) & (distance < gap), point + distance[:, None] * way)]
        # A facet that contains the edge lies on one side of it, or on both.
        contains = sheet[edge] & (np.abs(height) < 10 * WELD) & (np.abs(np.sum(normal * edges.direction[edge], -1)) < FLAT)
        tangent = np.cross(normal, edges.direction[edge])
        for beside in (tangent, -tangent):
            out_of_0, out_of_n = (np.sum(beside * face[edge], -1) for face in (edges.normal_0, edges.normal_n))
            closes.append((contains & (np.maximum(out_of_0, out_of_n) > SHARPEST), point + gap * beside))
        for may, there in closes:
            which = np.flatnonzero(may)
            of, there = facet[which], there[which, None]
            inside = (np.sum(half_planes.inward[of] * there, -1) >= half_planes.offset[of]).all(-1)
            covered[edge[which[inside]]] = True
    return covered


def padded_size(count: int) -> int:
    """Returns the next larger size of the padding scheme; 0 for 0."""
    parts = 8  # sizes between consecutive powers of two: at most an eighth of the padded arrays is padding
    step = max(2 ** (count.bit_length() - 1) // parts, 1)
    return -(-count // step) * step


def common_size(count: int) -> int:
    """Returns the next larger power of two, or three quarters of it: a size that a few rows more or fewer rarely change."""
    power = 1 << max(count - 1, 0).bit_length()
    return power * 3 // 4 if count <= power * 3 // 4 else power


def padded_to(size: int, rows: Shaped[AnyArray, "..."], axis: int = 0) -> Shaped[np.ndarray, "..."]:
    """Returns an array padded to a size along an axis with copies of its last row."""
    missing = [(0, 0)] * rows.ndim
    missing[axis] = 0, size - rows.shape[axis]
    return np.pad(np.asarray(rows), missing, "edge") if rows.shape[axis] else np.asarray(rows)


def padded_edges(edges: Edges) -> Edges:
    """Returns edges followed by copies of the first one with zero length, which diffract nothing (host)."""
    count = len(edges.length)
    more: Edges = jax.tree.map(filled, edges)
    return dataclasses.replace(more, length=np.where(np.arange(len(more.length)) < count, more.length, 0))


def filled(rows: Shaped[AnyArray, "n ..."]) -> Shaped[np.ndarray, "k ..."]:
    """Returns rows padded with copies of the first one."""
    missing = padded_size(len(rows)) - len(rows)
    return np.concatenate([rows, np.broadcast_to(rows[:1], (missing, *rows.shape[1:]))])
