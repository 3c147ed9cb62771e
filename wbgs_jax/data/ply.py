"""PLY meshes and point clouds in and out; positions in metres, in whatever frame the file has."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from plyfile import PlyData, PlyElement

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write


def read_ply(path: Path | str) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Returns vertices (float32) and triangles (int32) of a PLY file, ASCII or binary.

    Quads and larger polygons become fans of triangles; polygons of fewer than three corners are left out. A cloud without
    faces has no triangles.

    Raises:
        UserError: the file is missing, truncated, not a PLY, without points, or its numbers make no mesh.
    """
    path, elements = Path(path), read_elements(path)
    corners = elements.get("vertex", np.zeros(0))
    if not {"x", "y", "z"} <= set(corners.dtype.names or ()) or len(corners) == 0:
        raise UserError(f"{path} holds no points: it needs a 'vertex' element with x, y and z; export the mesh again")
    vertices = np.stack([np.asarray(corners[axis], np.float32) for axis in "xyz"], -1)
    if not np.isfinite(vertices).all():
        raise UserError(f"{path} has NaN or infinity among its vertices; clean the mesh and export it again")
    faces = _triangles(elements.get("face"))
    if faces.size and not (faces.min() >= 0 and faces.max() < len(vertices)):
        raise UserError(f"{path} has faces that point at vertices that do not exist; export the mesh again")
    return vertices, faces.astype(np.int32)


def read_elements(path: Path | str) -> dict[str, np.ndarray]:
    """Returns the elements of a PLY file by name, each a structured array.

    Raises:
        UserError: the file is missing, truncated, or not a PLY.
    """
    # Read, not mapped into memory: a mapped file that becomes shorter meanwhile would end the process (SIGBUS).
    try:
        return {element.name: element.data for element in PlyData.read(path, mmap=False).elements}
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}; check the path and its permissions") from error
    except Exception as error:  # sizes, types and names in a damaged header can be anything
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path} is not a PLY file or is truncated ({reason}); export it again") from error


def write_ply(path: Path | str, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> None:
    """Writes float32 vertices and int32 triangles as a binary PLY file, atomically; no triangles make a point cloud."""
    corners = np.rec.fromarrays(np.asarray(vertices, "<f4").T, dtype=[(axis, "<f4") for axis in "xyz"])
    elements = [PlyElement.describe(corners, "vertex")]
    if len(faces):
        rows = np.empty(len(faces), [("vertex_indices", "<i4", (3,))])
        rows["vertex_indices"] = faces
        elements.append(PlyElement.describe(rows, "face"))
    with atomic_write(path) as stream:
        PlyData(elements, byte_order="<").write(stream)


def _triangles(polygons: np.ndarray | None) -> np.ndarray:
    """Returns fans of triangles, int64 (n, 3), of plyfile's `face` element; corner 0 of a polygon is in each of its own."""
    names = set() if polygons is None else {"vertex_indices", "vertex_index"} & set(polygons.dtype.names or ())
    if polygons is None or len(polygons) == 0 or not names:
        return np.zeros((0, 3), np.int64)
    polygons = polygons[names.pop()]
    sizes = np.fromiter(map(len, polygons), np.int64, len(polygons))
    corners = np.concatenate(list(polygons)).astype(np.int64)
    fans = np.maximum(sizes - 2, 0)
    first = np.repeat(np.cumsum(sizes) - sizes, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)  # 0, 1, ... within each polygon
    return corners[np.stack([first, first + step + 1, first + step + 2], -1)]
