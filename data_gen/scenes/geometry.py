"""Meshes and questions about them: boxes, inside or outside, crossings, distances. Metres, z up."""

from collections.abc import Iterable, Iterator

import numpy as np
import trimesh
from jaxtyping import Float, Int

Vec3 = tuple[float, float, float]

CHUNK = 1_000_000
"""Pairs of a point and a triangle that are looked at together; bounds the memory to some 100 MB."""


def box(low: Vec3, high: Vec3) -> trimesh.Trimesh:
    """A closed axis-aligned box."""
    mesh = trimesh.creation.box(extents=np.subtract(high, low))
    mesh.apply_translation(np.add(low, high) / 2)
    return mesh


def merge(meshes: Iterable[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Several bodies as one mesh."""
    meshes = list(meshes)
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    faces = [np.asarray(m.faces) + start for m, start in zip(meshes, offsets, strict=False)]
    return trimesh.Trimesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(faces), process=False)


def winding_number(mesh: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """How often a closed mesh goes around every point: 0 outside, 1 or -1 inside (sum of the triangles' solid angles)."""
    each = [_solid_angles(mesh, points[rows]).sum(1) for rows in _chunks(len(points), len(mesh.faces))]
    return np.concatenate([np.zeros(0), *each]) / (4 * np.pi)


def _solid_angles(mesh: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n m"]:
    a, b, c = (np.asarray(mesh.triangles)[None, :, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    triple = np.einsum("nmi,nmi->nm", a, np.cross(b, c))
    below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return 2 * np.arctan2(triple, below)


def crossings(
    triangles: Float[np.ndarray, "m 3 3"], start: Float[np.ndarray, "n 3"], end: Float[np.ndarray, "3"]
) -> Int[np.ndarray, "n"]:
    """How many triangles the straight segment from every start to the one end goes through (Möller and Trumbore)."""
    each = [_crossed(triangles, start[rows], end).sum(1) for rows in _chunks(len(start), len(triangles))]
    return np.concatenate([np.zeros(0, int), *each])


def _crossed(triangles: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    corner, first, second = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    way = (end - start)[:, None]
    across = np.cross(way, second)
    volume = (across * first).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):  # a segment parallel to a triangle never crosses it
        offset = start[:, None] - corner
        u = (across * offset).sum(-1) / volume
        turned = np.cross(offset, first)
        v = (turned * way).sum(-1) / volume
        t = (turned * second).sum(-1) / volume
        return (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1)


def distance(mesh: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Distance of every point to the nearest place on a mesh."""
    rows = _chunks(len(points), len(mesh.faces))
    each = [trimesh.proximity.closest_point_naive(mesh, points[found])[1] for found in rows]
    return np.concatenate([np.zeros(0), *each])


def box_distance(mesh: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Distance of every point to a mesh's bounding box, 0 inside it: never more than that to the mesh."""
    low, high = mesh.bounds
    return np.linalg.norm(np.maximum(0, np.maximum(low - points, points - high)), axis=1)


def _chunks(n_points: int, n_triangles: int) -> Iterator[slice]:
    step = max(1, CHUNK // max(1, n_triangles))
    return (slice(i, i + step) for i in range(0, n_points, step))
