"""What is common to all that look at the triangles of a mesh: sides, names of sides, what hangs together. Runs on the host."""

import numpy as np
from jaxtyping import Int
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
