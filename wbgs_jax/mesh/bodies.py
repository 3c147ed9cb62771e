"""Bodies: as the readers of room files return them, named, in the units and axes of their file; and closed ones, with tests of
which points lie inside; triangulation of convex and concave polygons."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from wbgs_jax._util.pytree import AnyArray


class RadioMaterial(NamedTuple):
    """Material of a body as recorded in a file."""

    name: str
    """Name of an ITU material or of a custom one."""
    thickness: float
    """Metres."""
    properties: tuple[float, float] | None = None
    """Relative permittivity and conductivity (S/m) of a custom material."""


class Body(NamedTuple):
    """One object of a file."""

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "t 3"]
    material: RadioMaterial | None = None


def joined(bodies: list[Body]) -> list[Body]:
    """Returns bodies with those of the same name joined."""
    by_name: dict[str, list[Body]] = {}
    for body in bodies:
        by_name.setdefault(body.name, []).append(body)
    found = []
    for name, own in by_name.items():
        starts = np.cumsum([0, *(len(one.vertices) for one in own)])
        vertices = np.concatenate([one.vertices for one in own])
        faces = np.concatenate([one.faces + start for one, start in zip(own, starts, strict=False)])
        found.append(Body(name, vertices, faces, next((one.material for one in own if one.material), None)))
    return found


CHUNK = 1_000_000
"""Maximum number of pairs of a point and a triangle whose solid angles are computed together; limits memory to about 100 MB."""


class ClosedBody(NamedTuple):
    """A closed object, such as a cabinet or a pillar."""

    name: str
    triangles: Float[np.ndarray, "t 3 3"]
    """Corners of the triangles, metres."""


def share_in_box(points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"]) -> float:
    """Returns the share of points (metres) that lie in the box around vertices."""
    return float(((points >= vertices.min(0)) & (points <= vertices.max(0))).all(1).mean())


def inside(body: ClosedBody, points: Float[AnyArray, "n 3"], xp: Any = np) -> Bool[AnyArray, " n"]:
    """Returns which points (metres) lie inside a body. `xp` is the module of the arrays, NumPy or `jax.numpy`."""
    if xp is not np:
        return xp.abs(_solid_angles(body.triangles, points, xp).sum(1)) > 2 * np.pi
    points = np.asarray(points, np.float64)
    low, high = body.triangles.min((0, 1)), body.triangles.max((0, 1))
    result = ((points > low) & (points < high)).all(1)
    result[result] = np.abs(winding_number(body.triangles, points[result])) > 0.5
    return result


def winding_number(triangles: Float[np.ndarray, "t 3 3"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Returns the winding number of closed triangles around every point: 0 outside, 1 or -1 inside (computed from solid angles,
    van Oosterom and Strackee 1983)."""
    step = max(1, CHUNK // max(1, len(triangles)))
    each = [_solid_angles(triangles, points[i : i + step]).sum(1) for i in range(0, len(points), step)]
    return np.concatenate([np.zeros(0), *each]) / (4 * np.pi)


def _solid_angles(
    triangles: Float[np.ndarray, "t 3 3"], points: Float[AnyArray, "n 3"], xp: Any = np
) -> Float[AnyArray, "n t"]:
    a, b, c = (triangles[None, :, corner] - points[:, None] for corner in range(3))
    la, lb, lc = (xp.linalg.norm(one, axis=-1) for one in (a, b, c))
    triple = xp.einsum("nti,nti->nt", a, xp.cross(b, c))
    below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return 2 * xp.arctan2(triple, below)


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
