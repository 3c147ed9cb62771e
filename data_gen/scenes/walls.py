"""Room surfaces: walls, floors and ceilings with flush doors and windows, and inner walls with open doorways.

A surface is a single sheet whose material has a thickness. The ray tracer diffracts only at the edges of solids, not at the
free edge of a sheet; therefore every free edge ends `REBATE` deep inside a solid: a door frame or an end post.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from data_gen.scenes.base import GAP, JOINT, Part, part
from data_gen.scenes.geometry import Vec3, box, merge

Vec2 = tuple[float, float]
Rectangle = tuple[float, float, float, float]
"""(u low, v low, u high, v high) in the coordinates of a wall, metres."""

FRAME = 0.06
"""Width of a door frame along the wall, metres."""
FRAME_DEPTH = 0.15
"""Depth of a door frame across the wall, centred on the sheet, metres."""
POST = 0.12
"""Width of an end post along the wall, metres; across it, it is as deep as a door frame."""
POST_GAP = 0.02
"""Metres between an end post and the ceiling: enough for a roof that slopes across the wall."""
REBATE = 0.025
"""Depth (metres) by which a sheet extends into the frame or post that hides its edge."""
LEAF = 0.04
"""Thickness of a door leaf in metres."""
STUD_WALL = 0.025
"""Total thickness of plasterboard in an inner wall, metres: two boards of 12.5 mm with air between them."""


def wall(
    name: str, corner: Vec3, along: Vec3, up: Vec3, size: Vec2, material: str,
    openings: Mapping[str, tuple[Rectangle, str | None]] | None = None,
    thickness: float | None = None, rise: float = 0.0, kind: str = "shell",
) -> list[Part]:  # fmt: skip
    """Returns a rectangular surface with flush doors or windows.

    The rectangle is cut along the lines of all openings; a cell belongs to the opening that covers it, otherwise to the wall.
    The parts meet at shared vertices, without a hole and without overlap.

    Args:
        corner, along, up: the point (0, 0) of the surface and its two unit directions.
        size: lengths (metres) along the two directions.
        openings: by name a rectangle in the surface's coordinates and a material; None leaves a hole.
        thickness: of the wall's own material in metres; by default the usual one.
        rise: increase of the upper edge's height per metre along, for a wall below a sloped ceiling.
    """
    openings = openings or {}
    rectangles = [rectangle for rectangle, _ in openings.values()]
    us = np.unique([0.0, size[0], *(r[i] for r in rectangles for i in (0, 2))])
    vs = np.unique([0.0, size[1], *(r[i] for r in rectangles for i in (1, 3))])
    cells: dict[str, list[Rectangle]] = {name: [], **{key: [] for key in openings}}
    for u0, u1 in itertools.pairwise(us):
        for v0, v1 in itertools.pairwise(vs):
            cells[_owner(openings, (u0 + u1) / 2, (v0 + v1) / 2) or name].append((u0, v0, u1, v1))

    def sheet(found: Sequence[Rectangle]) -> trimesh.Trimesh:
        uv = np.array([[(a, b), (c, b), (c, d), (a, d)] for a, b, c, d in found]).reshape(-1, 2)
        uv[:, 1] += np.where(uv[:, 1] == size[1], rise * uv[:, 0], 0.0)
        return _sheet(uv, corner, along, up)

    return [
        part(name, sheet(cells[name]), material, thickness, kind),
        *(part(key, sheet(cells[key]), value, kind=kind) for key, (_, value) in openings.items() if value is not None),
    ]


def box_room(
    size: Vec3, materials: Mapping[str, str], openings: Mapping[str, Mapping[str, tuple[Rectangle, str | None]]] | None = None
) -> list[Part]:
    """Returns floor, ceiling and four walls of a room whose floor is centred on the origin.

    Args:
        size: along x, y and z in metres.
        materials: of "floor", "ceiling", "wall_north" (+y), "wall_south", "wall_west" and "wall_east" (+x).
        openings: doors and windows of these surfaces, as in `wall`.
    """
    width, depth, height = size
    x, y = width / 2, depth / 2
    along_x, along_y, upwards = (1, 0, 0), (0, 1, 0), (0, 0, 1)
    surfaces: dict[str, tuple[Vec3, Vec3, Vec3, Vec2]] = {
        "floor": ((-x, -y, 0), along_x, along_y, (width, depth)),
        "ceiling": ((-x, -y, height), along_x, along_y, (width, depth)),
        "wall_north": ((-x, y, 0), along_x, upwards, (width, height)),
        "wall_south": ((-x, -y, 0), along_x, upwards, (width, height)),
        "wall_west": ((-x, -y, 0), along_y, upwards, (depth, height)),
        "wall_east": ((x, -y, 0), along_y, upwards, (depth, height)),
    }
    openings = openings or {}
    walls = (wall(name, *where, materials[name], openings.get(name)) for name, where in surfaces.items())
    return list(itertools.chain.from_iterable(walls))


def _owner(openings: Mapping[str, tuple[Rectangle, str | None]], u: float, v: float) -> str | None:
    for key, ((u0, v0, u1, v1), _) in openings.items():
        if u0 < u < u1 and v0 < v < v1:
            return key
    return None


def _sheet(uv: np.ndarray, corner: Vec3, along: Vec3, up: Vec3) -> trimesh.Trimesh:
    """Returns quadrilaterals, four rows of `uv` each, as one mesh."""
    vertices = np.asarray(corner) + uv[:, :1] * np.asarray(along) + uv[:, 1:] * np.asarray(up)
    faces = (4 * np.arange(len(uv) // 4)[:, None] + np.array([[[0, 1, 2]], [[0, 2, 3]]])).reshape(-1, 3)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices()
    return mesh


@dataclass(frozen=True)
class Door:
    """An open doorway in an inner wall; sizes are those of the clear opening in metres."""

    at: float
    """Distance of its centre from the start of the wall."""
    leaf: tuple[int, int] | None = None
    """Jamb of the open leaf (-1 for the one nearer to the wall's start, +1 for the other) and side on which it stands (+1 left
    of the wall seen from its start, -1 right); None for a doorway without a leaf."""
    width: float = 0.9
    height: float = 2.05


@dataclass(frozen=True)
class _Line:
    """The base line of an inner wall along +x or +y; u runs along it, v to its left."""

    start: Vec2
    end: Vec2

    @property
    def along(self) -> Vec2:
        step = np.subtract(self.end, self.start)
        if step.min() != 0 or step.max() <= 0:
            raise ValueError(f"an inner wall must run along +x or +y, not from {self.start} to {self.end}")
        return (1.0, 0.0) if step[0] > 0 else (0.0, 1.0)

    @property
    def length(self) -> float:
        return float(np.max(np.subtract(self.end, self.start)))

    def box(self, u: Vec2, v: Vec2, z: Vec2) -> trimesh.Trimesh:
        """Returns a box from ranges along, across and above the line."""
        (ax, ay), (x, y) = self.along, self.start
        xs = sorted(x + ax * a - ay * b for a, b in zip(u, v, strict=True))
        ys = sorted(y + ay * a + ax * b for a, b in zip(u, v, strict=True))
        return box((xs[0], ys[0], z[0]), (xs[1], ys[1], z[1]))


def inner_wall(
    name: str, start: Vec2, end: Vec2, height: float, material: str = "plasterboard", thickness: float | None = None,
    doors: Sequence[Door] = (), free: tuple[bool, bool] = (False, False), rise: float = 0.0,
) -> list[Part]:  # fmt: skip
    """Returns a wall between rooms: the sheet and, in wood, the door frames, the open leaves and the posts at free ends.

    Args:
        start, end: its base line, along +x or +y, in metres; it touches the objects at its ends unless they are free.
        height: at the start, in metres; with a `rise`, it increases along the wall like the ceiling above.
        free: whether the wall ends in the middle of a room, at its start and at its end.
    """
    line = _Line(start, end)
    if material == "plasterboard" and thickness is None:
        thickness = STUD_WALL
    u0, u1 = (POST - REBATE) * free[0], line.length - (POST - REBATE) * free[1]
    (x, y), (ax, ay) = start, line.along
    holes = {f"{name}_door_{i}": (_hole(door, u0), None) for i, door in enumerate(doors, 1)}
    corner, size = (x + ax * u0, y + ay * u0, 0.0), (u1 - u0, height + rise * u0)
    parts = wall(name, corner, (ax, ay, 0), (0, 0, 1), size, material, holes, thickness, rise, "partition")
    top = height + min(0.0, rise * line.length)
    ends = [u for u, is_free in zip((0.0, line.length - POST), free, strict=True) if is_free]
    solids = {
        "frames": [body for door in doors for body in _frame(line, door)],
        "leaves": [_leaf(line, door, *door.leaf) for door in doors if door.leaf],
        "posts": [_upright(line, u, u + POST, top + max(0.0, rise) * u - POST_GAP) for u in ends],
    }
    return parts + [part(f"{name}_{key}", merge(bodies), "wood") for key, bodies in solids.items() if bodies]


def _hole(door: Door, u0: float) -> Rectangle:
    half = door.width / 2 + REBATE
    return (door.at - half - u0, 0.0, door.at + half - u0, door.height + REBATE)


def _upright(line: _Line, u0: float, u1: float, top: float) -> trimesh.Trimesh:
    return line.box((u0, u1), (-FRAME_DEPTH / 2, FRAME_DEPTH / 2), (JOINT, top))


def _frame(line: _Line, door: Door) -> list[trimesh.Trimesh]:
    """Returns two jambs with a head on top."""
    half, depth = door.width / 2, FRAME_DEPTH / 2
    head = (door.height + JOINT, door.height + JOINT + FRAME)
    return [
        _upright(line, door.at - half - FRAME, door.at - half, door.height),
        _upright(line, door.at + half, door.at + half + FRAME, door.height),
        line.box((door.at - half - FRAME, door.at + half + FRAME), (-depth, depth), head),
    ]


def _leaf(line: _Line, door: Door, jamb: int, side: int) -> trimesh.Trimesh:
    """Returns a leaf opened by 90 degrees: it stands perpendicular to the wall in front of its jamb."""
    hinge = door.at + jamb * (door.width / 2 + FRAME / 2)
    near = FRAME_DEPTH / 2 + GAP
    return line.box(
        (hinge - LEAF / 2, hinge + LEAF / 2), (side * near, side * (near + door.width)), (GAP, door.height - GAP)
    )  # fmt: skip
