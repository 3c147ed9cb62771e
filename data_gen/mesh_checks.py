"""Classification of a user's meshes (solids or sheets), and detection of errors that a ray tracer would not report. Metres, z
up."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from data_gen.scenes.base import Part
from data_gen.scenes.geometry import distance

TOUCH = 1e-4
"""Metres: surfaces nearer than this coincide."""
FLAT = 1e-3
"""Metres: maximum distance of a wall from the side of the scene in which it lies."""
MIN_VOLUME = 1e-9
"""Cubic metres: a body enclosing less is two sheets back to back."""
ROOM_SHARE = 0.9
"""Minimum size of a room's own mesh relative to the scene's length, width and height."""
PLACES = np.array([(0.34, 0.33, 0.33), *itertools.permutations((0.79, 0.14, 0.07))])
"""Points of a triangle at which another surface is searched for, as weights of its corners."""
LARGEST = 300
"""Maximum number of triangles of an object that are examined, the largest first."""


def is_solid(mesh: trimesh.Trimesh, bounds: Float[np.ndarray, "2 3"]) -> bool:
    """Returns whether a mesh is a closed body; one as large as the scene (`bounds`) is the room itself, hence a sheet."""
    is_room = (mesh.extents > ROOM_SHARE * np.ptp(bounds, axis=0)).all()
    return bool(mesh.is_watertight and abs(mesh.volume) > MIN_VOLUME and not is_room)


def kind(mesh: trimesh.Trimesh, bounds: Float[np.ndarray, "2 3"]) -> str:
    """Returns the kind (`KINDS`) of a part with this mesh; sheets in one of the six sides of the scene's bounds are shell."""
    if is_solid(mesh, bounds):
        return "solid"
    in_side = (np.abs(mesh.bounds - bounds[:, None]) < FLAT).all(1)
    return "shell" if in_side.any() else "partition"


def outward(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Returns a solid with outward normals, correcting mirrored or inconsistent exports."""
    mesh = mesh.copy()
    trimesh.repair.fix_normals(mesh, multibody=True)
    return mesh


def folds(mesh: trimesh.Trimesh) -> Bool[np.ndarray, " edges"]:
    """Returns a mask of those `face_adjacency_edges` at which a mesh folds back onto itself, so that two triangles coincide."""
    vertices = np.asarray(mesh.vertices)
    start, end = vertices[mesh.face_adjacency_edges].swapaxes(0, 1)
    along = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    arms = vertices[mesh.face_adjacency_unshared] - start[:, None]
    arms -= np.einsum("eak,ek->ea", arms, along)[..., None] * along[:, None]
    first, second = (arms / np.linalg.norm(arms, axis=2, keepdims=True)).swapaxes(0, 1)
    return np.einsum("ek,ek->e", first, second) > 1 - 1e-6


def surface_flaws(parts: Sequence[Part]) -> Iterator[str]:
    """Yields a message for every part that folds back onto itself, and for every two coinciding sheets.

    A solid may touch a sheet, as furniture on the floor does: the face in between is never visible.
    """
    for part in parts:
        if (found := folds(part.mesh)).any():
            where = place(part.mesh.vertices[part.mesh.face_adjacency_edges[found][0, 0]])
            advice = "triangulate its faces on export and remove duplicates"
            yield f"object {part.name!r} folds back onto itself at {where}; {advice}"
    sheets = [p for p in parts if not p.closed]
    bounds = np.array([p.mesh.bounds for p in sheets]).reshape(-1, 2, 3)
    for first, (low, high) in zip(sheets, bounds, strict=True):
        for near in np.flatnonzero(((bounds[:, 0] < high + TOUCH) & (bounds[:, 1] > low - TOUCH)).all(1)):
            second = sheets[near]
            if second is not first and (points := _common(first.mesh, second.mesh)).any():
                yield (
                    f"objects {first.name!r} and {second.name!r} coincide, for example at {place(points[0])}; "
                    "cut a hole where the other one is, or remove one"
                )


def _common(first: trimesh.Trimesh, second: trimesh.Trimesh) -> Float[np.ndarray, "points 3"]:
    """Returns points of the first mesh at which the second one coincides with it."""
    largest = np.argsort(-first.area_faces, kind="stable")[:LARGEST]
    points = (PLACES @ first.triangles[largest]).reshape(-1, 3)
    normals = np.repeat(first.face_normals[largest], len(PLACES), axis=0)
    near = ((points > second.bounds[0] - TOUCH) & (points < second.bounds[1] + TOUCH)).all(1)
    points, normals = points[near], normals[near]
    beside = distance(second, points + 10 * TOUCH * normals)  # a surface that merely crosses is still near there
    return points[(distance(second, points) < TOUCH) & (beside > 9 * TOUCH)]


def place(point: Sequence[float] | np.ndarray) -> str:
    """Returns a point as text, in metres."""
    return f"({', '.join(f'{value:.4g}' for value in point)})"
