"""A mesh as a few planar facets: convex polygons of three or four corners, merged from coplanar triangles of one part.

Facets are the patches of the coherent field: what reflects, what shades and what transmits. They tile every planar piece of the
mesh without gaps or overlaps, so that their windows (`window.py`) are a partition of unity over it. Runs on the host.
"""

from collections import defaultdict
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Int

from wbgs_jax.pytree import pytree

AnyArray = Array | np.ndarray
"""Geometry is found in NumPy, in double precision, and used in JAX."""
CORNERS = 4
WELD = 1e-5
"""Metres: corners nearer than this are one."""
ODD = 0.137
"""Added before rounding, so that round numbers do not lie where rounding turns."""
FLAT = 1e-4
"""Sine of the largest angle between normals of one plane, and between edges of one straight line."""
Polygon = list[int]


@pytree
class Facets:
    """F planar convex polygons. A triangle repeats its last corner."""

    corners: Float[AnyArray, "f 4 3"]
    """World frame, metres, counter-clockwise around the normal."""
    normal: Float[AnyArray, "f 3"]
    offset: Float[AnyArray, "f"]
    """Distance of the plane from the origin along the normal, metres."""
    part: Int[AnyArray, "f"]
    """Which part of the scene it belongs to."""


def facets_from_mesh(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "t 3"], part: Int[np.ndarray, "t"], most: int | None = None
) -> Facets:
    """Facets (float64 and int32 NumPy arrays) of a triangle mesh, the largest first; at most `most` of them."""
    points, index = _weld(np.asarray(vertices, np.float64))
    triangles = index[np.asarray(faces)]
    normal, area = _normals(points, triangles)
    keep = area > 1e-10
    triangles, normal, part = triangles[keep], normal[keep], np.asarray(part)[keep]
    polygons, owner = [], []
    for group in _coplanar(points, triangles, normal, part):
        for polygon in _merge(points, [list(map(int, t)) for t in triangles[group]], normal[group[0]]):
            polygons.append(polygon)
            owner.append(int(part[group[0]]))
    corners = points[np.array([polygon + polygon[-1:] * (CORNERS - len(polygon)) for polygon in polygons])]
    normals, areas = _polygon_normals(corners)
    order = np.argsort(-areas, kind="stable")[:most]
    normals = normals[order]
    offset = np.sum(normals * corners[order].mean(1), -1)
    arrays: Any = (corners[order], normals, offset, np.array(owner, np.int32)[order])
    return Facets(*arrays)


def outline_of(facets: Facets) -> tuple[Float[np.ndarray, "f 4 3"], Float[np.ndarray, "f 4"]]:
    """(inward, offset) of every edge: a point of the plane lies inside where inward . point >= offset."""
    corners = np.asarray(facets.corners, np.float64)
    along = np.roll(corners, -1, 1) - corners
    inward = np.cross(np.asarray(facets.normal)[:, None], along)
    length = np.linalg.norm(inward, axis=-1, keepdims=True)
    inward = np.where(length > WELD, inward / np.maximum(length, WELD), 0)
    return inward, np.sum(inward * corners, -1)


def areas(facets: Facets) -> Float[np.ndarray, "f"]:
    """Square metres."""
    return _polygon_normals(np.asarray(facets.corners))[1]


def _weld(vertices: Float[np.ndarray, "v 3"]) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "v"]]:
    """Corners without duplicates, and the new index of every vertex."""
    cells = np.round(vertices / WELD + ODD).astype(np.int64)
    _, first, index = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    return vertices[first], index.reshape(-1)


def _normals(points, triangles) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t"]]:
    a, b, c = points[triangles].swapaxes(0, 1)
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=-1)
    return cross / np.maximum(length, 1e-30)[:, None], length / 2


def _polygon_normals(corners: Float[np.ndarray, "f 4 3"]) -> tuple[Float[np.ndarray, "f 3"], Float[np.ndarray, "f"]]:
    cross = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    cross = np.where(
        np.linalg.norm(corners[:, 3] - corners[:, 2], axis=-1, keepdims=True) < WELD,
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
        cross,
    )
    length = np.linalg.norm(cross, axis=-1)
    return cross / np.maximum(length, 1e-30)[:, None], length / 2


def _coplanar(points, triangles, normal, part) -> list[Int[np.ndarray, "k"]]:
    """Triangles of one part that share edges and a plane, as groups of indices."""
    by_edge: dict[tuple[int, int, int], list[int]] = defaultdict(list)
    for i, (a, b, c) in enumerate(triangles):
        for u, v in ((a, b), (b, c), (c, a)):
            by_edge[part[i], min(u, v), max(u, v)].append(i)
    leader = list(range(len(triangles)))

    def find(i: int) -> int:
        while leader[i] != i:
            leader[i] = leader[leader[i]]
            i = leader[i]
        return i

    for sharing in by_edge.values():
        for i in sharing[1:]:
            if np.linalg.norm(np.cross(normal[sharing[0]], normal[i])) < FLAT and normal[sharing[0]] @ normal[i] > 0:
                leader[find(i)] = find(sharing[0])
    groups: dict[int, list[int]] = defaultdict(list)
    for i in range(len(triangles)):
        groups[find(i)].append(i)
    return [np.array(group) for group in groups.values()]


def _merge(points, polygons: list[Polygon], normal) -> list[Polygon]:
    """Join neighbours while the union is convex with at most four corners."""
    merged = True
    while merged:
        merged = False
        owner: dict[tuple[int, int], int] = {}
        for i, polygon in enumerate(polygons):
            for edge in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                owner[edge] = i
        used: set[int] = set()
        joined: list[Polygon] = []
        for (u, v), i in owner.items():
            j = owner.get((v, u))
            if j is None or i == j or i in used or j in used:
                continue
            union = _join(points, polygons[i], polygons[j], u, v, normal)
            if union is not None:
                joined.append(union)
                used |= {i, j}
                merged = True
        polygons = [polygon for i, polygon in enumerate(polygons) if i not in used] + joined
    return polygons


def _join(points, first: Polygon, second: Polygon, u: int, v: int, normal) -> Polygon | None:
    """The union along the edge u-v, without corners on straight lines; None unless convex with at most four corners."""
    i, j = first.index(v), second.index(u)
    ring = first[i:] + first[:i] + (second[j:] + second[:j])[1:-1]
    corners = []
    for before, here, after in zip(ring[-1:] + ring[:-1], ring, ring[1:] + ring[:1], strict=True):
        a, b = points[here] - points[before], points[after] - points[here]
        turn = np.cross(a, b) @ normal / (np.linalg.norm(a) * np.linalg.norm(b))
        if turn < -FLAT:
            return None
        if turn > FLAT:
            corners.append(here)
    return corners if 3 <= len(corners) <= CORNERS else None
