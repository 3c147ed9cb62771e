"""Scene 4: a densely furnished office floor along a corridor, 18 x 6 x 2.8 m. The origin lies on the floor in the middle.

Plan (x to the right, y up); the receiver R faces +x down the corridor; gaps are open doors:

    +-sofa-+-lockers-+-desk--window--+---window-------+--window--+-counter-+
    |      |         H office        |     meeting    | office   | kitchen |
    |         desk   H          desk |      table     |          |         |
    |                +===   =========+=====   ========+===   ====+==    ===|
    |  R                              corridor                             | window
    +------door-------copier----------lockers----------cabinet-------------+
"""

from data_gen.scenes.base import Part, SceneSpec, grid_3d, part
from data_gen.scenes.furniture import (
    cabinet,
    chair,
    counter,
    desk,
    lamp,
    monitor,
    office_chair,
    place,
    screen,
    shelf,
    sofa,
    table,
    wall_cupboard,
    wardrobe,
)
from data_gen.scenes.walls import Door, box_room, inner_wall

WIDTH, DEPTH, HEIGHT = 18.0, 6.0, 2.8
"""Outline and height along x, y and z in metres."""

RX_POSITION = (-8.2, -1.9, 1.0)
"""In the reception, in line with the corridor."""

TX_COUNTS = (25, 6, 6)
TX_LOW, TX_HIGH = (-8.69, -2.25, 0.6), (8.63, 2.18, 2.65)
"""Corners of the grid of 900 candidates; its planes keep clear of the inner walls and of table tops."""

CORRIDOR_Y = -1.15
"""Position of the wall between the corridor and the rooms."""


def scene4() -> SceneSpec:
    """Returns the floor, its furniture, the receiver and the candidate transmitters."""
    return SceneSpec(
        name="scene4",
        description="densely furnished office floor along a corridor, 18 x 6 x 2.8 m",
        parts=(*_shell(), *_inner_walls(), *_reception(), *_corridor(), *_offices(), *_meeting(), *_kitchen()),
        rx_position=RX_POSITION,
        tx_grid=grid_3d(TX_LOW, TX_HIGH, TX_COUNTS),
    )


def _shell() -> list[Part]:
    north = {
        "window_office": ((4.9, 0.9, 7.4, 2.3), "glass"),
        "window_meeting": ((8.5, 0.9, 11.6, 2.3), "glass"),
        "window_office_2": ((12.7, 0.9, 14.6, 2.3), "glass"),
    }
    south = {"door": ((2.6, 0.0, 3.6, 2.1), "glass")}
    east = {"window_corridor": ((0.3, 0.9, 1.5, 2.3), "glass")}
    materials = {
        "floor": "concrete", "ceiling": "ceiling_board", "wall_north": "concrete", "wall_south": "concrete",
        "wall_west": "plasterboard", "wall_east": "plasterboard",
    }  # fmt: skip
    return box_room((WIDTH, DEPTH, HEIGHT), materials, {"wall_north": north, "wall_south": south, "wall_east": east})


def _inner_walls() -> list[Part]:
    x, y = WIDTH / 2, DEPTH / 2
    doors = [Door(1.78, leaf=(-1, 1)), Door(5.2, leaf=(1, 1)), Door(9.0, leaf=(1, 1)), Door(12.2, width=1.2)]
    return [
        # The post at the corridor's corner contains the edges of both walls that meet there.
        *inner_wall("corridor", (-4.68, CORRIDOR_Y), (x, CORRIDOR_Y), HEIGHT, doors=doors, free=(True, False)),
        *inner_wall("bearing", (-4.62, CORRIDOR_Y + 0.05), (-4.62, y), HEIGHT, "concrete", 0.15),
        *inner_wall("partition_meeting", (-1.08, CORRIDOR_Y), (-1.08, y), HEIGHT),
        *inner_wall("partition_office", (3.24, CORRIDOR_Y), (3.24, y), HEIGHT),
        *inner_wall("partition_kitchen", (6.12, CORRIDOR_Y), (6.12, y), HEIGHT),
        *inner_wall("partition_lounge", (-6.84, 1.2), (-6.84, y), HEIGHT, free=(True, False)),
    ]


def _reception() -> list[Part]:
    return [
        part("sofa", place(sofa(1.8), -7.95, 2.5, facing=2), "chipboard"),
        part("armchair", place(sofa(0.9, 0.85), -8.5, 0.9, facing=3), "chipboard"),
        part("lamp", place(lamp(), -8.6, 1.75), "metal"),
        part("desk", place(desk(1.8, 0.8), -6.0, 0.4, facing=3), "wood", 0.02),
        part("desk_chair", place(office_chair(), -5.3, 0.4, facing=1), "wood", 0.02),
        part("monitor", place(monitor(0.74), -6.2, 0.3, facing=3), "metal"),
        part("lockers", place(cabinet(1.5, 0.45, 1.9), -5.8, 2.74), "metal"),
        part("shelf", place(shelf(1.4, 0.32, 2.0, boards=4), -4.86, 1.75, facing=1), "chipboard", 0.015),
    ]


def _corridor() -> list[Part]:
    return [
        part("copier", place(cabinet(0.7, 0.6, 1.1), -3.6, -2.68), "metal"),
        part("corridor_cabinet", place(cabinet(1.8, 0.4, 2.0), -0.6, -2.78), "chipboard"),
        part("corridor_lockers", place(cabinet(1.5, 0.4, 1.85), 3.0, -2.78), "metal"),
        part("sideboard", place(cabinet(1.4, 0.4, 0.85), 6.4, -2.78), "wood"),
    ]


def _offices() -> list[Part]:
    places = [(-3.55, 2.6, 2), (-1.45, 0.9, 1), (4.9, 2.6, 2)]
    return [
        *(piece for i, where in enumerate(places, 1) for piece in _work_place(i, *where)),
        part("office_shelf", place(shelf(1.4, 0.34, 2.0, boards=4), -4.36, 0.9, facing=3), "chipboard", 0.015),
        part("filing_cabinet", place(cabinet(0.9, 0.45, 1.3), 3.54, 1.9, facing=3), "metal"),
        part("cupboard", place(wardrobe(1.2, 0.45, 2.0), 3.54, 0.3, facing=3), "chipboard"),
    ]


def _work_place(number: int, x: float, y: float, facing: int) -> list[Part]:
    """Returns a desk with a display and, in front of it, a chair facing it."""
    ahead = {1: (-1, 0), 2: (0, -1)}[facing]
    chair_at = (x + 0.68 * ahead[0], y + 0.68 * ahead[1])
    display_at = (x - 0.15 * ahead[0], y - 0.15 * ahead[1])
    return [
        part(f"desk_{number}", place(desk(1.5), x, y, facing), "wood", 0.02),
        part(f"desk_chair_{number}", place(office_chair(), *chair_at, facing=facing + 2), "wood", 0.02),
        part(f"monitor_{number}", place(monitor(0.74), *display_at, facing=facing), "metal"),
    ]


def _meeting() -> list[Part]:
    x, y = 1.0, 1.1
    chairs = [(x - 0.6, y - 0.72, 0), (x + 0.6, y - 0.72, 0), (x - 0.6, y + 0.72, 2), (x + 0.6, y + 0.72, 2)]
    return [
        part("meeting_table", place(table(2.4, 1.1, 0.75), x, y), "wood", 0.02),
        *(part(f"chair_{i}", place(chair(height=0.84), *where), "wood", 0.02) for i, where in enumerate(chairs, 1)),
        part("screen", place(screen(1.6, 0.9, 0.9), 3.13, y, facing=1), "metal"),
        part("credenza", place(cabinet(1.6, 0.45, 0.8), 0.2, 2.74), "wood"),
    ]


def _kitchen() -> list[Part]:
    return [
        part("fridge", place(cabinet(0.6, 0.62, 1.85), 6.5, 2.66), "metal"),
        part("counter", place(counter(2.1), 7.9, 2.68, facing=2), "chipboard"),
        part("wall_cupboard", place(wall_cupboard(2.1), 7.9, 2.8, facing=2), "chipboard"),
        part("island", place(counter(1.4, 0.7), 7.7, 0.7), "wood"),
    ]
