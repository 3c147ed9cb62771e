"""Which transmitters a receiver sees: the straight line between them meets no surface."""

import numpy as np
from jaxtyping import Bool, Float, Int

from wbgs_jax.data.dataset import Dataset

CLEARANCE = 1e-3
"""Metres at both ends of a line in which a surface does not count: antennas may be mounted on it."""
AT_ONCE = 2**22
"""Pairs of lines and triangles that are looked at together."""


def in_sight(dataset: Dataset, index: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "n"] | None:
    """Returns whether the receivers of some links see their transmitters; None where no mesh says so."""
    if not len(dataset.faces):
        return None
    ends = np.stack(
        [dataset.tx_positions[index], np.asarray(dataset.receivers.position, float)[dataset.receiver_index[index]]], 1
    )
    lines, which = np.unique(ends, axis=0, return_inverse=True)
    triangles = dataset.vertices[dataset.faces].astype(float)
    block = max(1, AT_ONCE // len(triangles))
    free = [~_blocked(lines[i : i + block], triangles) for i in range(0, len(lines), block)]
    return np.concatenate([np.zeros(0, bool), *free])[which.reshape(-1)]


def _blocked(lines: Float[np.ndarray, "n 2 3"], triangles: Float[np.ndarray, "faces 3 3"]) -> Bool[np.ndarray, "n"]:
    """Returns whether lines meet a triangle (Möller and Trumbore 1997)."""
    start, along = lines[:, :1], lines[:, 1:] - lines[:, :1]
    corner, first, second = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    across = np.cross(along, second)
    determinant = (across * first).sum(-1)
    inverse = 1 / np.where(determinant == 0, np.inf, determinant)
    offset = start - corner
    u = (offset * across).sum(-1) * inverse
    turned = np.cross(offset, first)
    v = (along * turned).sum(-1) * inverse
    share = (second * turned).sum(-1) * inverse
    margin = CLEARANCE / np.maximum(np.linalg.norm(along, axis=-1), CLEARANCE)
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (determinant != 0)
    return (inside & (share > margin) & (share < 1 - margin)).any(1)
