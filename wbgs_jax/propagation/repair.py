"""What exports of meshes often get wrong, mended: parts that hold every triangle twice, and triangles that face both ways.

A surface that is there twice reflects twice, and lets pass what has passed two slabs; an edge between triangles that face both
ways is none. Runs on the host.
"""

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components


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
    neighbours = _neighbours(triangles, part)
    wrong = np.unique(part[neighbours.first[neighbours.against]])
    if len(wrong):
        own = np.isin(part, wrong)
        turned = _turned(points, triangles, neighbours) & own
        triangles[turned] = triangles[turned, ::-1]
        warnings.warn(f"triangles of {len(wrong)} parts of the mesh face both ways; they are taken to face one", stacklevel=4)
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


class _Neighbours(NamedTuple):
    """Pairs of triangles with a side that no other triangle of their part has."""

    first: Int[np.ndarray, " n"]
    second: Int[np.ndarray, " n"]
    against: Bool[np.ndarray, " n"]
    """Whether both go along it in the same direction: they face different ways."""
    closed: Bool[np.ndarray, " t"]
    """Of every triangle, whether all of its sides are such ones."""


def _neighbours(triangles: Int[np.ndarray, "t 3"], part: Int[np.ndarray, " t"]) -> _Neighbours:
    sides = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    which = _row_numbers(np.repeat(part, 3), *np.sort(sides, 1).T)
    count, order = np.bincount(which), np.argsort(which, kind="stable")
    start = (np.cumsum(count) - count)[count == 2]
    one, other = order[start], order[start + 1]
    along = sides[:, 1] > sides[:, 0]
    closed = (count == 2)[which].reshape(-1, 3).all(1)
    apart = one // 3 != other // 3  # a triangle without an area may be its own neighbour
    return _Neighbours(one[apart] // 3, other[apart] // 3, (along[one] == along[other])[apart], closed)


def _turned(
    points: Float[np.ndarray, "w 3"], triangles: Int[np.ndarray, "t 3"], neighbours: _Neighbours
) -> Bool[np.ndarray, " t"]:
    """Returns which triangles to turn round, so that all face as their neighbours do, and outwards where bodies are closed."""
    count = len(triangles)
    keys, first = np.unique(np.minimum(*neighbours[:2]) * count + np.maximum(*neighbours[:2]), return_index=True)
    against = neighbours.against[first]
    ends = neighbours.first[first].astype(np.int32), neighbours.second[first].astype(np.int32)
    graph = coo_array((np.ones(len(first), bool), ends), shape=(count, count)).tocsr()
    bodies, body = connected_components(graph, directed=False)
    turned = np.zeros(count, bool)
    for start in np.unique(body, return_index=True)[1]:
        order, before = breadth_first_order(graph, int(start), directed=False)
        later, earlier = order[1:].astype(np.int64), before[order[1:]].astype(np.int64)
        differ = against[np.searchsorted(keys, np.minimum(later, earlier) * count + np.maximum(later, earlier))]
        for triangle, parent, flip in zip(later, earlier, differ, strict=True):
            turned[triangle] = turned[parent] ^ flip
    a, b, c = (points - points.mean(0))[triangles].swapaxes(0, 1)
    volume = np.where(turned, -1, 1) * np.sum(a * np.cross(b, c), -1)
    inward = np.bincount(body, volume, bodies) < 0
    inward &= np.bincount(body, ~neighbours.closed, bodies) == 0
    return turned ^ inward[body]


def _row_numbers(*columns: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Returns a number for every row, equal for equal rows, without gaps: sorting integers is faster than sorting rows."""
    number = np.zeros(len(columns[0]), np.int64)
    for column in columns:
        number = np.unique(number * (int(column.max(initial=0)) + 1) + column, return_inverse=True)[1]
    return number
