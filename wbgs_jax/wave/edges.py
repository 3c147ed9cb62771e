"""The edges that waves are diffracted at: where two facets of one body meet at an angle.

Runs on the host. Free edges of single sheets are no wedges and are left out, and so are inner corners.
"""

from collections import defaultdict
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from wbgs_jax.pytree import pytree
from wbgs_jax.wave.facets import CORNERS, ODD, WELD, AnyArray, Facets, outline_of

SHARPEST = 0.05
"""Edges that turn by less than this angle (radians) are part of a smooth surface."""
GAP = 0.006
"""Metres: surfaces nearer than this are joined."""


@pytree
class Edges:
    """E straight wedges, open to the outside by more than half a turn."""

    start: Float[AnyArray, "e 3"]
    """World frame, metres."""
    direction: Float[AnyArray, "e 3"]
    """Unit vector; with the 0-face's normal it gives the tangent (normal x direction) that points into that face."""
    length: Float[AnyArray, "e"]
    normal_0: Float[AnyArray, "e 3"]
    """Outward normals of the two faces."""
    normal_n: Float[AnyArray, "e 3"]
    facet: Int[AnyArray, "e"]
    """The 0-face; both are of one part."""


def edges_of_facets(facets: Facets) -> Edges:
    """Edges (float64 and int32 NumPy arrays) shared by two facets of one part, or by parts of their sides."""
    corners, normal = np.asarray(facets.corners), np.asarray(facets.normal)
    centre = corners.mean(1)
    sides = defaultdict(list)
    for i, polygon in enumerate(corners):
        for k in range(CORNERS):
            a, b = polygon[k], polygon[(k + 1) % CORNERS]
            if (length := np.linalg.norm(b - a)) > WELD:
                sides[_line(a, (b - a) / length, int(facets.part[i]))].append((i, a, b))
    found = []
    for on_line in sides.values():
        for p, (i, a, b) in enumerate(on_line):
            for j, c, d in on_line[p + 1 :]:
                along = (b - a) / np.linalg.norm(b - a)
                low, high = sorted((float((c - a) @ along), float((d - a) @ along)))
                low, high = max(low, 0.0), min(high, float(np.linalg.norm(b - a)))
                turn = np.arccos(np.clip(normal[i] @ normal[j], -1, 1))
                outward = (centre[j] - centre[i]) @ normal[i] < 0 and (centre[i] - centre[j]) @ normal[j] < 0
                if high - low > 10 * WELD and turn > SHARPEST and outward:
                    inward = centre[i] - a
                    sign = 1 if np.cross(normal[i], along) @ inward > 0 else -1
                    start = a + along * (low if sign > 0 else high)
                    found.append((start, sign * along, high - low, normal[i], normal[j], i))
    columns: Any = list(zip(*found, strict=True)) or [[]] * 6
    shapes = ((-1, 3), (-1, 3), (-1,), (-1, 3), (-1, 3), (-1,))
    arrays: Any = [np.array(column, np.float64).reshape(shape) for column, shape in zip(columns, shapes, strict=True)]
    arrays[5] = arrays[5].astype(np.int32)
    free = ~_covered(Edges(*arrays), facets)
    return Edges(*[array[free] for array in arrays])


def _covered(edges: Edges, facets: Facets) -> Bool[np.ndarray, "e"]:
    """Whether another surface closes the gap in front of an edge: where two bodies are joined nothing is diffracted."""
    out = edges.normal_0 + edges.normal_n
    out = out / np.linalg.norm(out, axis=-1, keepdims=True)
    middle = edges.start + edges.direction * edges.length[:, None] / 2
    normal, (inward, edge_offset) = np.asarray(facets.normal), outline_of(facets)
    covered = np.zeros(len(middle), bool)
    for i, (point, way) in enumerate(zip(middle, out, strict=True)):
        height = normal @ point - np.asarray(facets.offset)
        along = normal @ way
        distance = -height / np.where(along == 0, 1, along)
        near = np.flatnonzero((along != 0) & (distance > WELD) & (distance < GAP))
        meets = point + distance[near, None] * way
        inside = (np.einsum("fed,fd->fe", inward[near], meets) >= edge_offset[near]).all(-1)
        covered[i] = inside.any()
    return covered


def _line(point, along, part: int) -> tuple[int, ...]:
    """A hashable name of a straight line of a part: equal for equal lines, up to rounding."""
    first = along[np.argmax(np.abs(along) > 1e-3)]
    along = along if first > 0 else -along
    foot = point - (point @ along) * along
    return (part, *(int(i) for i in np.round(np.concatenate([along, foot]) * 1e3 + ODD)))
