"""The edges that waves are diffracted at: where two facets of one body meet at an angle.

Runs on the host. Free edges of single sheets are no wedges and are left out, and so are inner corners.

Edges and chains filled up to sizes that seldom change: surfaces that are moved a little have a few more or fewer of them,
and everything that is compiled for one number would be compiled anew for the next.

What is added is never a path: edges of no length, and mirror images that lie in the plane of their mirror (`image_method.py`).
"""

import dataclasses
from collections import defaultdict
from itertools import combinations
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from wbgs_jax._util.pytree import pytree
from wbgs_jax.mesh.facets import CORNERS, WELD, AnyArray, Facets, outline_of

SHARPEST = 0.05
"""Edges that turn by less than this angle (radians) are part of a smooth surface."""
GAP = 0.006
"""Metres: surfaces nearer than this are joined."""
ODD = 0.137
"""Added before rounding, so that round numbers do not lie where rounding turns."""


@pytree
class Edges:
    """E straight wedges, open to the outside by more than half a turn."""

    start: Float[AnyArray, "e 3"]
    """World frame, metres."""
    direction: Float[AnyArray, "e 3"]
    """Unit vector; with the 0-face's normal it gives the tangent (normal x direction) that points into that face."""
    length: Float[AnyArray, " e"]
    """Metres."""
    normal_0: Float[AnyArray, "e 3"]
    """Outward normal of the 0-face."""
    normal_n: Float[AnyArray, "e 3"]
    """Outward normal of the n-face."""
    facet: Int[AnyArray, " e"]
    """The 0-face; both faces are of one body, so of one material."""


class _Side(NamedTuple):
    """A side of a facet that has a length."""

    facet: int
    start: Float[np.ndarray, "3"]
    end: Float[np.ndarray, "3"]


def edges_of_facets(facets: Facets) -> Edges:
    """Returns the edges (float64 and int32 NumPy arrays) that two facets of one body share, whole or in part."""
    normal, body, centre = np.asarray(facets.normal), np.asarray(facets.body), np.asarray(facets.corners).mean(1)
    found = []
    for on_line in _sides_by_line(facets):
        for first, second in combinations(on_line, 2):
            if body[first.facet] == body[second.facet]:
                found += _wedge(first, second, normal, centre)
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
    """Returns a hashable name of a straight line: equal for equal lines, up to rounding."""
    first = along[np.argmax(np.abs(along) > 1e-3)]
    along = along if first > 0 else -along
    foot = point - (point @ along) * along
    return tuple(int(i) for i in np.round(np.concatenate([along, foot]) * 1e3 + ODD))


def _wedge(
    first: _Side, second: _Side, normal: Float[np.ndarray, "f 3"], centre: Float[np.ndarray, "f 3"]
) -> list[tuple[Any, ...]]:
    """Returns the edge (its fields) where two sides of one line overlap; none if they do not, or not at an outer angle."""
    i, a, b = first
    j, c, d = second
    turn = np.arccos(np.clip(normal[i] @ normal[j], -1, 1))
    outward = (centre[j] - centre[i]) @ normal[i] < 0 and (centre[i] - centre[j]) @ normal[j] < 0
    if turn <= SHARPEST or not outward:
        return []
    length = np.linalg.norm(b - a)
    along = (b - a) / length
    low, high = sorted((float((c - a) @ along), float((d - a) @ along)))
    low, high = max(low, 0.0), min(high, float(length))
    if high - low <= 10 * WELD:
        return []
    sign = 1 if np.cross(normal[i], along) @ (centre[i] - a) > 0 else -1
    start = a + along * (low if sign > 0 else high)
    return [(start, sign * along, high - low, normal[i], normal[j], i)]


def _covered(edges: Edges, facets: Facets) -> Bool[np.ndarray, " e"]:
    """Returns whether another surface closes the gap in front of an edge: where two bodies are joined nothing is diffracted."""
    out = edges.normal_0 + edges.normal_n
    out = out / np.maximum(
        np.linalg.norm(out, axis=-1, keepdims=True), WELD
    )  # a sheet's two faces have no way out between them
    middle = edges.start + edges.direction * edges.length[:, None] / 2
    normal, outline = np.asarray(facets.normal), outline_of(facets)
    covered = np.zeros(len(middle), bool)
    for i, (point, way) in enumerate(zip(middle, out, strict=True)):
        height = normal @ point - np.asarray(facets.offset)
        along = normal @ way
        distance = -height / np.where(along == 0, 1, along)
        near = np.flatnonzero((along != 0) & (distance > WELD) & (distance < GAP))
        there = point + distance[near, None] * way
        inside = (np.einsum("fed,fd->fe", outline.inward[near], there) >= outline.offset[near]).all(-1)
        covered[i] = inside.any()
    return covered


PARTS = 8
"""Sizes between a power of two and the next one: at most an eighth of what is searched is padding."""


def padded_size(count: int) -> int:
    """Returns the next size that seldom changes; 0 for nothing."""
    step = max(2 ** (count.bit_length() - 1) // PARTS, 1)
    return -(-count // step) * step


def padded_edges(edges: Edges) -> Edges:
    """Returns edges, and behind them copies of the first one without length, which diffract nothing (host)."""
    count = len(edges.length)
    more: Edges = jax.tree.map(filled, edges)
    return dataclasses.replace(more, length=np.where(np.arange(len(more.length)) < count, more.length, 0))


def filled(rows: Shaped[AnyArray, "n ..."]) -> Shaped[np.ndarray, "k ..."]:
    """Returns rows, and behind them the first one again."""
    missing = padded_size(len(rows)) - len(rows)
    return np.concatenate([rows, np.broadcast_to(rows[:1], (missing, *rows.shape[1:]))])
