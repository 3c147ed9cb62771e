"""A scene from a user's own file: its objects, their materials, the receiver and the transmitters (docs/own_scene.md).

All errors are reported here, in one line, before hours are spent on tracing.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from data_gen.mesh_checks import is_solid, kind, outward, place, surface_flaws
from data_gen.scenes.base import FREQUENCIES_HZ, RX_CLEARANCE, Part, SceneSpec, grid_3d
from data_gen.scenes.geometry import Vec3, distance, winding_number
from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.rooms import RoomObject, Slab, check_material_frequencies, describe_room, read_room

MAX_TX = 1_000_000


@dataclass(frozen=True)
class OwnScene(SceneSpec):
    """A scene from a file. Its walls need not enclose a room: points are in it if they are in the bounding box of all
    objects."""

    flaws: tuple[str, ...] = ()
    """Flaws of surfaces that are accepted as they are."""
    walls: dict[str, float] = field(default_factory=dict)
    """Depth in metres of the closed boxes that were converted to sheets, by name."""

    def in_room(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Returns which points are in the bounding box of all objects."""
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
        materials: a .toml with the materials of the objects; may be None for a .xml that records all of them.
        rx: position of the receiver, "x,y,z".
        tx_grid: candidate transmitters, "x0,y0,z0:x1,y1,z1:nx,ny,nz" or the path of a .csv with the header x,y,z.
        frequencies_hz: hertz; by default the ten of the released scenes.
        up, scale: vertical axis and unit of the file, as in `read_objects`; without a scale the unit is the metre, and
            implausible sizes are rejected.

    All positions are in metres in the scene's z-up frame, after `up` and `scale`.

    Raises:
        UserError: an error in the file, the materials, the frequencies, the receiver or the transmitters.
    """
    position, candidates = parse_point(rx, "--rx"), parse_transmitters(tx_grid)
    frequencies = tuple(frequencies_hz) or FREQUENCIES_HZ
    objects = read_room(file, materials, up, scale, antennas=np.concatenate([[position], candidates]))
    simulated = file.suffix.lower() == ".xml"
    check_material_frequencies([one.slab.material for one in objects], frequencies)
    description = f"{len(objects)} objects of {file.name}"
    walls = {one.name: one.wall for one in objects if one.wall}
    spec = OwnScene(file.stem, _parts(objects), position, candidates, frequencies, description=description, walls=walls)
    spec.check_receiver()
    if not spec.in_room(candidates).any():
        raise UserError(f"no transmitter of --tx-grid is inside the scene, which spans {_span(spec)}; move the grid")
    if not simulated and (flaw := next(surface_flaws(spec.parts), None)):
        raise UserError(flaw)
    return dataclasses.replace(spec, flaws=tuple(surface_flaws(spec.parts))) if simulated else spec


def describe(spec: SceneSpec) -> str:
    """Returns a description of the objects (`describe_room`) and of their flaws."""
    walls = spec.walls if isinstance(spec, OwnScene) else {}
    objects = [RoomObject(p.name, p.mesh, Slab(p.material, p.thickness), walls.get(p.name, 0.0)) for p in spec.parts]
    lines = [describe_room(objects, ["solid" if p.closed else "sheet" for p in spec.parts])]
    flaws = spec.flaws if isinstance(spec, OwnScene) else ()
    if flaws:
        lines.append(f"warning: {flaws[0]}" + (f" (similar flaws: {len(flaws) - 1})" if len(flaws) > 1 else ""))
    return "\n".join(lines)


def _span(spec: SceneSpec) -> str:
    low, high = spec.bounds()
    return f"{place(low)} to {place(high)} m"


def _parts(objects: Sequence[RoomObject]) -> tuple[Part, ...]:
    corners = np.concatenate([o.mesh.bounds for o in objects])
    bounds = np.stack([corners.min(0), corners.max(0)])
    meshes = [outward(o.mesh) if is_solid(o.mesh, bounds) else o.mesh for o in objects]
    return tuple(
        Part(o.name, mesh, o.slab.material, o.slab.thickness, kind(mesh, bounds))
        for o, mesh in zip(objects, meshes, strict=True)
    )


def parse_point(text: str, option: str) -> Vec3:
    """Returns a point in metres parsed from "x,y,z".

    Raises:
        UserError: the text is not of this form.
    """
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        raise UserError(f"{option} has {text!r} instead of x,y,z in metres, such as 1.2,0.5,1") from None
    if not np.isfinite([x, y, z]).all():
        raise UserError(f"{option} has {text!r}; give finite numbers")
    return x, y, z


def parse_transmitters(text: str) -> Float[np.ndarray, "candidates 3"]:
    """Returns candidate positions of transmitters (metres) from "x0,y0,z0:x1,y1,z1:nx,ny,nz" or the path of a .csv file.

    Raises:
        UserError: the text is not of this form, or the file cannot be read.
    """
    if text.lower().endswith(".csv"):
        return _read_csv(Path(text))
    corners = text.split(":")
    if len(corners) != 3:
        raise UserError(f"--tx-grid is {text!r}; give x0,y0,z0:x1,y1,z1:nx,ny,nz or a .csv file with the header x,y,z")
    low, high, numbers = (parse_point(corner, "--tx-grid") for corner in corners)
    if not all(value >= 1 and value == int(value) for value in numbers) or np.prod(numbers) > MAX_TX:
        raise UserError(f"--tx-grid has {corners[2]!r} for nx,ny,nz; give whole numbers, at most {MAX_TX} points in total")
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
        raise UserError(f"{file} needs the header x,y,z and one row of three numbers (metres) per transmitter")
    if len(np.unique(points, axis=0)) < len(points):
        raise UserError(f"{file} has a transmitter twice, which could be in training and test; remove one")
    return points
