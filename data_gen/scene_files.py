"""Reads the objects of a user's scene: GLB and glTF, OBJ, PLY, and the scene.xml of Sionna RT and Mitsuba.

What comes out is in metres and z-up, whatever the file was. Vertices are merged, so that a body is seen to be closed even where
the file keeps a vertex for every face; triangles without area and repeated ones are dropped.
"""

import io
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from data_gen.materials import Law, own_material
from data_gen.scenes.geometry import merge
from wbgs_jax._util.errors import UserError

Y_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""(x, y, z) of a y-up file becomes (x, -z, y), as Blender does it."""
MERGE_DIGITS = 5
"""Vertices that agree to so many digits after the point, in metres, are one."""
XML_THICKNESS = 0.1
"""Metres: what Sionna RT takes where a scene.xml gives none."""


@dataclass(frozen=True)
class FileObject:
    """One object of a file. Only a scene.xml may know its material and thickness (metres)."""

    name: str
    mesh: trimesh.Trimesh
    material: str | None = None
    thickness: float | None = None


def read_objects(file: Path, up: str | None = None, scale: float = 1.0) -> list[FileObject]:
    """Returns the objects of a file in order of their names, in metres and z-up.

    Args:
        up: "y" or "z"; the axis that points up in the file. Unless given, y for GLB and glTF and z for all others.
        scale: metres in one unit of the file.

    Raises:
        UserError: the file is missing, unreadable, of an unknown kind or without a triangle; or `up` or `scale` make no sense.
    """
    suffix = file.suffix.lower()
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
    objects = [FileObject(o.name, _clean(o, turn, file), o.material, o.thickness) for o in _read(file, READERS[suffix])]
    objects = sorted((o for o in objects if len(o.mesh.faces)), key=lambda o: o.name)
    if not objects:
        raise UserError(f"{file} holds no triangles; export meshes, without compression")
    return objects


def _read(file: Path, reader: Callable[[Path], list[FileObject]]) -> list[FileObject]:
    try:
        return reader(file)
    except UserError:
        raise
    except Exception as error:  # the readers raise whatever damaged bytes lead them to
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"cannot read scene file {file} ({reason}); export it again") from error


def _clean(found: FileObject, turn: Float[np.ndarray, "4 4"], file: Path) -> trimesh.Trimesh:
    faces = found.mesh.faces
    if not len(faces):  # trimesh trips over some of them
        return trimesh.Trimesh()
    if not (faces.min() >= 0 and faces.max() < len(found.mesh.vertices)):
        raise UserError(f"object {found.name!r} of {file} has faces that point at vertices that do not exist; export it again")
    vertices = trimesh.transform_points(found.mesh.vertices, turn)
    if not np.isfinite(vertices).all():
        raise UserError(f"object {found.name!r} of {file} has vertices that are not numbers; export it again")
    mesh = trimesh.Trimesh(vertices, found.mesh.faces, process=False)
    mesh.merge_vertices(digits_vertex=MERGE_DIGITS)
    mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    return mesh


def _read_mesh(file: Path | io.BytesIO, **options: Any) -> list[FileObject]:
    scene = trimesh.load_scene(file, process=False, **options)
    bodies: dict[str, list[trimesh.Trimesh]] = {}
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if isinstance(mesh, trimesh.Trimesh):  # and not a curve or a cloud of points
            # glTF cuts an object of several visual materials into primitives, which trimesh puts below it.
            whole = scene.graph.transforms.parents[node] if mesh.metadata.get("from_gltf_primitive") else node
            placed = trimesh.Trimesh(trimesh.transform_points(mesh.vertices, transform), mesh.faces, process=False)
            bodies.setdefault(str(whole).strip(), []).append(placed)
    return [FileObject(name, merge(meshes)) for name, meshes in bodies.items()]


def _read_obj(file: Path) -> list[FileObject]:
    text = file.read_text(errors="replace")
    if not re.search(r"^o\s", text, re.MULTILINE):
        text = re.sub(r"^g\s", "o ", text, flags=re.MULTILINE)
    text = f"o {file.stem}\n{text}"  # what comes before the first name
    options = {"file_type": "obj", "split_objects": True, "group_material": False, "skip_materials": True}
    return _read_mesh(io.BytesIO(text.encode()), **options)


def _read_ply(file: Path) -> list[FileObject]:
    return [FileObject(file.stem, o.mesh) for o in _read_mesh(file)]


def _read_xml(file: Path) -> list[FileObject]:
    root = ET.parse(file).getroot()
    materials = {bsdf.get("id"): _xml_material(bsdf) for bsdf in root.findall("bsdf")}
    shapes = [shape for shape in root.iter("shape") if shape.get("type") != "merge"]
    return [_xml_object(shape, i, materials, file) for i, shape in enumerate(shapes, 1)]


def _xml_object(shape: ET.Element, number: int, materials: dict, file: Path) -> FileObject:
    name = (shape.get("id") or f"shape_{number}").removeprefix("mesh-")
    if shape.get("type") not in ("ply", "obj"):
        raise UserError(f"shape {name!r} of {file} is of type {shape.get('type')!r}; export it as ply or obj")
    filename = shape.find("string[@name='filename']")
    path = file.parent / (filename.get("value", "") if filename is not None else "")
    if not path.is_file():
        raise UserError(f"shape {name!r} of {file} needs the file {path}, which is missing; export the meshes too")
    mesh = trimesh.load_mesh(path, process=False)
    mesh.apply_transform(_xml_transform(shape.find("transform[@name='to_world']"), name, file))
    named = [materials.get(reference.get("id")) for reference in shape.findall("ref")]
    found = [material for material in [*named, *map(_xml_material, shape.findall("bsdf"))] if material]
    return FileObject(name, mesh, *(found[0] if found else (None, None)))


def _xml_transform(transform: ET.Element | None, name: str, file: Path) -> Float[np.ndarray, "4 4"]:
    """Returns the matrix of a transform; Mitsuba applies its steps in the order in which they are written."""
    result = np.eye(4)
    for step in transform if transform is not None else ():
        match step.tag:
            case "translate":
                matrix = trimesh.transformations.translation_matrix(_xml_vector(step, 0.0))
            case "scale":
                matrix = np.diag([*_xml_vector(step, 1.0), 1.0])
            case "rotate":
                angle = np.radians(float(step.get("angle", 0)))
                matrix = trimesh.transformations.rotation_matrix(angle, _xml_vector(step, 0.0))
            case "matrix":
                matrix = np.array(_numbers(step.get("value", ""))).reshape(4, 4)
            case _:
                raise UserError(f"shape {name!r} of {file} is moved by <{step.tag}>; write a <matrix> in its place")
        result = matrix @ result
    return result


def _xml_vector(step: ET.Element, missing: float) -> list[float]:
    value = _numbers(step.get("value", ""))
    return value * 3 if len(value) == 1 else value or [float(step.get(axis, missing)) for axis in "xyz"]


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.replace(",", " ").split()]


def _xml_material(bsdf: ET.Element) -> tuple[str, float] | None:
    """Returns the material and thickness as Sionna RT understands a bsdf; None for one that says nothing about radio."""

    def value(kind: str, name: str, missing: float | str) -> Any:
        found = bsdf.find(f"{kind}[@name='{name}']")
        return missing if found is None else type(missing)(found.get("value", missing))

    name = (bsdf.get("id") or "").removeprefix("mat-")
    thickness = value("float", "thickness", XML_THICKNESS)
    if bsdf.get("type") == "itu-radio-material" or name.startswith(("itu_", "itu-")):
        return value("string", "type", name[4:]), thickness
    if bsdf.get("type") == "radio-material":
        law = Law(value("float", "relative_permittivity", 1.0), 0.0, value("float", "conductivity", 0.0), 0.0)
        return own_material(name, law), thickness
    return None


READERS: dict[str, Callable[[Path], list[FileObject]]] = {
    ".glb": _read_mesh, ".gltf": _read_mesh, ".obj": _read_obj, ".ply": _read_ply, ".xml": _read_xml,
}  # fmt: skip
_UP = {".glb": "y", ".gltf": "y"}
