"""Information about a dataset's scene for fields: its bounding box, points on its surfaces, and the surfaces themselves; the
visibility of transmitters from receivers; and closed bodies, in which no antenna can be (NumPy, host).
"""

from dataclasses import dataclass
from typing import get_args

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import Dataset, Materials
from wbgs_jax.mesh.bodies import ClosedBody, inside
from wbgs_jax.radio.geometry import to_local
from wbgs_jax.types import Mesh, Receiver, Surface, SurfaceSampling

ON, MOST_COMPARED = 1e-3, 1_000_000_000
"""Metres within which a point lies on a surface, and pairs of a point and a triangle that are compared at most (seconds)."""
MESH_SIZED = (20_000, 70_000)
"""Bounds on the number of points if it is derived from the mesh."""
FEWEST = 4
"""Points of a surface: each needs 3 others for its spacing."""


@dataclass(frozen=True)
class DatasetScene:
    """A dataset's scene as an implementation of `wbgs_jax.types.Scene`."""

    dataset: Dataset

    @property
    def receivers(self) -> Receiver:
        """All receivers, with a leading axis."""
        return self.dataset.receivers

    @property
    def spectra(self) -> int:
        """Number of training links."""
        return len(self.dataset.train)

    @property
    def box(self) -> Float[np.ndarray, "2 3"]:
        """Smallest and largest coordinates (metres) of surfaces, if available, and of all transmitters and receivers.

        Predictions for transmitters outside this box are extrapolations without support in the data.
        """
        places = np.concatenate([np.asarray(self.dataset.vertices, np.float64), _antennas(self.dataset)])
        return np.stack([places.min(0), places.max(0)])

    def surface(self, count: int, seed: int, sampling: SurfaceSampling = "solid_angle") -> Surface:
        """Returns `make_surface` of the data set."""
        return make_surface(self.dataset, count, seed, sampling)

    def mesh(self) -> Mesh:
        """Returns `make_mesh` of the data set."""
        return make_mesh(self.dataset)


def make_surface(dataset: Dataset, count: int, seed: int, sampling: SurfaceSampling = "solid_angle") -> Surface:
    """Returns `count` points on the mesh; 0 means as many as the mesh has vertices, within `MESH_SIZED`.

    "solid_angle" distributes them uniformly over the directions of the receivers' hemispheres, including hidden surfaces: the
    resolution is the same everywhere in the image, and no Gaussian is placed where the image cannot show it. "area" distributes
    them uniformly over the surface. Without faces, points of the cloud are used; with fewer than 4, random ones in the
    box of transmitters and receivers.

    Args:
        dataset: data with a mesh, points, or neither.
        count: number of points, 0 or at least 4.
        seed: of the random numbers.
        sampling: "solid_angle" or "area".

    Returns:
        Points (n, 3) and their spacing (n,), metres, float32.

    Raises:
        ValueError: the count or the sampling is another one.
    """
    if count and count < FEWEST:
        raise ValueError(f"count is {count}; give at least {FEWEST}, or 0 for the size of the mesh")
    if sampling not in get_args(SurfaceSampling):
        raise ValueError(f"sampling is {sampling!r}; give one of: {', '.join(get_args(SurfaceSampling))}")
    rng = np.random.default_rng(seed)
    if count == 0:
        count = int(np.clip(len(dataset.vertices), *MESH_SIZED))
    box_margin = 1.0  # margin (metres) around transmitters and receivers in which points are drawn if there are no surfaces
    if len(dataset.faces):
        points = _sample_mesh(dataset, count, rng, sampling)
    elif len(dataset.vertices) >= FEWEST:
        points = dataset.vertices[rng.choice(len(dataset.vertices), min(count, len(dataset.vertices)), replace=False)]
    else:
        places = _antennas(dataset)
        points = rng.uniform(places.min(0) - box_margin, places.max(0) + box_margin, (count, 3))
    return surface_from_points(points)


def make_mesh(dataset: Dataset) -> Mesh:
    """Returns the surfaces themselves, for fields that use their geometry; if parts or materials are unknown, all triangles
    have the same one.

    Args:
        dataset: data with a mesh.

    Returns:
        Triangles (metres, world frame) with the object and the material of each.

    Raises:
        UserError: there are only points, or no surfaces at all.
    """
    if not len(dataset.faces):
        what = "no mesh, only points" if len(dataset.vertices) else "no mesh"
        advice = "give a scene with a mesh, or choose a field that does not need one (docs/which_field.md)"
        raise UserError(f"{dataset.name} has {what}; this field needs surfaces: {advice}")
    one = np.zeros(len(dataset.faces), np.int32)
    materials = dataset.materials or Materials(one, ("",), np.zeros(1))
    return Mesh(
        vertices=jnp.asarray(dataset.vertices, jnp.float32),
        faces=jnp.asarray(dataset.faces, jnp.int32),
        part=jnp.asarray(one if dataset.face_part is None else dataset.face_part, jnp.int32),
        material=jnp.asarray(materials.material, jnp.int32),
        thickness=jnp.asarray(materials.thickness, jnp.float32),
    )


def surface_from_points(points: Float[np.ndarray, "n 3"]) -> Surface:
    """Returns a surface (float32) with the spacing of its points.

    Args:
        points: (n, 3), at least 4, world frame, metres.

    Returns:
        The points (n, 3) with the mean distance (n,) of each to its 3 nearest others, metres.

    Raises:
        ValueError: there are fewer than 4 points, or their shape is wrong.
    """
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < FEWEST:
        raise ValueError(f"points has shape {points.shape}; expected (n, 3) with n at least {FEWEST}")
    neighbours, _ = cKDTree(points).query(points, FEWEST)
    return Surface(jnp.asarray(points, jnp.float32), jnp.asarray(neighbours[:, 1:].mean(1), jnp.float32))


def _antennas(dataset: Dataset) -> Float[np.ndarray, "n 3"]:
    """Returns the positions (metres, float64) of all transmitters and receivers."""
    return np.concatenate([dataset.tx_positions, np.asarray(dataset.receivers.position)])


def _sample_mesh(dataset: Dataset, count: int, rng: np.random.Generator, sampling: SurfaceSampling) -> Float[np.ndarray, "n 3"]:
    mesh = trimesh.Trimesh(dataset.vertices, dataset.faces, process=False)
    if sampling == "area":
        return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=rng)[0])
    oversampling = 30  # candidates per point that are drawn by area before "solid_angle" selects among them
    candidates, face = map(np.asarray, trimesh.sample.sample_surface(mesh, oversampling * count, seed=rng))
    receivers = map(dataset.receiver, range(dataset.n_receivers))
    weight = sum((_solid_angle(candidates, mesh.face_normals[face], rx) for rx in receivers), np.zeros(len(candidates)))
    if np.count_nonzero(weight) < count:
        weight = weight + 1e-12
    return candidates[rng.choice(len(candidates), count, replace=False, p=weight / weight.sum())]


def _solid_angle(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], receiver: Receiver
) -> Float[np.ndarray, " n"]:
    """Returns the solid angle of surface elements of unit area at a receiver; 0 below its horizon."""
    offset = points - np.asarray(receiver.position)
    min_distance = 0.3  # metres; nearer surfaces are not sampled more densely than at this distance
    distance = np.maximum(np.linalg.norm(offset, axis=1), min_distance)
    facing = np.abs(np.sum(offset * normals, -1)) / distance
    zenith = to_local(jnp.asarray(offset, jnp.float32), receiver.orientation)[:, 2] / distance
    # Cosine of the largest zenith angle of initial points: slightly below the horizon, for footprints that extend above it.
    below_horizon = -0.1
    return np.where(np.asarray(zenith) > below_horizon, facing / distance**2 + 1e-12, 0)


def in_sight(dataset: Dataset, index: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"] | None:
    """Returns whether links have a line of sight; None without a mesh."""
    if not len(dataset.faces):
        return None
    receivers = dataset.rx_positions(index)
    lines, which = np.unique(np.stack([receivers, dataset.tx_positions[index]], 1), axis=0, return_inverse=True)
    triangles = dataset.vertices[dataset.faces].astype(np.float64)
    normals = trimesh.unitize(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    lowest, highest = triangles.min(1), triangles.max(1)
    free = np.ones(len(lines), bool)
    for i, line in enumerate(lines):
        near = np.flatnonzero(((lowest <= line.max(0)) & (highest >= line.min(0))).all(1))  # a few percent of all
        free[i] = not len(near) or not _obstructed(line, triangles[near], normals[near])
    return free[which.reshape(-1)]


def on_surfaces(dataset: Dataset, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Returns which points (metres) lie within `ON` of a surface; none where there are more than `MOST_COMPARED` pairs of a
    point and a triangle."""
    triangles, found = dataset.vertices[dataset.faces].astype(np.float64), np.zeros(len(points), bool)
    if len(triangles) * len(points) > MOST_COMPARED:
        return found
    normals = trimesh.unitize(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    offsets, at_once = np.sum(normals * triangles[:, 0], -1), 4_000_000 // max(len(triangles), 1) + 1
    for first in range(0, len(points), at_once):
        near = np.abs(points[first : first + at_once] @ normals.T - offsets) < ON
        point, triangle = np.nonzero(near & normals.any(-1))
        inside = trimesh.triangles.points_to_barycentric(triangles[triangle], points[first + point]) >= 0
        found[first + point[inside.all(1)]] = True
    return found


def _obstructed(
    line: Float[np.ndarray, "2 3"], triangles: Float[np.ndarray, "faces 3 3"], normals: Float[np.ndarray, "faces 3"]
) -> bool:
    """Returns whether any triangle intersects the line between its two ends."""
    start, way = line[0], line[1] - line[0]
    starts, ways = (np.broadcast_to(vector, normals.shape) for vector in (start, way))
    points, cut, along = trimesh.intersections.planes_lines(triangles[:, 0], normals, starts, ways, return_distance=True)
    inside = (trimesh.triangles.points_to_barycentric(triangles[cut], points) >= 0).all(1)
    clearance = 1e-3  # metres at both ends of a line within which surfaces are ignored: antennas may be mounted on them
    margin = clearance / max(float(np.linalg.norm(way)), clearance)
    return bool((inside & (along > margin) & (along < 1 - margin)).any())


def closed_bodies(dataset: Dataset) -> tuple[ClosedBody, ...]:
    """Returns the closed parts of a scene's surfaces that contain neither a receiver nor most transmitters: such parts are
    rooms."""
    faces = dataset.faces
    if not len(faces):
        return ()
    part = np.zeros(len(faces), int) if dataset.face_part is None else np.asarray(dataset.face_part)
    found: list[ClosedBody] = []
    receivers = np.asarray(dataset.receivers.position, np.float64)
    trained = np.unique(dataset.tx_positions[np.concatenate([dataset.train, dataset.validation])], axis=0)
    for number in np.unique(part):
        own = faces[part == number]
        if not _is_closed(dataset.vertices, own):
            continue
        body = ClosedBody(f"part {number}", np.asarray(dataset.vertices, np.float64)[own])
        if not inside(body, receivers).any() and (not len(trained) or inside(body, trained).mean() < 0.5):
            found.append(body)
    found.sort(key=lambda body: len(body.triangles))
    total = np.cumsum([len(body.triangles) for body in found])
    most_triangles = 20_000  # maximum number of triangles of all bodies together; the largest bodies are omitted
    return tuple(body for body, triangles in zip(found, total, strict=True) if triangles <= most_triangles)


def _is_closed(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "t 3"]) -> bool:
    """Returns whether every edge belongs to two triangles of opposite direction."""
    used, index = np.unique(faces, return_inverse=True)
    alike_m = 1e-4  # metres: vertices nearer than this are identified
    _, same = np.unique(
        np.round(np.asarray(vertices, np.float64)[used] / alike_m).astype(np.int64), axis=0, return_inverse=True
    )
    corners = same.reshape(-1)[index.reshape(-1, 3)]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    there, back = (np.unique(one, axis=0, return_counts=True) for one in (edges, edges[:, ::-1]))
    return np.array_equal(there[0], back[0]) and np.array_equal(there[1], back[1])
