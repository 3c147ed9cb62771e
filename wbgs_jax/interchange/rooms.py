"""Rooms from users' own files: objects with materials, with two-faced walls converted to single sheets."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.scene_file import Room, load_room
from wbgs_jax.interchange.room_materials import Slab, slabs_of
from wbgs_jax.mesh.bodies import share_in_box
from wbgs_jax.mesh.importers import Y_UP, FileObject, read_objects
from wbgs_jax.mesh.units import stated_unit
from wbgs_jax.mesh.walls import divided, hidden_walls, walls_as_sheets

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
