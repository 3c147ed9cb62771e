"""What exports of meshes often get wrong, mended: parts that hold every triangle twice, and triangles that face both ways.

A surface that is there twice reflects twice, and lets pass what has passed two slabs; an edge between triangles that face both
ways is none. Runs on the host.
"""

import warnings

import numpy as np
import trimesh
from jaxtyping import Float, Int


def repaired(
    points: Float[np.ndarray, "w 3"], triangles: Int[np.ndarray, "t 3"], part: Int[np.ndarray, " t"]
) -> tuple[Int[np.ndarray, "k 3"], Int[np.ndarray, " k"]]:
    """Returns the triangles that are kept, and their numbers, and warns of what was mended.

    Args:
        points: corners, metres, none twice.
        triangles: as indices of corners.
        part: of every triangle.
    """
    kept = _once(triangles, part)
    triangles, part = triangles[kept].copy(), part[kept]
    turned = _both_ways(triangles, part)
    for number in turned:
        own = np.flatnonzero(part == number)
        mesh = trimesh.Trimesh(points, triangles[own], process=False)
        trimesh.repair.fix_normals(mesh, multibody=True)
        triangles[own] = mesh.faces
    if len(turned):
        warnings.warn(f"triangles of {len(turned)} parts of the mesh face both ways; they are taken to face one", stacklevel=4)
    return triangles, kept


def _once(triangles: Int[np.ndarray, "t 3"], part: Int[np.ndarray, " t"]) -> Int[np.ndarray, " k"]:
    """Returns the triangles without the repetitions in parts of which every triangle is repeated, either side up. Where only
    some are, bodies of one part touch."""
    which = _row_numbers(part, *np.sort(triangles, 1).T)
    _, first, count = np.unique(which, return_index=True, return_counts=True)
    single = np.zeros(part.max(initial=-1) + 1, bool)
    single[part[count[which] == 1]] = True
    if single[part].all():
        return np.arange(len(triangles))
    doubled = len(np.unique(part[~single[part]]))
    warnings.warn(f"every triangle of {doubled} parts of the mesh is there twice; it is taken once", stacklevel=5)
    return np.union1d(np.flatnonzero(single[part]), first)


def _both_ways(triangles: Int[np.ndarray, "t 3"], part: Int[np.ndarray, " t"]) -> Int[np.ndarray, " k"]:
    """Returns the parts with two neighbouring triangles that go along their common side in the same direction."""
    sides, owner = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), np.repeat(part, 3)
    which = _row_numbers(owner, *np.sort(sides, 1).T)
    along = np.bincount(which, np.sign(sides[:, 1] - sides[:, 0]))
    return np.unique(owner[((np.bincount(which) == 2) & (np.abs(along) == 2))[which]])


def _row_numbers(*columns: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Returns a number for every row, equal for equal rows, without gaps: sorting integers is faster than sorting rows."""
    number = np.zeros(len(columns[0]), np.int64)
    for column in columns:
        number = np.unique(number * (int(column.max(initial=0)) + 1) + column, return_inverse=True)[1]
    return number
