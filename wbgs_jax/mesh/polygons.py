"""Triangulation of convex and concave polygons."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

FLAT = 1e-12
"""Fraction of a polygon's squared size below which the area of a corner counts as zero."""


def triangulate(
    vertices: Float[np.ndarray, "v 3"], corners: Int[np.ndarray, " total"], sizes: Int[np.ndarray, " n"]
) -> Int[np.ndarray, "t 3"]:
    """Returns the triangles of polygons, in their order and orientation; polygons of fewer than three corners give none.

    Convex polygons become fans around their first corner. Others are cut by ear clipping (Meisters 1975), in the plane of
    Newell's normal.

    Args:
        vertices: any unit.
        corners: indices of all polygons' corners, concatenated.
        sizes: number of corners of each polygon.
    """
    corners = np.asarray(corners, np.int64)
    fans = np.maximum(sizes - 2, 0)
    first = np.repeat(np.cumsum(sizes) - sizes, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)  # 0, 1, ... within each polygon
    triangles = corners[np.stack([first, first + step + 1, first + step + 2], -1)]
    if not len(triangles) or corners.min() < 0 or corners.max() >= len(vertices):
        return triangles
    start, end = np.cumsum(fans) - fans, np.cumsum(fans)
    begin = np.cumsum(sizes) - sizes
    for number in _concave(vertices, triangles, fans):
        own = corners[begin[number] : begin[number] + sizes[number]]
        triangles[start[number] : end[number]] = _ears(vertices[own], own)
    return triangles


def _concave(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], fans: Int[np.ndarray, " n"]
) -> Int[np.ndarray, " k"]:
    """Returns the polygons whose fan has a triangle oriented against the polygon's total normal."""
    a, b, c = np.moveaxis(np.asarray(vertices, np.float64)[triangles], 1, 0)
    normal = np.cross(b - a, c - a)
    polygon = np.repeat(np.arange(len(fans)), fans)
    total = np.zeros((len(fans), 3))
    np.add.at(total, polygon, normal)
    against = np.sum(normal * total[polygon], -1) < -FLAT * np.sum(total[polygon] ** 2, -1)
    return np.unique(polygon[against])


def _ears(points: Float[np.ndarray, "n 3"], names: Int[np.ndarray, " n"]) -> Int[np.ndarray, "t 3"]:
    """Returns the triangles of a polygon by ear clipping; what remains of a self-intersecting one becomes a fan."""
    plane = _in_plane(np.asarray(points, np.float64))
    left, found = list(range(len(plane))), []
    size = float(np.ptp(plane, axis=0).max()) ** 2
    while len(left) > 3:
        ear = next((i for i in range(len(left)) if _is_ear(plane, left, i, FLAT * size)), None)
        if ear is None:
            found += [(left[0], left[i], left[i + 1]) for i in range(1, len(left) - 2)]
            left = [left[0], *left[-2:]]
            break
        found.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    found.append((left[0], left[1], left[2]))
    return names[np.array(found)]


def _is_ear(plane: Float[np.ndarray, "n 2"], left: list[int], i: int, least: float) -> bool:
    """Returns whether the triangle at a corner lies within the polygon; triangles without area count as ears."""
    a, b, c = left[i - 1], left[i], left[(i + 1) % len(left)]
    area = _area(plane[a], plane[b], plane[c])
    if area < -least:
        return False
    others = plane[[j for j in left if j not in (a, b, c)]]
    if abs(area) <= least:
        return True
    corners = plane[[a, b, c]]
    same = (np.abs(others[:, None] - corners) < np.sqrt(least)).all(-1).any(-1)  # a bridge to a hole returns to its corner
    sides = np.stack([_area(corners[k], corners[(k + 1) % 3], others) for k in range(3)])
    return not ((sides > -least).all(0) & ~same).any()


def _area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> Any:
    """Returns twice the signed area of triangles."""
    return (b[0] - a[0]) * (c[..., 1] - a[1]) - (b[1] - a[1]) * (c[..., 0] - a[0])


def _in_plane(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Returns coordinates in the polygon's plane, in which its orientation is counter-clockwise."""
    following = np.roll(points, -1, 0)
    normal = np.cross(points - points[0], following - points[0]).sum(0)
    length = np.linalg.norm(normal)
    if length == 0:
        return points[:, :2]
    normal = normal / length
    along = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    along /= np.linalg.norm(along)
    return np.stack([points @ along, points @ np.cross(normal, along)], -1)
