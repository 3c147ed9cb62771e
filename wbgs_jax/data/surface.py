"""Where Gaussians start: points spread over the scene's surfaces."""

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import cKDTree

from wbgs_jax.data.dataset import Dataset
from wbgs_jax.types import Surface

MESH_SIZED = (20_000, 70_000)
"""Bounds of the number of points when it is left to the mesh."""
BOX_MARGIN = 1.0
"""Metres around transmitters and receiver in which points are drawn where no surface is known."""


def make_surface(dataset: Dataset, count: int, seed: int) -> Surface:
    """`count` points, even over the area of the mesh; 0 means as many as the mesh has vertices, within `MESH_SIZED`.

    Without faces the points of the cloud are used; without any points, random ones in the box of transmitters and receiver.
    """
    rng = np.random.default_rng(seed)
    if count == 0:
        count = int(np.clip(len(dataset.vertices), *MESH_SIZED))
    if len(dataset.faces):
        mesh = trimesh.Trimesh(dataset.vertices, dataset.faces, process=False)
        points = np.asarray(trimesh.sample.sample_surface(mesh, count, seed=rng)[0])
    elif len(dataset.vertices):
        points = dataset.vertices[rng.choice(len(dataset.vertices), min(count, len(dataset.vertices)), replace=False)]
    else:
        places = np.concatenate([dataset.tx_positions, np.asarray(dataset.receiver.position)[None]])
        points = rng.uniform(places.min(0) - BOX_MARGIN, places.max(0) + BOX_MARGIN, (count, 3))
    return surface_from_points(points)


def surface_from_points(points: Float[np.ndarray, "n 3"]) -> Surface:
    """A surface (float32) with the spacing of its points; needs at least 4 points."""
    neighbours, _ = cKDTree(points).query(points, 4)
    return Surface(np.asarray(points, np.float32), np.asarray(neighbours[:, 1:].mean(1), np.float32))  # type: ignore[arg-type]
