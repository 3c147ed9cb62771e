"""Rooms from users' own files: objects with materials, with two-faced walls converted to single sheets.

Materials are assigned by name or pattern in a .toml file, or as recorded in the room's own file. Building materials are those
of ITU-R P.2040 that Sionna RT supports, each with the band in which it is defined and its usual thickness, and custom materials
(`own_material`). Sionna reports only in the middle of a run that a material is not defined at a frequency (such as brick at
40 GHz); the checks here do so beforehand.
"""

import fnmatch
import math
import re
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.scene_file import Room, load_room
from wbgs_jax.data.tables import stated_unit
from wbgs_jax.mesh.bodies import share_in_box
from wbgs_jax.mesh.importers import Y_UP, FileObject, read_objects
from wbgs_jax.mesh.walls import divided, hidden_walls, walls_as_sheets

VALID_HZ = (1e9, 100e9)
"""Lowest and highest frequency (hertz, both included) of a scene, and of every material in `THICKNESS`."""


class Material(NamedTuple):
    """Usual thickness and band of a material of ITU-R P.2040; its electrical constants are the simulator's."""

    thickness: float
    """Usual thickness of a slab, metres."""
    low_ghz: float
    high_ghz: float
    """Ends of the band (GHz), both included. Bands above 100 GHz, where there are no scenes, are not listed."""


ITU = {
    "concrete": Material(0.20, 1, 100),
    "brick": Material(0.11, 1, 40),
    "plasterboard": Material(0.10, 1, 100),
    "wood": Material(0.03, 0.001, 100),
    "glass": Material(0.008, 0.1, 100),
    "clear_acrylic": Material(0.005, 110, 330),
    "ceiling_board": Material(0.02, 1, 100),
    "chipboard": Material(0.02, 1, 100),
    "plywood": Material(0.018, 1, 40),
    "marble": Material(0.02, 1, 59.999),  # in the simulator's single precision, 60 GHz lies just outside the band
    "floorboard": Material(0.02, 50, 100),
    "vinyl_tile": Material(0.003, 1, 40),
    "carpet_tile": Material(0.006, 1, 40),
    "asphalt_concrete": Material(0.10, 1, 40),
    "metal": Material(0.002, 1, 100),
    "very_dry_ground": Material(0.50, 1, 10),
    "medium_dry_ground": Material(0.50, 1, 10),
    "wet_ground": Material(0.50, 1, 10),
}
"""Materials by name, except vacuum."""

THICKNESS = {
    name: material.thickness
    for name, material in ITU.items()
    if material.low_ghz * 1e9 <= VALID_HZ[0] and material.high_ghz * 1e9 >= VALID_HZ[1]
}
"""Default slab thickness (metres) of the materials defined over all of `VALID_HZ`, which are those of the released scenes."""


class Law(NamedTuple):
    """Frequency dependence as in ITU-R P.2040: relative permittivity a f^b and conductivity c f^d (S/m), with f in GHz."""

    a: float
    b: float
    c: float
    d: float


_NUMBER = r"[-+\d.e]+"
_OWN = re.compile(rf"[\w-]+\(({_NUMBER}), ({_NUMBER}), ({_NUMBER}), ({_NUMBER})\)")


def own_material(name: str, law: Law) -> str:
    """Returns the name of a custom material with its law in it, as in `clay(3.9, 0, 0.024, 0.16)`.

    Raises:
        UserError: the name is taken or has invalid characters, or the law is not that of a passive medium from 1 to 100 GHz.
    """
    if name in ITU or not re.fullmatch(r"[\w-]+", name):
        raise UserError(f"material {name!r} needs another name: letters, digits, _ and -, and not one of ITU-R P.2040")
    gentle = math.isfinite(law.a) and math.isfinite(law.c) and max(abs(law.b), abs(law.d)) <= 10.0
    if not gentle or law.c < 0 or min(law.a * ghz**law.b for ghz in (1.0, 100.0)) < 1:
        raise UserError(f"material {name!r} needs a relative permittivity of 1 or more and a conductivity of 0 S/m or more")
    return f"{name}({', '.join(f'{value:.9g}' for value in law)})"


def own_law(material: str) -> Law | None:
    """Returns the law in the name of a custom material; None for one of ITU-R P.2040, whose law the simulator has."""
    found = _OWN.fullmatch(material)
    return Law(*map(float, found.groups())) if found else None


def check_material(name: str) -> str:
    """Returns `name`.

    Raises:
        UserError: it is not defined over all of `VALID_HZ`; the message lists the materials that are.
    """
    if name not in THICKNESS:
        raise UserError(f"unknown material {name!r}; choose one of {', '.join(sorted(THICKNESS))}")
    return name


def check_frequency(frequency_hz: float) -> float:
    """Returns `frequency_hz`.

    Raises:
        UserError: materials are not defined there.
    """
    low, high = VALID_HZ
    if not low <= frequency_hz <= high:
        band = f"{low / 1e9:g}-{high / 1e9:g} GHz"
        raise UserError(f"{frequency_hz / 1e9:g} GHz is outside {band}, where the materials are defined; choose another")
    return frequency_hz


def check_material_frequencies(materials: Iterable[str], frequencies_hz: Iterable[float]) -> None:
    """Raises a `UserError` if a material (one of `ITU` or a custom one) is not defined at one of the frequencies."""
    frequencies = [check_frequency(frequency) for frequency in frequencies_hz]
    for name in sorted(name for name in set(materials) if own_law(name) is None):
        _, low, high = ITU[name]
        missing = [f"{frequency / 1e9:g}" for frequency in frequencies if not low <= frequency / 1e9 <= high]
        if missing:
            others = ", ".join(sorted(THICKNESS))
            raise UserError(
                f"{name} is defined for {low:g}-{high:g} GHz, not at {', '.join(missing)} GHz; leave these frequencies out, "
                f"choose a material that is defined everywhere ({others}), or define your own"
            )


HELP = "see docs/own_scene.md"


class Slab(NamedTuple):
    """Name of a material and thickness in metres; the name of a custom material contains its law (`own_material`)."""

    material: str
    thickness: float
    given: bool = False
    """Whether the thickness was specified for the object itself rather than for its material."""


def slabs_of(file: Path, objects: Sequence[FileObject], materials: Path | None) -> list[Slab]:
    """Returns the slab of every object.

    Args:
        file: file of the objects, for messages.
        objects: of a room (`read_objects`).
        materials: the .toml file (docs/own_scene.md); may be None if the room's own file records all materials.

    Raises:
        UserError: the .toml file cannot be read or is invalid, it names an object that does not exist, or an object has no
            material.
    """
    tables = _read_toml(materials) if materials is not None else {}
    own = {name: _own_slab(name, table, f"{materials}") for name, table in tables.get("materials", {}).items()}
    chosen = {pattern: _slab(value, own, f"{materials}: {pattern!r}") for pattern, value in tables.get("objects", {}).items()}
    names = [o.name for o in objects]
    for pattern in chosen:
        if pattern not in names and not fnmatch.filter(names, pattern):
            raise UserError(f"{materials}: {pattern!r} is not an object of {file}; its objects are {listed(names)}")
    found = [_choose(o, chosen, f"{file}: {o.name!r}") for o in objects]
    without = [o.name for o, slab in zip(objects, found, strict=True) if slab is None]
    if without:
        where = f"{materials}" if materials is not None else "a .toml file given with --materials"
        raise UserError(f"no material for {listed(without)} of {file}; name them under [objects] in {where} ({HELP})")
    return [slab for slab in found if slab is not None]


def listed(names: Sequence[str], most: int = 12) -> str:
    """Returns names as text, at most the first `most` of them."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(repr(name) for name in names[:most]) + more


def _choose(found: FileObject, chosen: dict[str, Slab], where: str) -> Slab | None:
    if found.name in chosen:
        return chosen[found.name]
    for pattern, slab in chosen.items():
        if fnmatch.fnmatchcase(found.name, pattern):
            return slab
    if found.material is None:
        return None
    name, thickness, properties = found.material
    if properties is not None:
        permittivity, conductivity = properties
        return Slab(own_material(name, Law(permittivity, 0.0, conductivity, 0.0)), _thickness(thickness, where))
    return _slab({"material": name, "thickness": thickness}, {}, where)


def _read_toml(file: Path) -> dict[str, dict[str, Any]]:
    try:
        tables = tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror}; give the .toml with the materials") from error
    except ValueError as error:  # TOMLDecodeError, UnicodeDecodeError
        raise UserError(f"{file} is not valid TOML: {error}") from error
    if not set(tables) <= {"objects", "materials"} or not all(isinstance(table, dict) for table in tables.values()):
        raise UserError(f"{file} may contain only the tables [objects] and [materials.<name>]; {HELP}")
    return tables


def _own_slab(name: str, table: Any, where: str) -> Slab:
    """Returns a custom material.

    Its relative permittivity and conductivity (S/m) are each a number, or [a, b] for a f^b with f in GHz.
    """
    keys = ("relative_permittivity", "conductivity", "thickness")
    if not isinstance(table, dict) or set(table) != set(keys):
        raise UserError(f"{where}: [materials.{name}] needs exactly {', '.join(keys)}; {HELP}")
    laws = [table[key] if isinstance(table[key], list) else [table[key], 0] for key in keys[:2]]
    if not all(len(law) == 2 and all(isinstance(value, int | float) for value in law) for law in laws):
        raise UserError(f"{where}: [materials.{name}] needs numbers, or [a, b] for a f^b with f in GHz")
    return Slab(own_material(name, Law(*laws[0], *laws[1])), _thickness(table["thickness"], f"{where}: {name!r}"))


def _slab(value: Any, own: dict[str, Slab], where: str) -> Slab:
    """Returns the slab described by `"name"` or `{material = "name", thickness = metres}`."""
    table = {"material": value} if isinstance(value, str) else value
    if not isinstance(table, dict) or not isinstance(table.get("material"), str) or not set(table) <= {"material", "thickness"}:
        raise UserError(f'{where} needs "material" or {{material = "...", thickness = metres}}; quote names with a dot')
    name = table["material"]
    if name not in own and name not in ITU:
        choices = ", ".join(sorted({*own, *THICKNESS}))
        raise UserError(
            f"{where} has the unknown material {name!r}; choose one of {choices} (more in {HELP.removeprefix('see ')})"
        )
    slab = own.get(name) or Slab(name, ITU[name].thickness)
    return Slab(slab.material, _thickness(table.get("thickness", slab.thickness), where), "thickness" in table)


def _thickness(value: Any, where: str) -> float:
    max_thickness = 2.0  # metres: a larger thickness was probably given in millimetres
    if not isinstance(value, int | float) or not 0 < value <= max_thickness:
        raise UserError(f"{where} has a thickness of {value}; give metres, more than 0 and at most {max_thickness:g}")
    return float(value)


MAX_TRIANGLES = 2_000_000
SHOWN = 40
"""Maximum number of objects that are listed."""


@dataclass(frozen=True)
class RoomObject:
    """An object of a room: metres, z up."""

    name: str
    mesh: trimesh.Trimesh
    slab: Slab
    wall: float = 0.0
    """Distance between the two faces of the closed box that a sheet replaces, metres; 0 for all other objects."""


def read_room(
    file: Path,
    materials: Path | None = None,
    up: str | None = None,
    scale: float | None = None,
    named: bool = True,
    antennas: Float[np.ndarray, "n 3"] | None = None,
) -> list[RoomObject]:
    """Returns the objects of a room in order of their names.

    Closed boxes that are walls become sheets with the box's thickness, unless the materials give another one for the object.
    Shapes of a scene.xml are unchanged, because the simulator that wrote it counts every face.

    Args:
        file: .glb, .gltf, .obj, .ply or .xml.
        materials: a .toml file (docs/own_scene.md).
        up: "y" or "z", the axis of the file that points up, if not the usual one.
        scale: metres per unit of the file; by default the unit is the metre, and implausible sizes are rejected.
        named: whether all objects must have a material; otherwise, without `materials`, each has a material of its own, of
            unknown thickness.
        antennas: positions of transmitters and receivers, metres, in the scene's z-up frame: of a wall's two faces the one
            towards the nearest of them is kept, without them the one towards the middle of the scene.

    Raises:
        UserError: the file or the materials cannot be read, the file states another unit than the metre, the room lies on its
            side, or the size is not that of a room.
    """
    objects, simulated = read_objects(file, up, 1.0 if scale is None else scale), file.suffix.lower() == ".xml"
    if scale is None:
        _check_unit(file)
    if up is None and not simulated:
        _check_floors(file, objects)
    # Range of the largest side, metres: outside it the unit is probably not the metre. It is wider if the scale is given; a
    # scene.xml of Sionna RT is always in metres.
    _check_size(file, objects, (0.01, 20_000.0) if simulated or scale is not None else (0.5, 200.0))
    if named or materials is not None or simulated:
        slabs = slabs_of(file, objects, materials)
    else:
        slabs = [Slab(one.name, 0.0) for one in objects]  # of unknown thickness
    found = [RoomObject(one.name, one.mesh, slab) for one, slab in zip(objects, slabs, strict=True)]
    if simulated:
        return found
    found = [replace(one, mesh=mesh) for one in found for mesh in divided(one.mesh)]
    meshes, walls = walls_as_sheets([one.mesh for one in found], antennas)
    return [_as_wall(one, mesh, wall) for one, mesh, wall in zip(found, meshes, walls, strict=True)]


def room_of(objects: Sequence[RoomObject]) -> Room:
    """Returns the room file representation of objects."""
    starts = np.cumsum([0, *(len(one.mesh.vertices) for one in objects)])
    faces = [np.asarray(one.mesh.faces) + start for one, start in zip(objects, starts, strict=False)]
    return Room(
        vertices=np.concatenate([one.mesh.vertices for one in objects]).astype(np.float32),
        faces=np.concatenate(faces).astype(np.int32),
        face_part=np.repeat(np.arange(len(objects), dtype=np.int32), [len(own) for own in faces]),
        parts=[{"name": one.name, "material": one.slab.material, "thickness": one.slab.thickness} for one in objects],
    )


def open_room(path: Path, up: str | None = None) -> Room:
    """Returns the room of a room file or a scene file (.npz), or of a model in metres with unknown materials, whose axis `up`
    points up if it is not the usual one."""
    if path.suffix.lower() != ".npz":
        return room_of(read_room(path, up=up, named=False))
    if up is not None:
        raise UserError(f"--up has no effect on the room file {path}; convert its model again, with --up")
    return load_room(path)


def check_upright(path: Path, room: Room, antennas: Float[np.ndarray, "n 3"]) -> None:
    """Raises a `UserError` if most antennas (metres) are outside of the box around a room, but inside if the room is turned so
    that the other axis, y or z, points up."""

    few, many = 0.6, 0.9  # shares of antennas inside
    here, turn = share_in_box(antennas, room.vertices), Y_UP[:3, :3]
    if here < few and (turned := max(share_in_box(antennas, room.vertices @ one) for one in (turn, turn.T))) > many:
        advice = "convert its model again with" if path.suffix.lower() == ".npz" else "give"
        raise UserError(
            f"{path} lies on its side: {here:.0%} of the antennas are inside of its box, but {turned:.0%} once it is upright; "
            f"{advice} --up y or --up z, the axis of the model that points up"
        )


def describe_room(objects: Sequence[RoomObject], sorts: Sequence[str]) -> str:
    """Returns a description of objects, one line each, of at most those with the most triangles: name, material, thickness,
    sort, number of triangles; it also reports which walls were converted from closed boxes.

    Args:
        objects: of the room.
        sorts: sort of each object, such as a body or a sheet.
    """
    largest = sorted(np.argsort([-len(one.mesh.faces) for one in objects], kind="stable")[:SHOWN])
    rows = [_row(objects[i], sorts[i]) for i in largest]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    if len(rows) < len(objects):
        lines.append(f"... and {len(objects) - len(rows)} smaller objects")
    for one in objects:
        if depth := hidden_walls(one.mesh):
            lines.append(
                f"warning: {one.name} has walls about {depth:.2g} m thick with two faces, and both attenuate waves: divide it "
                "into straight walls, or keep only its inner face"
            )
    total = sum(len(one.mesh.faces) for one in objects)
    # Number of triangles from which finding paths takes long; furniture in such detail does not change the paths.
    many_triangles = 20_000
    if total > many_triangles:
        lines.append(
            f"warning: {total} triangles: simplify furniture and scans to some thousands before training (Blender: Decimate; "
            "MeshLab: Quadric Edge Collapse)"
        )
    return "\n".join(lines)


def _row(one: RoomObject, sort: str) -> tuple[str, ...]:
    sort = f"sheet from a closed box {one.wall:.2g} m deep" if one.wall else sort
    thickness = f"{one.slab.thickness:g} m" if one.slab.thickness else "unknown thickness"
    return one.name, one.slab.material, thickness, sort, f"{len(one.mesh.faces)} triangles"


def _as_wall(one: RoomObject, mesh: trimesh.Trimesh, wall: float) -> RoomObject:
    slab = one.slab._replace(thickness=round(wall, 6)) if wall and not one.slab.given else one.slab
    return replace(one, mesh=mesh, slab=slab, wall=wall)


def _check_unit(file: Path) -> None:
    """Raises a `UserError` for a file whose comments state another unit than the metre."""
    stated = stated_unit(file) if file.suffix.lower() in (".obj", ".ply") else None
    if stated is not None and stated[1] != 1:
        raise UserError(
            f"{file} states that its unit is {stated[0]!r}; read it with --scale {stated[1]:g}, or with --scale 1 if its "
            "numbers are metres"
        )


LEVEL = re.compile(r"(?<![a-z])(ifcslab|slab|floor|ground|ceiling|fu(ss|ß)boden|boden|decke|plafond)", re.IGNORECASE)
UPRIGHT = re.compile(r"wall|wand|mur|facade|door|window|stair|column|mirror", re.IGNORECASE)
"""Patterns of names of level surfaces, and of upright ones, whose names may contain those of storeys (`ground floor wall`)."""


def _check_floors(file: Path, objects: Sequence[FileObject]) -> None:
    """Raises a `UserError` for a room that is higher than deep, and whose largest floor or ceiling is an upright surface along
    most of it: it lies on its side."""
    bounds = np.array([one.mesh.bounds for one in objects])
    size = bounds[:, 1].max(0) - bounds[:, 0].min(0)
    named = [one for one in objects if LEVEL.search(one.name) and not UPRIGHT.search(one.name)]
    if not named or size[1] >= size[2]:
        return
    floor = max(named, key=lambda one: float(one.mesh.area))
    flat, along = 0.1, 0.5  # largest depth relative to the other sides, and smallest sides relative to the room
    x, depth, z = floor.mesh.extents
    if depth < flat * min(x, z) and x > along * size[0] and z > along * size[2]:
        usual, other = ("y", "z") if file.suffix.lower() in (".glb", ".gltf") else ("z", "y")
        raise UserError(
            f"{file} lies on its side: {floor.name!r} is upright; give --up {other}, the axis of the file that points up, or "
            f"--up {usual} if this is right"
        )


def _check_size(file: Path, objects: Sequence[FileObject], extent: tuple[float, float]) -> None:
    corners = np.concatenate([o.mesh.bounds for o in objects])
    size = np.ptp(corners, axis=0)
    largest = float(size.max())
    usual = 10.0  # metres: typical size of a room, used to guess a unit
    if not extent[0] <= largest <= extent[1]:
        factor = min((0.001, 0.01, 10.0, 100.0, 1000.0), key=lambda f: abs(np.log(largest * f / usual)))
        sides = " x ".join(f"{side:.4g}" for side in size)
        raise UserError(
            f"{file} measures {sides} m; give its unit in metres, perhaps --scale {factor:g}, or --scale 1 if this is right"
        )
    total = sum(len(o.mesh.faces) for o in objects)
    if total > MAX_TRIANGLES:
        name = max(objects, key=lambda o: len(o.mesh.faces)).name
        raise UserError(
            f"{file} has {total} triangles, most in {name!r}; simplify it to {MAX_TRIANGLES} or fewer (Blender: Decimate; "
            "MeshLab: Quadric Edge Collapse)"
        )
