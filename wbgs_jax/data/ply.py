"""Meshes and point clouds as PLY files, in and out; positions in metres, in whatever frame the file has."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.ply_elements import Ragged, read_elements, write_elements
from wbgs_jax.data.polygons import triangulate

CORNERS = ("vertex_indices", "vertex_index")
"""What exporters call the corners of faces."""
STRIPS = "tristrips"
"""Element whose lists are strips of triangles: each corner makes one with the two before it; -1 begins a new strip."""


def read_ply(path: Path | str) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Returns vertices (float32) and triangles (int32) of a PLY file, ASCII or binary; otherwise as `read_mesh`."""
    vertices, faces = read_mesh(path)
    with np.errstate(over="ignore"):
        single = vertices.astype(np.float32)
    if not np.isfinite(single).all():
        raise UserError(f"{path} has NaN or infinity among its vertices; clean the mesh and export it again")
    return single, faces


def read_mesh(path: Path | str) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Returns vertices (float64) and triangles (int32) of a PLY file, ASCII or binary.

    Quads and larger polygons, concave ones too, and strips of triangles are cut into triangles; polygons of fewer than three
    corners are left out. A cloud without faces has no triangles.

    Raises:
        UserError: the file is missing, truncated, not a PLY, without points, or its numbers make no mesh.
    """
    path, elements = Path(path), read_elements(path)
    points, polygons = elements.get("vertex", {}), elements.get("face", {})
    axes = [points.get(axis) for axis in "xyz"]
    if not all(isinstance(axis, np.ndarray) and len(axis) for axis in axes):
        raise UserError(f"{path} holds no points: it needs a 'vertex' element with x, y and z; export the mesh again")
    vertices = np.stack([np.asarray(axis, np.float64) for axis in axes], -1)
    corners = next((polygons[name] for name in CORNERS if name in polygons), None)
    if isinstance(corners, np.ndarray):
        raise UserError(f"{path} has one corner a face; export the mesh again")
    faces = np.zeros((0, 3), np.int64)
    if corners is not None:
        faces = triangulate(vertices, np.asarray(corners.values, np.int64), corners.sizes)
    strips = elements.get(STRIPS, {})
    for own in (strips[name] for name in CORNERS if name in strips):
        if isinstance(own, Ragged):
            faces = np.concatenate([faces, strip_triangles(own)])
    if faces.size and not (faces.min() >= 0 and faces.max() < len(vertices)):
        raise UserError(f"{path} has faces that point at vertices that do not exist; export the mesh again")
    return vertices, faces.astype(np.int32)


def write_ply(path: Path | str, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> None:
    """Writes float32 vertices and int32 triangles as a binary PLY file, atomically; no triangles make a point cloud."""
    points = np.rec.fromarrays(np.asarray(vertices, "<f4").T, dtype=[(axis, "<f4") for axis in "xyz"])
    elements: dict[str, np.ndarray] = {"vertex": points}
    if len(faces):
        elements["face"] = np.zeros(len(faces), [(CORNERS[0], "<i4", (3,))])
        elements["face"][CORNERS[0]] = faces
    write_elements(path, elements)


def strip_triangles(strips: Ragged) -> Int[np.ndarray, "n 3"]:
    """Returns the triangles of strips, every second one turned back; those without area only lead from one part to the next."""
    found = [np.zeros((0, 3), np.int64)]
    for own in np.split(np.asarray(strips.values, np.int64), np.cumsum(strips.sizes)[:-1]):
        for part in np.split(own, np.flatnonzero(own == -1)):
            corners = part[part != -1]
            if len(corners) < 3:
                continue
            three = np.stack([corners[:-2], corners[1:-1], corners[2:]], -1)
            three[1::2] = three[1::2, [1, 0, 2]]
            alike = (three[:, 0] == three[:, 1]) | (three[:, 1] == three[:, 2]) | (three[:, 0] == three[:, 2])
            found.append(three[~alike])
    return np.concatenate(found)
