"""Reads the objects of a room's file: GLB and glTF, OBJ, PLY, and the scene.xml of Sionna RT and Mitsuba.

What comes out is in metres and z-up, whatever the file was. Vertices are merged, so that a body is seen to be closed even where
the file keeps a vertex for every face; triangles without area and repeated ones are dropped.
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
"""(x, y, z) of a y-up file becomes (x, -z, y), as Blender does it."""
MERGE_DIGITS = 5
"""Vertices that agree to so many digits after the point, in metres, are one."""
OTHERS = {
    ".ifc": "a building model: export it as glTF, OBJ or scene.xml",
    ".dxf": "a drawing: export meshes, as OBJ",
    ".dwg": "a drawing: export meshes, as OBJ",
    ".svg": "a drawing: walls go into walls.csv (docs/measured.md)",
    ".geojson": "a map: export meshes, as OBJ",
    ".fbx": "of Autodesk's own form: export it as glTF",
    ".blend": "of Blender's own form: export it as glTF",
    ".stl": "without names of objects: export it as OBJ or glTF",
    ".usd": "a stage of OpenUSD: export it as glTF",
    **dict.fromkeys((".usda", ".usdc", ".usdz"), "a stage of OpenUSD: export it as glTF"),
    ".off": "without names of objects: export it as OBJ or glTF",
    ".3mf": "for printing: export it as glTF",
    ".abc": "of Alembic: export it as glTF",
    ".dae": "of COLLADA: export it as glTF",
    ".3ds": "of 3D Studio: export it as glTF",
}
"""What files of other kinds are, and the way from there."""


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
        up: "y" or "z"; the axis that points up in the file. Unless given, y for GLB and glTF and z for all others.
        scale: metres in one unit of the file.

    Raises:
        UserError: the file is missing, unreadable, of an unknown kind, without a triangle, or far from its origin; it declares
            something that is not read; or `up` or `scale` make no sense.
    """
    suffix = file.suffix.lower()
    if suffix in OTHERS:
        raise UserError(f"{file} is {OTHERS[suffix]}")
    if suffix not in READERS:
        raise UserError(f"{file}: a scene is one of {', '.join(READERS)}; export it as one of these")
    if not file.is_file():
        raise UserError(f"there is no scene file {file}; check the path")
    if up not in (None, "y", "z"):
        raise UserError(f"--up is {up!r}; give y or z, the axis that points up in {file}")
    if not 0 < scale < float("inf"):
        raise UserError(f"--scale is {scale}; give the metres in one unit of {file}, 0.001 for millimetres")
    turn = Y_UP if (up or _UP.get(suffix, "z")) == "y" else np.eye(4)
    turn = trimesh.transformations.scale_matrix(scale) @ turn
    objects = [FileObject(body.name, _clean(body, turn, file), body.material) for body in _read(file, READERS[suffix])]
    objects = sorted((o for o in objects if len(o.mesh.faces)), key=lambda o: o.name)
    if not objects:
        raise UserError(f"{file} holds no triangles; export meshes, without compression")
    bounds = np.array([o.mesh.bounds for o in objects])
    low, high = bounds[:, 0].min(0), bounds[:, 1].max(0)
    if np.abs([low, high]).max() > LARGEST_COORDINATE_M and (np.abs(low + high) / 2 > high - low).any():
        centre = ", ".join(f"{value:.0f}" for value in (low + high) / 2)
        raise UserError(
            f"{file} lies around ({centre}) m, where single precision is too coarse for waves; subtract a place on the site "
            "from all positions, of the mesh, transmitters and receivers alike"
        )
    return objects


def _read(file: Path, reader: Callable[[Path], list[Body]]) -> list[Body]:
    try:
        return joined(reader(file))
    except UserError:
        raise
    except Exception as error:  # damaged bytes lead anywhere
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"cannot read scene file {file} ({reason}); export it again") from error


def _clean(body: Body, turn: Float[np.ndarray, "4 4"], file: Path) -> trimesh.Trimesh:
    faces = body.faces
    if not len(faces):  # trimesh trips over some of them
        return trimesh.Trimesh()
    if not (faces.min() >= 0 and faces.max() < len(body.vertices)):
        raise UserError(f"object {body.name!r} of {file} has faces that point at vertices that do not exist; export it again")
    used, faces = np.unique(faces, return_inverse=True)
    vertices = trimesh.transform_points(body.vertices[used], turn)
    if not np.isfinite(vertices).all():
        raise UserError(f"object {body.name!r} of {file} has vertices that are not numbers; export it again")
    mesh = trimesh.Trimesh(vertices, faces.reshape(-1, 3), process=False)
    mesh.merge_vertices(digits_vertex=MERGE_DIGITS)
    mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    return mesh


def _read_ply(file: Path) -> list[Body]:
    vertices, faces = read_mesh(file)
    if not len(faces):
        raise UserError(f"{file} holds points without faces; make a mesh of them first (Poisson reconstruction, say)")
    return [Body(file.stem, vertices, faces)]


READERS: dict[str, Callable[[Path], list[Body]]] = {
    ".glb": read_gltf, ".gltf": read_gltf, ".obj": read_obj, ".ply": _read_ply, ".xml": read_mitsuba
}  # fmt: skip
_UP = {".glb": "y", ".gltf": "y"}
