"""Scene 6: a sparsely furnished bedroom with a chimney breast, 7 x 5.5 x 2.6 m. The origin lies on the floor in the middle.

Plan (x to the right, y up); the receiver R faces +x:

    +y     [ bed ]      window   wardrobe
      +----------------===========-------+
      |                                  |
      |  R                               |  window
      |                            desk  |
      |                                  |
      | lamp        [chimney]            |
      +--shelf--------------------door---+
"""

from data_gen.scenes.base import GAP, Part, SceneSpec, grid_3d, part
from data_gen.scenes.furniture import bed, cabinet, desk, lamp, monitor, office_chair, place, shelf, wardrobe
from data_gen.scenes.geometry import box
from data_gen.scenes.walls import box_room

WIDTH, DEPTH, HEIGHT = 7.0, 5.5, 2.6
"""Size of the room along x, y and z in metres."""

RX_POSITION = (-2.75, 0.3, 1.0)

TX_COUNTS = (15, 12, 5)
TX_LOW, TX_HIGH = (-3.34, -2.46, 0.6), (3.11, 2.46, 2.4)
"""Corners of the grid of 900 candidates."""


def scene6() -> SceneSpec:
    """Returns the room, its furniture, the receiver and the candidate transmitters."""
    return SceneSpec(
        name="scene6",
        description="sparsely furnished bedroom with a chimney breast, 7 x 5.5 x 2.6 m",
        parts=(*_shell(), *_furniture()),
        rx_position=RX_POSITION,
        tx_grid=grid_3d(TX_LOW, TX_HIGH, TX_COUNTS),
    )


def _shell() -> list[Part]:
    north = {"window_north": ((2.9, 0.9, 4.6, 2.2), "glass")}
    east = {"window_east": ((1.2, 0.9, 3.2, 2.2), "glass")}
    south = {"door": ((5.6, 0.0, 6.5, 2.05), "wood")}
    materials = {
        "floor": "wood", "ceiling": "concrete", "wall_north": "plasterboard", "wall_south": "plasterboard",
        "wall_west": "plasterboard", "wall_east": "concrete",
    }  # fmt: skip
    return box_room((WIDTH, DEPTH, HEIGHT), materials, {"wall_north": north, "wall_south": south, "wall_east": east})


def _furniture() -> list[Part]:
    wall_y = -DEPTH / 2
    chimney = box((0.0, wall_y + GAP, GAP), (1.3, wall_y + 0.45, HEIGHT - GAP))
    return [
        part("chimney", chimney, "concrete"),
        part("bed", place(bed(1.4), -1.4, 1.73, facing=2), "wood"),
        part("nightstand", place(cabinet(0.45, 0.4, 0.48), -0.4, 2.5), "wood"),
        part("wardrobe", place(wardrobe(1.5), 2.65, 2.44, facing=2), "chipboard"),
        part("desk", place(desk(1.4), 3.1, -0.4, facing=1), "wood", 0.02),
        part("desk_chair", place(office_chair(), 2.4, -0.4, facing=3), "wood", 0.02),
        part("monitor", place(monitor(0.74), 3.25, -0.4, facing=1), "metal"),
        part("shelf", place(shelf(1.2, 0.3, 1.8), -1.5, -2.57), "chipboard", 0.015),
        part("lamp", place(lamp(), -3.1, -2.3), "metal"),
    ]
