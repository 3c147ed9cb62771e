"""Which transmitters a receiver sees: the straight line between them meets no surface."""

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int

from wbgs_jax.data.dataset import Dataset

CLEARANCE = 1e-3
"""Metres at both ends of a line in which a surface does not count: antennas may be mounted on it."""


def in_sight(dataset: Dataset, index: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"] | None:
    """Returns whether the receivers of some links see their transmitters; None where no mesh says so."""
    if not len(dataset.faces):
        return None
    receivers = dataset.rx_positions(index)
    lines, which = np.unique(np.stack([receivers, dataset.tx_positions[index]], 1), axis=0, return_inverse=True)
    triangles = dataset.vertices[dataset.faces].astype(np.float64)
    normals = trimesh.unitize(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    lowest, highest = triangles.min(1), triangles.max(1)
    free = np.ones(len(lines), bool)
    for i, line in enumerate(lines):
        near = np.flatnonzero(((lowest <= line.max(0)) & (highest >= line.min(0))).all(1))  # of all, a few in a hundred
        free[i] = not len(near) or not _obstructed(line, triangles[near], normals[near])
    return free[which.reshape(-1)]


def _obstructed(
    line: Float[np.ndarray, "2 3"], triangles: Float[np.ndarray, "faces 3 3"], normals: Float[np.ndarray, "faces 3"]
) -> bool:
    """Returns whether any triangle lies between the two ends of a line."""
    start, way = line[0], line[1] - line[0]
    starts, ways = (np.broadcast_to(vector, normals.shape) for vector in (start, way))
    points, cut, along = trimesh.intersections.planes_lines(triangles[:, 0], normals, starts, ways, return_distance=True)
    inside = (trimesh.triangles.points_to_barycentric(triangles[cut], points) >= 0).all(1)
    margin = CLEARANCE / max(float(np.linalg.norm(way)), CLEARANCE)
    return bool((inside & (along > margin) & (along < 1 - margin)).any())
