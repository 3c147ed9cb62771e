"""Closed bodies among a scene's surfaces, in which no antenna can stand (NumPy, host)."""

import numpy as np
from jaxtyping import Float, Int

from wbgs_jax._util.solids import ClosedBody, inside
from wbgs_jax.data.dataset import Dataset

ALIKE_M = 1e-4
"""Vertices nearer than this are one."""
MOST_TRIANGLES = 20_000
"""Of all bodies together, the largest bodies left out."""


def closed_bodies(dataset: Dataset) -> tuple[ClosedBody, ...]:
    """Returns the closed parts of a scene's surfaces that no receiver is in, nor most transmitters: those are rooms."""
    faces = dataset.faces
    if not len(faces):
        return ()
    part = np.zeros(len(faces), int) if dataset.face_part is None else np.asarray(dataset.face_part)
    found: list[ClosedBody] = []
    inhabitants = np.asarray(dataset.receivers.position, np.float64)
    known = np.unique(dataset.tx_positions[np.concatenate([dataset.train, dataset.validation])], axis=0)
    for number in np.unique(part):
        own = faces[part == number]
        if not _is_closed(dataset.vertices, own):
            continue
        body = ClosedBody(f"part {number}", np.asarray(dataset.vertices, np.float64)[own])
        if not inside(body, inhabitants).any() and (not len(known) or inside(body, known).mean() < 0.5):
            found.append(body)
    found.sort(key=lambda body: len(body.triangles))
    total = np.cumsum([len(body.triangles) for body in found])
    return tuple(body for body, triangles in zip(found, total, strict=True) if triangles <= MOST_TRIANGLES)


def _is_closed(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "t 3"]) -> bool:
    """Returns whether every edge belongs to two triangles, once in each direction."""
    used, index = np.unique(faces, return_inverse=True)
    _, same = np.unique(
        np.round(np.asarray(vertices, np.float64)[used] / ALIKE_M).astype(np.int64), axis=0, return_inverse=True
    )
    corners = same.reshape(-1)[index.reshape(-1, 3)]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    there, back = (np.unique(one, axis=0, return_counts=True) for one in (edges, edges[:, ::-1]))
    return np.array_equal(there[0], back[0]) and np.array_equal(there[1], back[1])
