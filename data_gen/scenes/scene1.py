"""Scene 1: a sparsely furnished living room, 10 x 7.5 x 3 m. The origin lies on the floor in the middle of the room.

Plan (x to the right, y up); the receiver R faces +x:

    +y   window      screen      window
      +----====------######------====----+
      |                            shelf||
      |  R               chairs          |
      |                  [table]         | +x
      |      lamp        chairs          |
      |       o      [  sofa  ]  cabinet |
      +--door----------------------------+
"""

from data_gen.scenes.base import Part, SceneSpec, grid_3d, part
from data_gen.scenes.furniture import cabinet, chair, lamp, place, screen, shelf, sofa, table
from data_gen.scenes.walls import box_room

WIDTH, DEPTH, HEIGHT = 10.0, 7.5, 3.0
"""Size of the room along x, y and z in metres."""

RX_POSITION = (-4.2, 0.35, 1.0)
"""0.8 m from the -x wall and off the room's symmetry plane; low, so that most transmitters are above it: the PAS shows only the
upper half of the directions."""

TX_COUNTS = (15, 10, 6)
TX_LOW, TX_HIGH = (-4.6, -3.35, 0.5), (4.6, 3.35, 2.6)
"""Corners of the grid of 900 candidates: 0.4 m from the walls, from seat height to near the ceiling."""

DINING = (2.4, 0.6)
"""Middle of the dining table."""


def scene1() -> SceneSpec:
    """Returns the room, its furniture, the receiver and the candidate transmitters."""
    return SceneSpec(
        name="scene1",
        description="sparsely furnished living room, 10 x 7.5 x 3 m",
        parts=(*_room(), *_furniture()),
        rx_position=RX_POSITION,
        tx_grid=grid_3d(TX_LOW, TX_HIGH, TX_COUNTS),
    )


def _room() -> list[Part]:
    windows = {
        "window_left": ((1.2, 0.9, 3.2, 2.3), "glass"),
        "window_right": ((6.8, 0.9, 8.8, 2.3), "glass"),
    }
    door = {"door": ((0.9, 0.0, 1.8, 2.05), "wood")}
    materials = {
        "floor": "wood", "ceiling": "ceiling_board", "wall_north": "concrete", "wall_south": "plasterboard",
        "wall_west": "plasterboard", "wall_east": "plasterboard",
    }  # fmt: skip
    return box_room((WIDTH, DEPTH, HEIGHT), materials, {"wall_north": windows, "wall_south": door})


def _furniture() -> list[Part]:
    x, y = DINING
    chairs = [(x - 0.45, y - 0.62, 0), (x + 0.45, y - 0.62, 0), (x - 0.45, y + 0.62, 2), (x + 0.45, y + 0.62, 2)]
    return [
        part("table", place(table(1.8, 0.9, 0.75), x, y), "wood", 0.02),
        *(part(f"chair_{i}", place(chair(), *where), "wood", 0.02) for i, where in enumerate(chairs, 1)),
        part("sofa", place(sofa(2.2), 0.3, -3.1), "chipboard"),
        part("shelf", place(shelf(1.6, 0.32, 2.0), 4.82, 2.3, facing=1), "chipboard", 0.015),
        part("cabinet", place(cabinet(1.0, 0.45, 1.9), 4.2, -3.5), "metal"),
        part("screen", place(screen(1.4, 0.8, 0.95), 0.3, 3.7, facing=2), "metal"),
        part("lamp", place(lamp(), -1.6, -3.1), "metal"),
    ]
