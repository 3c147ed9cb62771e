"""A scene from a user's own file: its objects, their materials, the receiver and the transmitters (docs/own_scene.md).

All that can be wrong is told here in one line, before hours are spent on tracing.
"""

import dataclasses
import fnmatch
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from data_gen.materials import ITU, THICKNESS, Law, check_material_frequencies, own_material
from data_gen.mesh_checks import is_solid, kind, outward, place, surface_flaws
from data_gen.scenes.base import FREQUENCIES_HZ, RX_CLEARANCE, Part, SceneSpec, grid_3d
from data_gen.scenes.geometry import Vec3, distance, winding_number
from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.room_files import FileObject, read_objects

EXTENT = (0.5, 200.0)
"""Metres: the largest side of a scene is in between, or its unit is not the metre, unless somebody says so, ..."""
SAID_EXTENT = (0.01, 20_000.0)
"""... and then in between these. A scene.xml of Sionna RT says so by itself."""
ROOM = 10.0
"""Metres: the usual size of a room, to guess a unit from."""
MAX_THICKNESS = 2.0
"""Metres: a thicker slab is one given in millimetres."""
MAX_TRIANGLES = 2_000_000
MAX_TX = 1_000_000
MAX_WALL, THIN, FULL = 0.6, 0.25, 0.95
"""Metres: a box that is no thicker, thinner than this share of its height, and as full as this, is a wall."""
SHOWN = 40
"""Objects that are described."""
HELP = "see docs/own_scene.md"


class Slab(NamedTuple):
    """A material by name and its thickness in metres; the name of an own material carries its law (`own_material`)."""

    material: str
    thickness: float


@dataclass(frozen=True)
class OwnScene(SceneSpec):
    """A scene from a file. Its walls need not close a room: being in it means being in the box around everything."""

    flaws: tuple[str, ...] = ()
    """What is wrong with surfaces that are taken as they are."""

    def in_room(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Returns which points are in the box around all objects."""
        low, high = self.bounds()
        return ((points > low) & (points < high)).all(1)

    def check_receiver(self) -> None:
        """Raises a `UserError` when the receiver is outside the scene, inside a solid or too near to a surface."""
        point = np.asarray([self.rx_position], np.float64)
        where = f"the receiver at {place(point[0])} m"
        if not self.in_room(point)[0]:
            raise UserError(f"{where} is outside the scene, which spans {_span(self)}; check --rx, --up and --scale")
        for p in self.solids:
            if abs(winding_number(p.mesh, point)[0]) > 0.5:
                raise UserError(f"{where} is inside the solid {p.name!r}; move it with --rx")
        near, name = min((float(distance(p.mesh, point)[0]), p.name) for p in self.parts)
        if near < RX_CLEARANCE:
            raise UserError(f"{where} is {near:.2g} m from {name!r}; move it with --rx, {RX_CLEARANCE} m from all surfaces")


def own_scene(
    file: Path, materials: Path | None, *, rx: str, tx_grid: str, frequencies_hz: Sequence[float] = (),
    up: str | None = None, scale: float | None = None,
) -> OwnScene:  # fmt: skip
    """Reads and checks a scene file.

    Args:
        file: .glb, .gltf, .obj, .ply or .xml.
        materials: a .toml with the materials of the objects; None only for a .xml that knows them all.
        rx: position of the receiver, "x,y,z".
        tx_grid: candidate transmitters, "x0,y0,z0:x1,y1,z1:nx,ny,nz" or the path of a .csv with the header x,y,z.
        frequencies_hz: hertz; the ten of the released scenes unless given.
        up, scale: vertical axis and unit of the file, as in `read_objects`; without a scale the unit is the metre, and sizes
            that make one doubt it are refused.

    All positions are in metres in the scene's z-up frame, after `up` and `scale`.

    Raises:
        UserError: anything about the file, the materials, the frequencies, the receiver or the transmitters is wrong.
    """
    position, candidates = parse_point(rx, "--rx"), _transmitters(tx_grid)
    frequencies = tuple(frequencies_hz) or FREQUENCIES_HZ
    objects, simulated = read_objects(file, up, 1.0 if scale is None else scale), file.suffix.lower() == ".xml"
    _check_size(file, objects, SAID_EXTENT if simulated or scale is not None else EXTENT)
    slabs = _slabs(file, objects, materials)
    check_material_frequencies([slab.material for slab in slabs], frequencies)
    description = f"{len(objects)} objects of {file.name}"
    spec = OwnScene(file.stem, _parts(objects, slabs), position, candidates, frequencies, description=description)
    spec.check_receiver()
    if not spec.in_room(candidates).any():
        raise UserError(f"no transmitter of --tx-grid is inside the scene, which spans {_span(spec)}; move the grid")
    if not simulated and (flaw := next(surface_flaws(spec.parts), None)):
        raise UserError(flaw)
    return dataclasses.replace(spec, flaws=tuple(surface_flaws(spec.parts))) if simulated else spec


def describe(spec: SceneSpec) -> str:
    """Returns how objects were understood, a line each, of many those with most triangles: name, material, thickness (m), solid
    or sheet, number of triangles; and what is wrong with them."""
    sort = {True: "solid", False: "sheet"}
    largest = sorted(np.argsort([-len(p.mesh.faces) for p in spec.parts], kind="stable")[:SHOWN])
    shown = [spec.parts[i] for i in largest]
    rows = [(p.name, p.material, f"{p.thickness:g} m", sort[p.closed], f"{len(p.mesh.faces)} triangles") for p in shown]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    if len(shown) < len(spec.parts):
        lines.append(f"... and {len(spec.parts) - len(shown)} smaller objects")
    if walls := {p.name: depth for p in spec.parts if p.closed and (depth := _depth(p.mesh)) <= MAX_WALL}:
        deep = next(iter(walls.values()))
        lines.append(
            f"warning: {_list(list(walls), 4)} are closed boxes as thin as walls ({deep:.2g} m): a wave passes two "
            f"faces, and each counts as a slab of its material's thickness; give {deep / 2:.2g} m, or one sheet a wall"
        )
    flaws = spec.flaws if isinstance(spec, OwnScene) else ()
    if flaws:
        lines.append(f"warning: {flaws[0]}" + (f" ({len(flaws) - 1} more of such places)" if len(flaws) > 1 else ""))
    return "\n".join(lines)


def _depth(mesh: trimesh.Trimesh) -> float:
    """Returns how thick a closed box is that is thin against its length and height; infinity for any other body."""
    low, middle, _ = sorted(mesh.extents)
    box = mesh.volume > FULL * np.prod(mesh.extents)
    return float(low) if box and low < THIN * middle else np.inf


def _span(spec: SceneSpec) -> str:
    low, high = spec.bounds()
    return f"{place(low)} to {place(high)} m"


def _check_size(file: Path, objects: Sequence[FileObject], extent: tuple[float, float]) -> None:
    corners = np.concatenate([o.mesh.bounds for o in objects])
    size = np.ptp(corners, axis=0)
    largest = float(size.max())
    if not extent[0] <= largest <= extent[1]:
        factor = min((0.001, 0.01, 10.0, 100.0, 1000.0), key=lambda f: abs(np.log(largest * f / ROOM)))
        sides = " x ".join(f"{side:.4g}" for side in size)
        raise UserError(
            f"{file} measures {sides} m; give the metres in its unit, perhaps --scale {factor:g}, or --scale 1 if that is right"
        )
    total = sum(len(o.mesh.faces) for o in objects)
    if total > MAX_TRIANGLES:
        name = max(objects, key=lambda o: len(o.mesh.faces)).name
        raise UserError(f"{file} has {total} triangles, most in {name!r}; simplify it to {MAX_TRIANGLES} or fewer")


def _parts(objects: Sequence[FileObject], slabs: Sequence[Slab]) -> tuple[Part, ...]:
    corners = np.concatenate([o.mesh.bounds for o in objects])
    bounds = np.stack([corners.min(0), corners.max(0)])
    meshes = [outward(o.mesh) if is_solid(o.mesh, bounds) else o.mesh for o in objects]
    return tuple(
        Part(o.name, mesh, slab.material, slab.thickness, kind(mesh, bounds))
        for o, mesh, slab in zip(objects, meshes, slabs, strict=True)
    )


def _slabs(file: Path, objects: Sequence[FileObject], materials: Path | None) -> list[Slab]:
    """Returns the material of every object: by its name in the .toml, by a pattern there, or what the file itself says."""
    tables = _read_toml(materials) if materials is not None else {}
    own = {name: _own_slab(name, table, f"{materials}") for name, table in tables.get("materials", {}).items()}
    chosen = {pattern: _slab(value, own, f"{materials}: {pattern!r}") for pattern, value in tables.get("objects", {}).items()}
    names = [o.name for o in objects]
    for pattern in chosen:
        if pattern not in names and not fnmatch.filter(names, pattern):
            raise UserError(f"{materials}: {pattern!r} is no object of {file}; there are {_list(names)}")
    found = [_choose(o, chosen, f"{file}: {o.name!r}") for o in objects]
    without = [o.name for o, slab in zip(objects, found, strict=True) if slab is None]
    if without:
        where = f"{materials}" if materials is not None else "a .toml file given with --materials"
        raise UserError(f"no material for {_list(without)} of {file}; name them under [objects] in {where} ({HELP})")
    return [slab for slab in found if slab is not None]


def _list(names: Sequence[str], most: int = 12) -> str:
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
        tables = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror}; give the .toml with the materials") from error
    except ValueError as error:  # TOMLDecodeError, UnicodeDecodeError
        raise UserError(f"{file} is not valid TOML: {error}") from error
    if not set(tables) <= {"objects", "materials"} or not all(isinstance(table, dict) for table in tables.values()):
        raise UserError(f"{file} may hold the tables [objects] and [materials.<name>] and nothing else; {HELP}")
    return tables


def _own_slab(name: str, table: Any, where: str) -> Slab:
    """Returns a user's own material.

    Its relative permittivity and conductivity (S/m) are each a number, or [a, b] for a f^b with f in GHz.
    """
    keys = ("relative_permittivity", "conductivity", "thickness")
    if not isinstance(table, dict) or set(table) != set(keys):
        raise UserError(f"{where}: [materials.{name}] needs {', '.join(keys)} and nothing else; {HELP}")
    laws = [table[key] if isinstance(table[key], list) else [table[key], 0] for key in keys[:2]]
    if not all(len(law) == 2 and all(isinstance(value, int | float) for value in law) for law in laws):
        raise UserError(f"{where}: [materials.{name}] is described by numbers, or [a, b] for a f^b with f in GHz")
    return Slab(own_material(name, Law(*laws[0], *laws[1])), _thickness(table["thickness"], f"{where}: {name!r}"))


def _slab(value: Any, own: dict[str, Slab], where: str) -> Slab:
    """Returns the slab that `"name"` or `{material = "name", thickness = metres}` stands for."""
    table = {"material": value} if isinstance(value, str) else value
    if not isinstance(table, dict) or not isinstance(table.get("material"), str) or not set(table) <= {"material", "thickness"}:
        raise UserError(f'{where} needs "material" or {{material = "...", thickness = metres}}; quote names that have a dot')
    name = table["material"]
    if name not in own and name not in ITU:
        known = ", ".join(sorted({*own, *THICKNESS}))
        raise UserError(f"{where} is of unknown material {name!r}; choose among {known} (more in {HELP.removeprefix('see ')})")
    slab = own.get(name) or Slab(name, ITU[name].thickness)
    return slab._replace(thickness=_thickness(table.get("thickness", slab.thickness), where))


def _thickness(value: Any, where: str) -> float:
    if not isinstance(value, int | float) or not 0 < value <= MAX_THICKNESS:
        raise UserError(f"{where} has a thickness of {value}; give metres, more than 0 and at most {MAX_THICKNESS:g}")
    return float(value)


def parse_point(text: str, option: str) -> Vec3:
    """Returns metres from "x,y,z"; anything else is a `UserError`."""
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        raise UserError(f"{option} has {text!r} where x,y,z in metres is needed, as in 1.2,0.5,1") from None
    if not np.isfinite([x, y, z]).all():
        raise UserError(f"{option} has {text!r}; give finite numbers")
    return x, y, z


def _transmitters(text: str) -> Float[np.ndarray, "candidates 3"]:
    if text.lower().endswith(".csv"):
        return _read_csv(Path(text))
    corners = text.split(":")
    if len(corners) != 3:
        raise UserError(f"--tx-grid is {text!r}; give x0,y0,z0:x1,y1,z1:nx,ny,nz or a .csv file with the header x,y,z")
    low, high, numbers = (parse_point(corner, "--tx-grid") for corner in corners)
    if not all(value >= 1 and value == int(value) for value in numbers) or np.prod(numbers) > MAX_TX:
        raise UserError(f"--tx-grid has {corners[2]!r} for nx,ny,nz; give whole numbers, at most {MAX_TX} points in all")
    nx, ny, nz = (int(value) for value in numbers)
    return grid_3d(low, high, (nx, ny, nz))


def _read_csv(file: Path) -> Float[np.ndarray, "candidates 3"]:
    try:
        header, *lines = file.read_text(encoding="utf-8-sig").split("\n")
        points = np.array([[float(word) for word in line.split(",")] for line in lines if line.strip()])
    except OSError as error:
        raise UserError(f"cannot read --tx-grid {file}: {error.strerror}; check the path") from error
    except ValueError as error:
        raise UserError(f"{file} has a line that is not three numbers ({error}); write x,y,z in metres") from error
    if header.replace(" ", "").strip() != "x,y,z" or points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise UserError(f"{file} needs the header x,y,z and a row of three numbers (metres) for every transmitter")
    if len(np.unique(points, axis=0)) < len(points):
        raise UserError(f"{file} names a transmitter twice, which could be in training and test; remove one")
    return points
