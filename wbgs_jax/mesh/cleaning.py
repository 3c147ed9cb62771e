"""What exports of meshes often get wrong, mended: parts that hold every triangle twice, and triangles that face both ways.

A surface that is there twice reflects twice, and lets pass what has passed two slabs; an edge between triangles that face both
ways is none. Runs on the host.

What is common to all that look at the triangles of a mesh: sides, names of sides, what hangs together. Runs on the host.
"""

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def components(count: int, first: Int[np.ndarray, " n"], second: Int[np.ndarray, " n"]) -> Int[np.ndarray, " nodes"]:
    """Returns which connected component each of `count` nodes is in; components are numbered by their first nodes."""
    ends = first.astype(np.int32), second.astype(np.int32)  # wider indices are not for every SciPy's graphs
    joined = coo_array((np.ones(len(first), bool), ends), shape=(count, count))
    return connected_components(joined, directed=False)[1]


def sides(triangles: Int[np.ndarray, "t 3"]) -> Int[np.ndarray, "sides 2"]:
    """Returns the three sides of every triangle, the smaller corner first."""
    return np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)


def names(owner: Int[np.ndarray, " n"], sides: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """Returns one integer for every side of an owner: equal for equal ones."""
    corners = int(sides.max(initial=0)) + 1
    return (owner.astype(np.int64) * corners + sides[:, 0]) * corners + sides[:, 1]


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
    pairs = _neighbours(triangles, part)
    wrong = np.unique(part[pairs.first[pairs.against]])
    if len(wrong):
        own = np.flatnonzero(np.isin(part, wrong))
        turned = own[_turned(points, triangles[own], _neighbours(triangles[own], part[own]))]
        triangles[turned] = triangles[turned, ::-1]
        warnings.warn(f"triangles of {len(wrong)} parts of the mesh face both ways; they are taken to face one", stacklevel=4)
    return triangles, kept


def _once(triangles: Int[np.ndarray, "t 3"], part: Int[np.ndarray, " t"]) -> Int[np.ndarray, " k"]:
    """Returns the triangles without the repetitions in parts of which every triangle is repeated, either side up. Where only
    some are, bodies of one part touch."""
    corners = np.sort(triangles, 1)
    _, side = np.unique(names(part, corners[:, :2]), return_inverse=True)
    _, first, which, count = np.unique(
        side * (int(corners.max(initial=0)) + 1) + corners[:, 2], return_index=True, return_inverse=True, return_counts=True
    )
    single = np.zeros(part.max(initial=-1) + 1, bool)
    single[part[count[which] == 1]] = True
    if single[part].all():
        return np.arange(len(triangles))
    doubled = len(np.unique(part[~single[part]]))
    warnings.warn(f"every triangle of {doubled} parts of the mesh is there twice; it is taken once", stacklevel=5)
    return np.union1d(np.flatnonzero(single[part]), first)


class _Neighbours(NamedTuple):
    """Pairs of triangles with a side that no other triangle of their part has."""

    first: Int[np.ndarray, " n"]
    second: Int[np.ndarray, " n"]
    against: Bool[np.ndarray, " n"]
    """Whether both go along it in the same direction: they face different ways."""
    closed: Bool[np.ndarray, " t"]
    """Of every triangle, whether all of its sides are such ones."""


def _neighbours(triangles: Int[np.ndarray, "t 3"], part: Int[np.ndarray, " t"]) -> _Neighbours:
    side = sides(triangles)
    _, which, count = np.unique(names(np.repeat(part, 3), side), return_inverse=True, return_counts=True)
    start, order = (np.cumsum(count) - count)[count == 2], np.argsort(which, kind="stable")
    one, other = order[start], order[start + 1]
    forward = (np.roll(triangles, -1, 1) > triangles).reshape(-1)
    closed = (count == 2)[which].reshape(-1, 3).all(1)
    against = (forward[one] == forward[other]) & (side[one, 0] != side[one, 1])  # one of no length has no direction
    return _Neighbours(one // 3, other // 3, against, closed)


def _turned(points: Float[np.ndarray, "w 3"], triangles: Int[np.ndarray, "t 3"], pairs: _Neighbours) -> Bool[np.ndarray, " t"]:
    """Returns which triangles to turn round, so that all face as their neighbours do, and outwards where bodies are closed."""
    count, across = len(triangles), len(triangles) * pairs.against
    # Every triangle twice, as it is and turned round. What faces alike is joined, so that a body is there twice, too.
    first = np.concatenate([pairs.first, pairs.first + count])
    second = np.concatenate([pairs.second + across, pairs.second + count - across])
    as_it_is, other_way = components(2 * count, first, second).reshape(2, count)
    body, turned = np.minimum(as_it_is, other_way), as_it_is > other_way
    a, b, c = (points - points.mean(0))[triangles].swapaxes(0, 1)
    volume = np.bincount(body, np.where(turned, -1, 1) * np.sum(a * np.cross(b, c), -1))
    inward = (volume < 0) & (np.bincount(body, ~pairs.closed) == 0)
    return turned ^ inward[body]
