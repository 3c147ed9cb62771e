"""Meshes and point clouds as PLY files, in and out; positions in metres, in whatever frame the file has."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.ply_elements import Ragged, read_elements, write_elements

CORNERS = ("vertex_indices", "vertex_index")
"""What exporters call the corners of faces."""


def read_ply(path: Path | str) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Returns vertices (float32) and triangles (int32) of a PLY file, ASCII or binary.

    Quads and larger polygons become fans of triangles; polygons of fewer than three corners are left out. A cloud without
    faces has no triangles.

    Raises:
        UserError: the file is missing, truncated, not a PLY, without points, or its numbers make no mesh.
    """
    path, elements = Path(path), read_elements(path)
    points, polygons = elements.get("vertex", {}), elements.get("face", {})
    axes = [points.get(axis) for axis in "xyz"]
    if not all(isinstance(axis, np.ndarray) and len(axis) for axis in axes):
        raise UserError(f"{path} holds no points: it needs a 'vertex' element with x, y and z; export the mesh again")
    vertices = np.stack([np.asarray(axis, np.float32) for axis in axes], -1)
    if not np.isfinite(vertices).all():
        raise UserError(f"{path} has NaN or infinity among its vertices; clean the mesh and export it again")
    corners = next((polygons[name] for name in CORNERS if name in polygons), None)
    if isinstance(corners, np.ndarray):
        raise UserError(f"{path} has one corner a face; export the mesh again")
    faces = np.zeros((0, 3), np.int64) if corners is None else _triangles(corners)
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


def _triangles(polygons: Ragged) -> Int[np.ndarray, "n 3"]:
    """Returns fans of triangles; corner 0 of a polygon is in each of its own."""
    corners, sizes = np.asarray(polygons.values, np.int64), polygons.sizes
    fans = np.maximum(sizes - 2, 0)
    first = np.repeat(np.cumsum(sizes) - sizes, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)  # 0, 1, ... within each polygon
    return corners[np.stack([first, first + step + 1, first + step + 2], -1)]
