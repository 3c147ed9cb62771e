"""The cabin: the solver's geometry (solid blocks) and a mesh as a user would model it, from one description.

World frame: z up, metres, the origin on the floor in the middle of the room. All sizes are multiples of `UNIT`, so that cells
of 10, 15 and 30 mm have nodes on every surface, at every transmitter and at every element. Plan (x to the right, y up); R is
the array:

    +----------------------------------+   y = 0.75
    | shelf   cabinet       cupboard   |
    |                                  |
    |                   |              |
    |  R                | half wall    |
    |                   |              |
    |                   |      table   |
    |        chest      |              |
    +----------------------------------+   y = -0.75
   x = -0.90                         0.90

Mesh and blocks differ where the conventions for meshes require it (docs/own_scene.md, section 1): outer walls are represented
by their inner faces, hollow furniture by its outer faces, and objects that touch in the cabin are `GAP` or `JOINT` apart in the
mesh. The half wall is a closed body: its faces reflect waves, and its edges are wedges; a sheet through its middle would have
neither.
"""

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from data_gen.scenes.base import GAP, JOINT, Part, SceneSpec, part
from data_gen.scenes.geometry import Vec3, box, distance, merge
from data_gen.scenes.walls import wall
from wbgs_jax.radio.array import planar_array

UNIT = 0.03
"""Metres: all sizes and positions are multiples of it."""
SIZE: Vec3 = (1.80, 1.50, 1.44)
"""Inner size of the cabin, metres."""
GABLE, WALL, FLOOR, CEILING = 0.09, 0.06, 0.06, 0.06
"""Thickness in metres of the walls across x and across y (gypsum blocks), of the floor and of the ceiling."""
PANEL = 0.03
"""Thickness in metres of the panels of hollow furniture."""
SPACING = 0.12
"""Metres between elements: half a wavelength at 1.25 GHz."""
RX_POSITION: Vec3 = (-0.66, 0.0, 0.6)
FREQUENCIES_HZ = (1.0e9, 1.1e9, 1.2e9, 1.3e9, 1.4e9, 1.5e9)
TX_LOW, TX_HIGH, TX_COUNTS = (-0.72, -0.63, 0.15), (0.72, 0.63, 1.23), (9, 8, 7)
TX_CLEARANCE, ARRAY_CLEARANCE = 0.10, 0.30
"""Minimum distance in metres of a transmitter from a surface, and from an element."""
AIR, METAL = "air", "metal"


class Block(NamedTuple):
    """A solid axis-aligned box of one material, for the solver; later blocks replace earlier ones where they overlap."""

    low: Vec3
    high: Vec3
    material: str


@dataclass(frozen=True)
class Body:
    """A piece of furniture, or the inner wall: boxes that touch, solid or hollow."""

    name: str
    material: str
    boxes: tuple[tuple[Vec3, Vec3], ...]
    thickness: float
    """Thickness of the slab represented by a face of the mesh, metres: that of a panel, or half that of a solid board with two
    faces."""
    hollow: bool = False

    def blocks(self) -> list[Block]:
        """Returns the blocks of the body: its boxes, and the air inside hollow ones."""
        found = [Block(low, high, self.material) for low, high in self.boxes]
        if self.hollow:
            found += [Block(_moved(low, PANEL), _moved(high, -PANEL), AIR) for low, high in self.boxes]
        return found

    def part(self) -> Part:
        """Returns the body as a closed mesh, `GAP` away from floor, walls and ceiling where it touches them, its boxes `JOINT`
        apart."""
        (low, high), *others = self.boxes
        below = [(a, (b[0], b[1], b[2] - JOINT)) for a, b in others]  # a table's legs
        boxes = [box(*_off_the_shell(*corners)) for corners in [(low, high), *below]]
        return part(self.name, merge(boxes), self.material, self.thickness)


BODIES = (
    Body("half_wall", "plasterboard", (((0.15, -0.75, 0.0), (0.21, 0.12, 1.44)),), 0.03),
    Body("cabinet", METAL, (((-0.30, 0.42, 0.0), (0.0, 0.72, 0.9)),), 0.002),
    Body("cupboard", "chipboard", (((0.48, 0.42, 0.0), (0.84, 0.72, 0.99)),), PANEL, hollow=True),
    Body("table", "wood", (
        ((0.36, -0.69, 0.54), (0.84, -0.21, 0.60)),
        ((0.39, -0.63, 0.0), (0.45, -0.27, 0.54)),
        ((0.75, -0.63, 0.0), (0.81, -0.27, 0.54)),
    ), 0.03),
    Body("shelf", "wood", (((-0.84, 0.51, 1.08), (-0.36, 0.72, 1.14)),), 0.03),
    Body("chest", "wood", (((-0.42, -0.69, 0.0), (-0.09, -0.39, 0.33)),), PANEL, hollow=True),
)  # fmt: skip


def shell_blocks() -> list[Block]:
    """Returns the outer walls, the floor and the ceiling; walls stand beside floor and ceiling, and corners are filled."""
    x, y, top = SIZE[0] / 2, SIZE[1] / 2, SIZE[2]
    a, b = x + GABLE, y + WALL
    low, high = -FLOOR, top + CEILING
    return [
        Block((-a, -b, low), (-x, b, high), "plasterboard"), Block((x, -b, low), (a, b, high), "plasterboard"),
        Block((-x, -b, low), (x, -y, high), "plasterboard"), Block((-x, y, low), (x, b, high), "plasterboard"),
        Block((-x, -y, low), (x, y, 0.0), "chipboard"), Block((-x, -y, top), (x, y, high), "plasterboard"),
    ]  # fmt: skip


def cabin_blocks() -> list[Block]:
    """Returns all blocks of the cabin."""
    return [*shell_blocks(), *itertools.chain.from_iterable(body.blocks() for body in BODIES)]


def cabin_bounds() -> tuple[Vec3, Vec3]:
    """Returns the lowest and highest corner of the walls' outer faces."""
    x, y = SIZE[0] / 2 + GABLE, SIZE[1] / 2 + WALL
    return (-x, -y, -FLOOR), (x, y, SIZE[2] + CEILING)


def element_positions() -> Float[np.ndarray, "16 3"]:
    """Returns the array in its local frame, metres, in the project's element order."""
    return planar_array(spacing=SPACING)


def cabin_spec() -> SceneSpec:
    """Returns the cabin in the form of the project's scenes: the mesh, the receiver and the transmitters."""
    parts = (*_shell_parts(), *(body.part() for body in BODIES))
    empty = SceneSpec("cabin", parts, RX_POSITION, np.zeros((0, 3)), FREQUENCIES_HZ)
    return SceneSpec(
        name="cabin", description=f"furnished cabin, {SIZE[0]} x {SIZE[1]} x {SIZE[2]} m, full wave", parts=parts,
        rx_position=RX_POSITION, tx_grid=_transmitters(empty), frequencies_hz=FREQUENCIES_HZ,
    )  # fmt: skip


def candidates() -> Float[np.ndarray, "n 3"]:
    """Returns the uniform grid of transmitter candidates, on multiples of `UNIT`, x slowest."""
    axes = [np.linspace(a, b, n) for a, b, n in zip(TX_LOW, TX_HIGH, TX_COUNTS, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return np.round(np.round(grid / UNIT) * UNIT, 6)


def _transmitters(spec: SceneSpec) -> Float[np.ndarray, "tx 3"]:
    """Returns the candidates in free air: outside all bodies, and clear of every surface and element."""
    grid = candidates()
    elements = element_positions() + np.asarray(RX_POSITION)
    from_array = np.linalg.norm(grid[:, None] - elements, axis=-1).min(1)
    keep = ~spec.inside_objects(grid) & (distance(spec.mesh(), grid) >= TX_CLEARANCE) & (from_array >= ARRAY_CLEARANCE)
    return grid[keep]


def _shell_parts() -> list[Part]:
    """Returns the inner faces of floor, ceiling and walls as single surfaces that meet at the corners."""
    x, y, top = SIZE[0] / 2, SIZE[1] / 2, SIZE[2]
    east, north, up = (1, 0, 0), (0, 1, 0), (0, 0, 1)
    return [
        *wall("floor", (-x, -y, 0), east, north, (2 * x, 2 * y), "chipboard", thickness=FLOOR),
        *wall("ceiling", (-x, -y, top), east, north, (2 * x, 2 * y), "plasterboard", thickness=CEILING),
        *wall("wall_south", (-x, -y, 0), east, up, (2 * x, top), "plasterboard", thickness=WALL),
        *wall("wall_north", (-x, y, 0), east, up, (2 * x, top), "plasterboard", thickness=WALL),
        *wall("wall_west", (-x, -y, 0), north, up, (2 * y, top), "plasterboard", thickness=GABLE),
        *wall("wall_east", (x, -y, 0), north, up, (2 * y, top), "plasterboard", thickness=GABLE),
    ]


def _moved(corner: Vec3, by: float) -> Vec3:
    x, y, z = (round(value + by, 6) for value in corner)
    return x, y, z


def _off_the_shell(low: Vec3, high: Vec3) -> tuple[Vec3, Vec3]:
    """Returns a box with those faces that would lie in the floor, a wall or the ceiling moved `GAP` away from it."""
    room_low, room_high = (-SIZE[0] / 2 + GAP, -SIZE[1] / 2 + GAP, GAP), (SIZE[0] / 2 - GAP, SIZE[1] / 2 - GAP, SIZE[2] - GAP)
    x0, y0, z0 = np.maximum(low, room_low).tolist()
    x1, y1, z1 = np.minimum(high, room_high).tolist()
    return (x0, y0, z0), (x1, y1, z1)
