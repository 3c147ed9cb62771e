"""Reads objects from a scene.xml of Mitsuba or Sionna RT: mesh files, rectangles, cubes, spheres, disks and cylinders."""

import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path, PureWindowsPath

import numpy as np
import trimesh
from jaxtyping import Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.mesh.bodies import Body, RadioMaterial, joined
from wbgs_jax.mesh.ply import read_mesh
from wbgs_jax.mesh.wavefront import read_obj

RADIO = (
    *("relative_permittivity", "conductivity", "thickness", "color"),
    *("scattering_coefficient", "xpd_coefficient", "scattering_pattern", "alpha_r", "alpha_i", "lambda_"),
)
"""Properties of a radio-material of Sionna RT; scattering and colour do not matter here."""
SECTIONS = 64
"""Number of segments that approximate a circle."""


def read_mitsuba(file: Path) -> list[Body]:
    """Returns the shapes of a scene.

    Raises:
        UserError: an unsupported shape; the message names it.
    """
    root = ET.parse(file).getroot()
    _fill_in(root, file)
    if root.find(".//include") is not None:
        raise UserError(f"{file} includes other files; export it in one")
    materials = {bsdf.get("id"): _material(bsdf, file) for bsdf in root.findall("bsdf")}
    shapes = [shape for shape in root.iter("shape") if shape.get("type") != "merge"]
    return [_body(shape, number, materials, file) for number, shape in enumerate(shapes, 1)]


def _fill_in(root: ET.Element, file: Path) -> None:
    """Replaces $name by the value of its <default>."""
    values = {one.get("name", ""): one.get("value", "") for one in root.iter("default")}
    for element in root.iter():
        for key, text in element.attrib.items():
            if "$" not in text:
                continue
            for name in sorted(values, key=len, reverse=True):
                text = text.replace(f"${name}", values[name])
            if "$" in text:
                raise UserError(f"{file} has no value for {text[:40]!r}; add a <default> for it")
            element.set(key, text)


def _body(shape: ET.Element, number: int, materials: dict[str | None, RadioMaterial | None], file: Path) -> Body:
    name = (shape.get("id") or shape.get("name") or f"shape_{number}").removeprefix("mesh-")  # Mitsuba itself writes `name`
    kind = shape.get("type") or ""
    if kind in ("ply", "obj"):
        vertices, faces = _from_file(shape, name, kind, file)
    elif kind in BUILT_IN:
        made = BUILT_IN[kind](shape)
        vertices, faces = np.asarray(made.vertices, np.float64), np.asarray(made.faces)
    else:
        raise UserError(f"shape {name!r} of {file} has the unsupported type {kind!r}; export it as ply or obj")
    transforms = ("to_world", "toWorld")  # names of a shape's transform, since version 2 and before
    moved = next((one for one in shape.findall("transform") if one.get("name") in transforms), None)
    matrix = _transform(moved, name, file)
    vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    named = [materials.get(reference.get("id")) for reference in shape.findall("ref")]
    own = [_material(bsdf, file) for bsdf in shape.findall("bsdf")]
    found = [material for material in [*named, *own] if material]
    return Body(name, vertices, faces, found[0] if found else None)


def _from_file(shape: ET.Element, name: str, kind: str, file: Path) -> tuple[np.ndarray, np.ndarray]:
    filename = shape.find("string[@name='filename']")
    written = filename.get("value", "") if filename is not None else ""
    path = file.parent / written
    if not path.is_file() and "\\" in written:
        path = file.parent.joinpath(*PureWindowsPath(written).parts)
    if not path.is_file():
        raise UserError(f"shape {name!r} of {file} needs the file {path}, which is missing; export the meshes too")
    if kind == "ply":
        return read_mesh(path)
    (whole,) = joined([body._replace(name=name) for body in read_obj(path)])
    return whole.vertices, whole.faces


def _rectangle(_: ET.Element) -> trimesh.Trimesh:
    corners = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def _cube(_: ET.Element) -> trimesh.Trimesh:
    return trimesh.creation.box((2, 2, 2))


def _disk(_: ET.Element) -> trimesh.Trimesh:
    turn = 2 * np.pi * np.arange(SECTIONS) / SECTIONS
    rim = np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
    following = np.roll(np.arange(SECTIONS), -1)
    faces = np.stack([np.full(SECTIONS, SECTIONS), np.arange(SECTIONS), following], -1)
    return trimesh.Trimesh(np.concatenate([rim, np.zeros((1, 3))]), faces, process=False)


def _sphere(shape: ET.Element) -> trimesh.Trimesh:
    made = trimesh.creation.uv_sphere(_value(shape, "radius", 1.0), count=[SECTIONS // 2, SECTIONS])
    made.apply_translation(_point(shape, "center", (0.0, 0.0, 0.0)))
    return made


def _cylinder(shape: ET.Element) -> trimesh.Trimesh:
    """Returns the side of a cylinder, without caps."""
    start, end = _point(shape, "p0", (0.0, 0.0, 0.0)), _point(shape, "p1", (0.0, 0.0, 1.0))
    rim = _disk(shape).vertices[:SECTIONS] * _value(shape, "radius", 1.0)
    length = float(np.linalg.norm(end - start))
    turn = trimesh.geometry.align_vectors([0, 0, 1], end - start)
    below = np.arange(SECTIONS)
    beside = np.roll(below, -1)
    faces = np.concatenate(
        [np.stack([below, beside, beside + SECTIONS], -1), np.stack([below, beside + SECTIONS, below + SECTIONS], -1)]
    )
    made = trimesh.Trimesh(np.concatenate([rim, rim + np.array([0, 0, length])]), faces, process=False)
    made.apply_transform(turn)
    made.apply_translation(start)
    return made


BUILT_IN: dict[str, Callable[[ET.Element], trimesh.Trimesh]] = {
    "rectangle": _rectangle, "cube": _cube, "disk": _disk, "sphere": _sphere, "cylinder": _cylinder
}  # fmt: skip


def _value(shape: ET.Element, name: str, missing: float) -> float:
    found = next((one for one in shape if one.get("name") == name), None)  # a float or an integer, or text by mistake
    return missing if found is None else float(found.get("value", missing))


def _point(shape: ET.Element, name: str, missing: tuple[float, float, float]) -> Float[np.ndarray, "3"]:
    points = ("point", "vector")  # tags of positions: common usage, and Mitsuba's own
    found = next((one for one in shape if one.tag in points and one.get("name") == name), None)
    return np.array(missing, np.float64) if found is None else np.array(_vector(found, 0.0))


def _transform(transform: ET.Element | None, name: str, file: Path) -> Float[np.ndarray, "4 4"]:
    """Returns the matrix of a transform; Mitsuba applies its steps in the order in which they are written."""
    result = np.eye(4)
    for step in transform if transform is not None else ():
        match step.tag:
            case "translate":
                matrix = trimesh.transformations.translation_matrix(_vector(step, 0.0))
            case "scale":
                matrix = np.diag([*_vector(step, 1.0), 1.0])
            case "rotate":
                angle = np.radians(float(step.get("angle", 0)))
                matrix = trimesh.transformations.rotation_matrix(angle, _vector(step, 0.0))
            case "matrix":
                matrix = np.array(_numbers(step.get("value", ""))).reshape(4, 4)
            case _:
                raise UserError(f"shape {name!r} of {file} has the transform <{step.tag}>; replace it by a <matrix>")
        result = matrix @ result
    return result


def _vector(step: ET.Element, missing: float) -> list[float]:
    value = _numbers(step.get("value", ""))
    return value * 3 if len(value) == 1 else value or [float(step.get(axis, missing)) for axis in "xyz"]


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.replace(",", " ").split()]


def _material(bsdf: ET.Element, file: Path) -> RadioMaterial | None:
    """Returns the material of a bsdf as Sionna RT interprets it; None if it describes only the appearance."""
    name = (bsdf.get("id") or "").removeprefix("mat-")
    usual = 0.1  # metres: Sionna RT's default
    thickness = _value(bsdf, "thickness", usual)
    if bsdf.get("type") == "itu-radio-material" or name.startswith(("itu_", "itu-")):
        kind = bsdf.find("string[@name='type']")
        return RadioMaterial(name[4:] if kind is None else kind.get("value", name[4:]), thickness)
    if bsdf.get("type") == "radio-material":
        if unknown := [key for one in bsdf if (key := one.get("name")) is not None and key not in RADIO]:
            raise UserError(
                f"material {name!r} of {file} has the unknown property {unknown[0]!r}; it may have {', '.join(RADIO)}"
            )
        properties = _value(bsdf, "relative_permittivity", 1.0), _value(bsdf, "conductivity", 0.0)
        return RadioMaterial(name, thickness, properties)
    return None
