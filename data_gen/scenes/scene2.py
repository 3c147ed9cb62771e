"""Scene 2: a densely furnished two-bedroom flat, 11 x 8.5 x 2.7 m. The origin lies on the floor in the middle of the outline.

Plan (x to the right, y up); the receiver R faces +x; gaps are open doors:

    +---window---+--door----+--window------+
    | study      |  hall    |  child's     |
    | desk shelf             room    bed   |
    +============+===   ====+==============+  concrete
    |  screen                |  bedroom    |
    | R         dining                     |
    |                        |        bed  |
    |    sofa   shelf kitchen|  wardrobe   |
    +---window---------------+-------------+
"""

from data_gen.scenes.base import Part, SceneSpec, grid_3d, part
from data_gen.scenes.furniture import (
    bed,
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

WIDTH, DEPTH, HEIGHT = 11.0, 8.5, 2.7
"""Outline and height along x, y and z in metres."""

RX_POSITION = (-4.7, -1.6, 1.0)
"""In the living room, facing the dining table and the wall of the bedroom behind it."""

TX_COUNTS = (15, 10, 6)
TX_LOW, TX_HIGH = (-4.92, -3.53, 0.6), (4.97, 3.67, 2.35)
"""Corners of the grid of 900 candidates; its planes keep clear of the inner walls and of table tops."""

BEARING_Y = 0.85
"""Position of the load-bearing wall."""


def scene2() -> SceneSpec:
    """Returns the flat, its furniture, the receiver and the candidate transmitters."""
    return SceneSpec(
        name="scene2",
        description="densely furnished two-bedroom flat, 11 x 8.5 x 2.7 m",
        parts=(*_shell(), *_inner_walls(), *_living(), *_kitchen(), *_hall_and_study(), *_bedrooms()),
        rx_position=RX_POSITION,
        tx_grid=grid_3d(TX_LOW, TX_HIGH, TX_COUNTS),
    )


def _shell() -> list[Part]:
    north = {
        "window_study": ((0.8, 0.9, 2.4, 2.2), "glass"),
        "door": ((4.7, 0.0, 5.6, 2.05), "wood"),
        "window_child": ((7.8, 0.9, 9.4, 2.2), "glass"),
    }
    south = {"window_living": ((1.9, 0.9, 3.9, 2.2), "glass")}
    east = {"window_bedroom": ((1.9, 0.9, 3.5, 2.2), "glass")}
    materials = {
        "floor": "wood", "ceiling": "concrete", "wall_north": "concrete", "wall_south": "concrete",
        "wall_west": "plasterboard", "wall_east": "plasterboard",
    }  # fmt: skip
    return box_room((WIDTH, DEPTH, HEIGHT), materials, {"wall_north": north, "wall_south": south, "wall_east": east})


def _inner_walls() -> list[Part]:
    x, y = WIDTH / 2, DEPTH / 2
    hall, bedroom = [Door(5.1, leaf=(1, 1))], [Door(3.8, leaf=(-1, -1))]
    study, child = [Door(1.05, leaf=(-1, 1))], [Door(2.2, leaf=(1, -1))]
    return [
        *inner_wall("bearing", (-x, BEARING_Y), (x, BEARING_Y), HEIGHT, "concrete", 0.15, hall),
        *inner_wall("partition_bedroom", (1.83, -y), (1.83, BEARING_Y), HEIGHT, doors=bedroom),
        *inner_wall("partition_study", (-1.83, BEARING_Y), (-1.83, y), HEIGHT, doors=study),
        *inner_wall("partition_child", (1.1, BEARING_Y), (1.1, y), HEIGHT, doors=child),
    ]


def _living() -> list[Part]:
    x, y = -0.2, -0.7
    chairs = [(x - 0.4, y - 0.62, 0), (x + 0.4, y - 0.62, 0), (x - 0.4, y + 0.62, 2), (x + 0.4, y + 0.62, 2)]
    return [
        part("sofa", place(sofa(2.2), -2.6, -3.75), "chipboard"),
        part("armchair", place(sofa(0.9, 0.85), -4.9, -3.6, facing=3), "chipboard"),
        part("coffee_table", place(table(1.1, 0.6, 0.42), -2.6, -2.5), "wood", 0.02),
        part("sideboard", place(cabinet(1.6, 0.42, 0.55), -2.6, 0.55), "wood"),
        part("screen", place(screen(1.3, 0.75, 0.75), -2.6, 0.75, facing=2), "metal"),
        part("lamp", place(lamp(), -5.1, 0.4), "metal"),
        part("divider", place(shelf(1.5, 0.35, 1.9, boards=5), -0.95, -3.45, facing=3), "chipboard", 0.015),
        part("table", place(table(1.6, 0.9, 0.75), x, y), "wood", 0.02),
        *(part(f"chair_{i}", place(chair(height=0.84), *where), "wood", 0.02) for i, where in enumerate(chairs, 1)),
    ]


def _kitchen() -> list[Part]:
    return [
        part("counter", place(counter(1.85), 0.25, -3.93), "chipboard"),
        part("wall_cupboard", place(wall_cupboard(1.85), 0.25, -4.06), "chipboard"),
        part("fridge", place(cabinet(0.6, 0.62, 1.85), 1.49, -3.92), "metal"),
    ]


def _hall_and_study() -> list[Part]:
    return [
        part("hall_wardrobe", place(wardrobe(1.2, 0.42, 2.0), 0.85, 1.75, facing=1), "chipboard"),
        part("shoe_cabinet", place(cabinet(0.9, 0.35, 0.85), -1.55, 3.7, facing=3), "wood"),
        part("desk", place(desk(1.5), -4.0, 3.87, facing=2), "wood", 0.02),
        part("desk_chair", place(office_chair(), -4.0, 3.15), "wood", 0.02),
        part("monitor", place(monitor(0.74), -4.0, 3.98, facing=2), "metal"),
        part("bookshelf", place(shelf(1.6, 0.32, 2.0), -5.3, 2.1, facing=3), "chipboard", 0.015),
        part("filing_cabinet", place(cabinet(0.8, 0.42, 1.3), -3.6, 1.16), "metal"),
    ]


def _bedrooms() -> list[Part]:
    return [
        part("bed", place(bed(1.6), 4.44, -1.6, facing=1), "wood"),
        part("nightstand_1", place(cabinet(0.45, 0.4, 0.48), 5.25, -2.65, facing=1), "wood"),
        part("nightstand_2", place(cabinet(0.45, 0.4, 0.48), 5.25, -0.55, facing=1), "wood"),
        part("wardrobe", place(wardrobe(2.0), 3.6, -3.92), "chipboard"),
        part("dresser", place(cabinet(1.2, 0.45, 0.82), 3.9, 0.54), "wood"),
        part("child_bed", place(bed(0.9), 5.0, 3.2, facing=2), "wood"),
        part("child_wardrobe", place(wardrobe(1.3), 4.7, 1.25), "chipboard"),
        part("child_desk", place(desk(1.2, 0.65), 2.9, 3.88, facing=2), "wood", 0.02),
        part("child_chair", place(office_chair(), 2.9, 3.2), "wood", 0.02),
        part("child_shelf", place(shelf(1.0, 0.3, 1.8, boards=4), 2.5, 1.1), "chipboard", 0.015),
    ]
