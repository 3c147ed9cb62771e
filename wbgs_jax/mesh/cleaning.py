"""Repairs frequent errors of mesh exports: parts that contain triangles twice, and inconsistent orientations.

A duplicated surface reflects twice and transmits through two slabs; triangles of opposite orientation form no diffracting edge.
The helpers for sides and connected components are shared with other modules. Runs on the host.
"""

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def components(count: int, first: Int[np.ndarray, " n"], second: Int[np.ndarray, " n"]) -> Int[np.ndarray, " nodes"]:
    """Returns the connected component of each of `count` nodes; components are numbered by their first nodes."""
    ends = first.astype(np.int32), second.astype(np.int32)  # some versions of SciPy's graph functions accept no wider indices
    joined = coo_array((np.ones(len(first), bool), ends), shape=(count, count))
    return connected_components(joined, directed=False)[1]


def sides(triangles: Int[np.ndarray, "t 3"]) -> Int[np.ndarray, "sides 2"]:
    """Returns the three sides of every triangle, the smaller corner first."""
    return np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)


def names(owner: Int[np.ndarray, " n"], sides: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """Returns one integer per side and owner, the same for equal ones."""
    corners = int(sides.max(initial=0)) + 1
    return (owner.astype(np.int64) * corners + sides[:, 0]) * corners + sides[:, 1]


def repaired(
    points: Float[np.ndarray, "w 3"], triangles: Int[np.ndarray, "t 3"], part: Int[np.ndarray, " t"]
) -> tuple[Int[np.ndarray, "k 3"], Int[np.ndarray, " k"]]:
    """Returns the triangles that are kept, with consistent orientations, and their indices; warns of repairs.

    Args:
        points: corners, metres, without duplicates.
        triangles: indices of corners.
        part: part of every triangle.
    """
    kept = _once(triangles, part)
    triangles, part = triangles[kept].copy(), part[kept]
    pairs = _neighbours(triangles, part)
    wrong = np.unique(part[pairs.first[pairs.against]])
    if len(wrong):
        own = np.flatnonzero(np.isin(part, wrong))
        flipped = own[_flipped(points, triangles[own], _neighbours(triangles[own], part[own]))]
        triangles[flipped] = triangles[flipped, ::-1]
        warnings.warn(f"inconsistent triangle orientations were repaired (parts of the mesh: {len(wrong)})", stacklevel=4)
    return triangles, kept


def _once(triangles: Int[np.ndarray, "t 3"], part: Int[np.ndarray, " t"]) -> Int[np.ndarray, " k"]:
    """Returns the triangles without duplicates, in either orientation. Bodies of one part that touch share triangles that face
    opposite ways and have no side with an odd number of triangles; unless all of their part are repeated, these stay."""
    corners = np.sort(triangles, 1)
    _, side = np.unique(names(part, corners[:, :2]), return_inverse=True)
    _, first, which, count = np.unique(
        side * (int(corners.max(initial=0)) + 1) + corners[:, 2], return_index=True, return_inverse=True, return_counts=True
    )
    again = np.arange(len(triangles)) != first[which]
    if not again.any():
        return np.arange(len(triangles))
    single = np.zeros(part.max(initial=-1) + 1, bool)
    single[part[count[which] == 1]] = True
    _, edge, of_side = np.unique(names(np.repeat(part, 3), sides(triangles)), return_inverse=True, return_counts=True)
    odd = (of_side % 2 == 1)[edge].reshape(-1, 3).any(1)
    turn = np.prod(np.sign(triangles - np.roll(triangles, 1, 1)), 1)  # of an orientation; 0 for one with a corner twice
    again &= ~single[part] | (turn != 0) & (odd | (turn == turn[first[which]]))
    if again.any():
        doubled, few = len(np.unique(part[~single[part]])), int(np.count_nonzero(again & single[part]))
        counts = f"parts of the mesh with every triangle twice: {doubled}; triangles of other parts: {few}"
        warnings.warn(f"duplicate triangles are ignored ({counts})", stacklevel=5)
    return np.flatnonzero(~again)


class _Neighbours(NamedTuple):
    """Pairs of triangles that share a side with no other triangle of their part."""

    first: Int[np.ndarray, " n"]
    second: Int[np.ndarray, " n"]
    against: Bool[np.ndarray, " n"]
    """Whether both traverse it in the same direction, so that their orientations differ."""
    closed: Bool[np.ndarray, " t"]
    """Whether all sides of a triangle are of this kind."""


def _neighbours(triangles: Int[np.ndarray, "t 3"], part: Int[np.ndarray, " t"]) -> _Neighbours:
    side = sides(triangles)
    _, which, count = np.unique(names(np.repeat(part, 3), side), return_inverse=True, return_counts=True)
    start, order = (np.cumsum(count) - count)[count == 2], np.argsort(which, kind="stable")
    one, other = order[start], order[start + 1]
    forward = (np.roll(triangles, -1, 1) > triangles).reshape(-1)
    closed = (count == 2)[which].reshape(-1, 3).all(1)
    against = (forward[one] == forward[other]) & (side[one, 0] != side[one, 1])  # a side of zero length has no direction
    return _Neighbours(one // 3, other // 3, against, closed)


def _flipped(points: Float[np.ndarray, "w 3"], triangles: Int[np.ndarray, "t 3"], pairs: _Neighbours) -> Bool[np.ndarray, " t"]:
    """Returns which triangles to flip so that orientations agree within bodies, and point outwards if these are closed."""
    count, across = len(triangles), len(triangles) * pairs.against
    # Every triangle occurs twice, as given and flipped. Consistent ones are connected, so that every body occurs twice as well.
    first = np.concatenate([pairs.first, pairs.first + count])
    second = np.concatenate([pairs.second + across, pairs.second + count - across])
    as_it_is, other_way = components(2 * count, first, second).reshape(2, count)
    body, flipped = np.minimum(as_it_is, other_way), as_it_is > other_way
    a, b, c = (points - points.mean(0))[triangles].swapaxes(0, 1)
    volume = np.bincount(body, np.where(flipped, -1, 1) * np.sum(a * np.cross(b, c), -1))
    inward = (volume < 0) & (np.bincount(body, ~pairs.closed) == 0)
    return flipped ^ inward[body]
