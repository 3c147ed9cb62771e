"""Reads the objects of a room file: GLB and glTF, OBJ, PLY, and the scene.xml of Sionna RT and Mitsuba.

The result is in metres and z-up for every kind of file. Vertices are merged, so that a body is recognised as closed even if
the file stores vertices separately for every face; degenerate and repeated triangles are dropped.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.mesh.bodies import Body, RadioMaterial, joined
from wbgs_jax.mesh.gltf import read_gltf
from wbgs_jax.mesh.mitsuba import read_mitsuba
from wbgs_jax.mesh.ply import read_mesh
from wbgs_jax.mesh.wavefront import read_obj
from wbgs_jax.types import LARGEST_COORDINATE_M

Y_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""Transform of a y-up file: (x, y, z) becomes (x, -z, y), as in Blender."""
OTHERS = {
    ".ifc": "a building model: export it as glTF, OBJ or scene.xml",
    ".dxf": "a drawing: export meshes, as OBJ",
    ".dwg": "a drawing: export meshes, as OBJ",
    ".svg": "a drawing: walls go into walls.csv (docs/measured.md)",
    ".geojson": "a map: export meshes, as OBJ",
    ".fbx": "in Autodesk's own format: export it as glTF",
    ".blend": "in Blender's own format: export it as glTF",
    ".stl": "without names of objects: export it as OBJ or glTF",
    ".usd": "a stage of OpenUSD: export it as glTF",
    **dict.fromkeys((".usda", ".usdc", ".usdz"), "a stage of OpenUSD: export it as glTF"),
    ".off": "without names of objects: export it as OBJ or glTF",
    ".3mf": "a format for printing: export it as glTF",
    ".abc": "an Alembic file: export it as glTF",
    ".dae": "a COLLADA file: export it as glTF",
    ".3ds": "a 3D Studio file: export it as glTF",
}
"""Descriptions of unsupported kinds of files, with a way to convert them."""


@dataclass(frozen=True)
class FileObject:
    """One object of a file. Only a scene.xml may record its material."""

    name: str
    mesh: trimesh.Trimesh
    material: RadioMaterial | None = None


def read_objects(file: Path, up: str | None = None, scale: float = 1.0) -> list[FileObject]:
    """Returns the objects of a file in order of their names, in metres and z-up.

    Args:
        file: .glb, .gltf, .obj, .ply or .xml.
        up: "y" or "z", the axis that points up in the file; by default y for GLB and glTF and z for all others.
        scale: metres per unit of the file.

    Raises:
        UserError: the file is missing, unreadable, of an unknown kind, without a triangle, or far from its origin; it contains
            an unsupported object; or `up` or `scale` is invalid.
    """
    suffix = file.suffix.lower()
    if suffix in OTHERS:
        raise UserError(f"{file} is {OTHERS[suffix]}")
    if suffix not in READERS:
        raise UserError(f"{file} is not a supported scene file ({', '.join(READERS)}); export it as one of these")
    if not file.is_file():
        raise UserError(f"scene file {file} does not exist; check the path")
    if up not in (None, "y", "z"):
        raise UserError(f"--up is {up!r}; give y or z, the axis that points up in {file}")
    if not 0 < scale < float("inf"):
        raise UserError(f"--scale is {scale}; give the metres per unit of {file}, such as 0.001 for millimetres")
    turn = Y_UP if (up or ("y" if suffix in (".glb", ".gltf") else "z")) == "y" else np.eye(4)
    turn = trimesh.transformations.scale_matrix(scale) @ turn
    objects = [FileObject(body.name, _clean(body, turn, file), body.material) for body in _read(file, READERS[suffix])]
    objects = sorted((o for o in objects if len(o.mesh.faces)), key=lambda o: o.name)
    if not objects:
        raise UserError(f"{file} has no triangles; export meshes, without compression")
    bounds = np.array([o.mesh.bounds for o in objects])
    low, high = bounds[:, 0].min(0), bounds[:, 1].max(0)
    if np.abs([low, high]).max() > LARGEST_COORDINATE_M and (np.abs(low + high) / 2 > high - low).any():
        centre = ", ".join(f"{value:.0f}" for value in (low + high) / 2)
        raise UserError(
            f"{file} lies around ({centre}) m, where single precision is too coarse for waves; subtract a point on the site "
            "from all positions of the mesh, transmitters and receivers"
        )
    return objects


def _read(file: Path, reader: Callable[[Path], list[Body]]) -> list[Body]:
    try:
        return joined(reader(file))
    except UserError:
        raise
    except Exception as error:  # damaged files can raise anything
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"cannot read scene file {file} ({reason}); export it again") from error


def _clean(body: Body, turn: Float[np.ndarray, "4 4"], file: Path) -> trimesh.Trimesh:
    faces = body.faces
    if not len(faces):  # trimesh fails on some empty bodies
        return trimesh.Trimesh()
    if not (faces.min() >= 0 and faces.max() < len(body.vertices)):
        raise UserError(f"object {body.name!r} of {file} has faces that refer to vertices that do not exist; export it again")
    used, faces = np.unique(faces, return_inverse=True)
    vertices = trimesh.transform_points(body.vertices[used], turn)
    if not np.isfinite(vertices).all():
        raise UserError(f"object {body.name!r} of {file} has vertex coordinates that are not finite; export it again")
    mesh = trimesh.Trimesh(vertices, faces.reshape(-1, 3), process=False)
    merge_digits = 5  # vertices that agree to this many decimal places, in metres, are merged
    mesh.merge_vertices(digits_vertex=merge_digits)
    mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    return mesh


def _read_ply(file: Path) -> list[Body]:
    vertices, faces = read_mesh(file)
    if not len(faces):
        raise UserError(f"{file} has points without faces; reconstruct a mesh first (for example by Poisson reconstruction)")
    return [Body(file.stem, vertices, faces)]


READERS: dict[str, Callable[[Path], list[Body]]] = {
    ".glb": read_gltf, ".gltf": read_gltf, ".obj": read_obj, ".ply": _read_ply, ".xml": read_mitsuba
}  # fmt: skip
