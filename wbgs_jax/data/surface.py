"""Where Gaussians start: points spread over the scene's surfaces."""

from typing import Literal

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import cKDTree

from wbgs_jax.data.dataset import Dataset, Materials
from wbgs_jax.errors import UserError
from wbgs_jax.geometry import to_local
from wbgs_jax.types import Mesh, Surface

MESH_SIZED = (20_000, 70_000)
"""Bounds of the number of points when it is left to the mesh."""
SurfaceSampling = Literal["solid_angle", "area"]
OVERSAMPLING = 30
"""Candidates a point that are drawn by area before "solid_angle" chooses among them."""
MIN_DISTANCE = 0.3
"""Metres; nearer surfaces are not sampled more densely than at this distance."""
BELOW_HORIZON = -0.1
"""Cosine of the largest zenith angle at which points start: a little below the horizon, for footprints that reach above it."""
BOX_MARGIN = 1.0
"""Metres around transmitters and receiver in which points are drawn where no surface is known."""

DIRECTIVITY = {"tr38901": 1.0}
"""Exponent of the gain of 3GPP TR 38.901 by element pattern; 0 for all others."""


def make_surface(dataset: Dataset, count: int, seed: int, sampling: SurfaceSampling = "solid_angle") -> Surface:
    """`count` points on the mesh; 0 means as many as the mesh has vertices, within `MESH_SIZED`.

    "solid_angle" spreads them evenly over the directions of the receiver's hemisphere, hidden surfaces included: the image
    has the same resolution everywhere and no Gaussian is spent where the image cannot show it. "area" spreads them evenly
    over the surface. Without faces the points of the cloud are used; without any points, random ones in the box of
    transmitters and receiver.
    """
    rng = np.random.default_rng(seed)
    if count == 0:
        count = int(np.clip(len(dataset.vertices), *MESH_SIZED))
    if len(dataset.faces):
        points = _sample_mesh(dataset, count, rng, sampling)
    elif len(dataset.vertices):
        points = dataset.vertices[rng.choice(len(dataset.vertices), min(count, len(dataset.vertices)), replace=False)]
    else:
        places = np.concatenate([dataset.tx_positions, np.asarray(dataset.receiver.position)[None]])
        points = rng.uniform(places.min(0) - BOX_MARGIN, places.max(0) + BOX_MARGIN, (count, 3))
    return surface_from_points(points)


def _sample_mesh(dataset: Dataset, count: int, rng: np.random.Generator, sampling: SurfaceSampling) -> Float[np.ndarray, "n 3"]:
    mesh = trimesh.Trimesh(dataset.vertices, dataset.faces, process=False)
    if sampling == "area":
        return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=rng)[0])
    candidates, face = trimesh.sample.sample_surface(mesh, OVERSAMPLING * count, seed=rng)
    offset = np.asarray(candidates) - np.asarray(dataset.receiver.position)
    distance = np.maximum(np.linalg.norm(offset, axis=1), MIN_DISTANCE)
    facing = np.abs(np.sum(offset * mesh.face_normals[face], -1)) / distance
    zenith = to_local(jnp.asarray(offset, jnp.float32), dataset.receiver.orientation)[:, 2] / distance
    weight = np.where(np.asarray(zenith) > BELOW_HORIZON, facing / distance**2 + 1e-12, 0)
    if np.count_nonzero(weight) < count:
        weight = weight + 1e-12
    return np.asarray(candidates)[rng.choice(len(candidates), count, replace=False, p=weight / weight.sum())]


def make_mesh(dataset: Dataset) -> Mesh:
    """The surfaces themselves, for fields that know where they are.

    Raises:
        UserError: only points are known, or nothing.
    """
    if not len(dataset.faces):
        raise UserError(f"{dataset.name} has no mesh, only points; the wave field needs surfaces: train --field wideband")
    materials = dataset.materials or Materials(np.zeros(len(dataset.faces), np.int32), ("",), np.zeros(1))
    return Mesh(
        jnp.asarray(dataset.vertices, jnp.float32),
        jnp.asarray(dataset.faces, jnp.int32),
        jnp.asarray(materials.cluster, jnp.int32),
        jnp.asarray(materials.thickness, jnp.float32),
        jnp.asarray(DIRECTIVITY.get(dataset.element_pattern, 0.0), jnp.float32),
    )


def surface_from_points(points: Float[np.ndarray, "n 3"]) -> Surface:
    """A surface (float32) with the spacing of its points; needs at least 4 points."""
    neighbours, _ = cKDTree(points).query(points, 4)
    return Surface(jnp.asarray(points, jnp.float32), jnp.asarray(neighbours[:, 1:].mean(1), jnp.float32))
