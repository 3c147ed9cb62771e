"""Scene 3: a densely furnished L-shaped flat, 12 x 10 m outline, 2.6 m high. The origin lies on the floor in the middle of the
outline's bounding rectangle.

Plan (x to the right, y up); the receiver R faces +x; gaps are open doors:

           +--window----+-window--+
           | kitchen    | study   |
           | island     |    desk |
           +==    ======+===   ===+----------------+  concrete
           |                   |      wardrobe desk|
    window |      table           h |     child bed| window
           | R                 |  a +--------------|
           |      sofa         |  l   wardrobe     |
           |         divider   |  l |          bed | window
           |  screen      shelf|         bedroom   |
           +-------------------+door+--------------+
"""

from data_gen.scenes.base import Part, SceneSpec, grid_3d, part
from data_gen.scenes.furniture import (
    bed,
    bench,
    cabinet,
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
from data_gen.scenes.walls import Door, inner_wall, wall

WIDTH, DEPTH, HEIGHT = 12.0, 10.0, 2.6
"""Bounding rectangle and height along x, y and z in metres."""
NOTCH = (1.2, 0.83)
"""The re-entrant corner of the L: nothing beyond it in both +x and +y."""

RX_POSITION = (-5.2, -1.9, 1.0)
"""In the living room, facing the bedrooms through the hall."""

TX_COUNTS = (15, 12, 6)
TX_LOW, TX_HIGH = (-5.41, -4.37, 0.6), (5.64, 4.31, 2.45)
"""Corners of a uniform grid over the bounding rectangle, of which 900 candidates are within the L."""


def scene3() -> SceneSpec:
    """Returns the flat, its furniture, the receiver and the candidate transmitters."""
    grid = grid_3d(TX_LOW, TX_HIGH, TX_COUNTS)
    return SceneSpec(
        name="scene3",
        description="densely furnished L-shaped flat, 12 x 10 m outline, 2.6 m high",
        parts=(*_shell(), *_inner_walls(), *_living(), *_kitchen_and_study(), *_hall(), *_bedrooms()),
        rx_position=RX_POSITION,
        tx_grid=grid[(grid[:, 0] < NOTCH[0]) | (grid[:, 1] < NOTCH[1])],
    )


def _shell() -> list[Part]:
    x, y, (a, b) = WIDTH / 2, DEPTH / 2, NOTCH
    notch = {"notch": ((a + x, b + y, WIDTH, DEPTH), None)}
    north = {"window_kitchen": ((0.9, 1.0, 2.3, 2.2), "glass"), "window_study": ((4.6, 0.9, 6.2, 2.2), "glass")}
    south = {"door": ((6.8, 0.0, 7.7, 2.05), "wood")}
    west = {"window_living": ((3.9, 0.9, 5.5, 2.2), "glass")}
    east = {"window_bedroom": ((0.9, 0.9, 2.5, 2.2), "glass"), "window_child": ((4.2, 0.9, 5.4, 2.2), "glass")}
    return [
        *wall("floor", (-x, -y, 0), (1, 0, 0), (0, 1, 0), (WIDTH, DEPTH), "wood", notch),
        *wall("ceiling", (-x, -y, HEIGHT), (1, 0, 0), (0, 1, 0), (WIDTH, DEPTH), "concrete", notch),
        *wall("wall_north", (-x, y, 0), (1, 0, 0), (0, 0, 1), (a + x, HEIGHT), "concrete", north),
        *wall("wall_south", (-x, -y, 0), (1, 0, 0), (0, 0, 1), (WIDTH, HEIGHT), "concrete", south),
        *wall("wall_west", (-x, -y, 0), (0, 1, 0), (0, 0, 1), (DEPTH, HEIGHT), "plasterboard", west),
        *wall("wall_east", (x, -y, 0), (0, 1, 0), (0, 0, 1), (b + y, HEIGHT), "concrete", east),
        *wall("wall_notch_north", (a, b, 0), (1, 0, 0), (0, 0, 1), (x - a, HEIGHT), "concrete"),
        *wall("wall_notch_east", (a, b, 0), (0, 1, 0), (0, 0, 1), (y - b, HEIGHT), "plasterboard"),
    ]


def _inner_walls() -> list[Part]:
    x, y, (a, b) = WIDTH / 2, DEPTH / 2, NOTCH
    leg = [Door(1.7, width=1.3), Door(5.2, leaf=(1, 1))]
    bedrooms = [Door(1.7, leaf=(-1, -1)), Door(4.6, leaf=(-1, -1))]
    return [
        *inner_wall("bearing", (-x, b), (a, b), HEIGHT, "concrete", 0.15, leg),
        *inner_wall("partition_study", (-2.0, b), (-2.0, y), HEIGHT),
        *inner_wall("partition_hall", (0.4, -y), (0.4, b), HEIGHT, doors=[Door(3.8, leaf=(1, -1))]),
        *inner_wall("partition_bedrooms", (2.0, -y), (2.0, b), HEIGHT, doors=bedrooms),
        *inner_wall("partition_child", (2.0, -1.67), (x, -1.67), HEIGHT),
    ]


def _living() -> list[Part]:
    return [
        part("sofa", place(sofa(2.2), -3.4, -2.75, facing=2), "chipboard"),
        part("coffee_table", place(table(1.1, 0.6, 0.42), -3.4, -3.8), "wood", 0.02),
        part("sideboard", place(cabinet(1.8, 0.4, 0.5), -3.4, -4.75), "wood"),
        part("screen", place(screen(1.3, 0.75, 0.55, thickness=0.04), -3.4, -4.8), "metal"),
        part("armchair", place(sofa(0.9, 0.85), -5.2, -3.9, facing=3), "chipboard"),
        part("divider", place(shelf(1.5, 0.32, 1.9), -1.2, -3.9, facing=1), "chipboard", 0.015),
        part("bookshelf", place(shelf(1.8, 0.32, 2.0), 0.2, -3.5, facing=1), "chipboard", 0.015),
        part("table", place(table(1.7, 0.9, 0.75), -2.5, -0.45), "wood", 0.02),
        part("bench_1", place(bench(1.5), -2.5, -1.12), "wood", 0.02),
        part("bench_2", place(bench(1.5), -2.5, 0.22), "wood", 0.02),
        part("lamp", place(lamp(), -0.28, -4.7), "metal"),
    ]


def _kitchen_and_study() -> list[Part]:
    return [
        part("counter", place(counter(2.6), -4.1, 4.68, facing=2), "chipboard"),
        part("wall_cupboard", place(wall_cupboard(1.0), -3.3, 4.8, facing=2), "chipboard"),
        part("fridge", place(cabinet(0.6, 0.62, 1.85), -2.4, 4.66), "metal"),
        part("larder", place(cabinet(1.2, 0.42, 2.0), -5.77, 2.2, facing=3), "chipboard"),
        part("island", place(counter(1.4, 0.7), -3.9, 2.7), "wood"),
        part("desk", place(desk(1.6), 0.83, 3.4, facing=1), "wood", 0.02),
        part("desk_chair", place(office_chair(), 0.15, 3.4, facing=3), "wood", 0.02),
        part("monitor", place(monitor(0.74), 0.98, 3.4, facing=1), "metal"),
        part("study_shelf", place(shelf(1.6, 0.32, 2.0), -1.8, 3.6, facing=3), "chipboard", 0.015),
        part("filing_cabinet", place(cabinet(0.8, 0.42, 1.3), 0.75, 4.75), "metal"),
    ]


def _hall() -> list[Part]:
    return [
        part("hall_wardrobe", place(wardrobe(1.2, 0.38, 2.0), 1.72, -1.95, facing=1), "chipboard"),
        part("shoe_cabinet", place(cabinet(0.9, 0.32, 0.85), 0.65, -3.6, facing=3), "wood"),
    ]


def _bedrooms() -> list[Part]:
    return [
        part("bed", place(bed(1.6), 4.94, -3.5, facing=1), "wood"),
        part("nightstand_1", place(cabinet(0.4, 0.38, 0.48), 5.77, -4.55, facing=1), "wood"),
        part("nightstand_2", place(cabinet(0.4, 0.38, 0.48), 5.77, -2.45, facing=1), "wood"),
        part("wardrobe", place(wardrobe(1.8), 3.5, -2.06, facing=2), "chipboard"),
        part("dresser", place(cabinet(1.2, 0.45, 0.82), 2.9, -4.74), "wood"),
        part("child_bed", place(bed(0.9), 4.94, -1.15, facing=1), "wood"),
        part("child_desk", place(desk(1.2, 0.6), 4.8, 0.48, facing=2), "wood", 0.02),
        part("child_chair", place(office_chair(), 4.8, -0.2), "wood", 0.02),
        part("child_wardrobe", place(wardrobe(1.2, 0.5), 3.0, 0.54, facing=2), "chipboard"),
    ]
