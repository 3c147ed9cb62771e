"""Scene 5: a densely furnished loft flat under a sloped roof, 10.5 x 8 m, 2.2 to 3.6 m high. The origin lies on the floor
in the middle.

Plan (x to the right, y up; the roof rises along +y); the receiver R faces +x; gaps are open doors:

    +--------------+--door--+-wardrobe-shelf-+
    | study  desk             guest room desk|
    |              |        |                |
    +--------------+        |     bed        |
    |  screen      pillar   +----------------+
    | R                        bedroom       |
    |                table  |           bed  |
    |    sofa   kitchen     |   wardrobe     |
    +-----------------------+----------------+
"""

import numpy as np

from data_gen.scenes.base import GAP, Part, SceneSpec, grid_3d, part
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
    wardrobe,
)
from data_gen.scenes.geometry import box
from data_gen.scenes.walls import Door, inner_wall, wall

WIDTH, DEPTH = 10.5, 8.0
"""Outline along x and y in metres."""
LOW, HIGH = 2.2, 3.6
"""Height of the roof in metres at the wall on the -y side and on the +y side."""
RISE = (HIGH - LOW) / DEPTH

RX_POSITION = (-4.45, -0.7, 1.0)
"""In the living room, facing the wall of the bedrooms past the pillar."""

TX_COUNTS = (15, 10, 8)
TX_LOW, TX_HIGH = (-4.81, -3.68, 0.6), (4.84, 3.33, 3.25)
TX_BELOW_ROOF = 0.2
"""Candidates are a uniform grid, cut this far (metres) below the roof."""


def roof(y: float) -> float:
    """Returns the height of the ceiling in metres."""
    return LOW + RISE * (y + DEPTH / 2)


def scene5() -> SceneSpec:
    """Returns the flat, its furniture, the receiver and the candidate transmitters."""
    grid = grid_3d(TX_LOW, TX_HIGH, TX_COUNTS)
    return SceneSpec(
        name="scene5",
        description="densely furnished loft flat under a sloped roof, 10.5 x 8 m, 2.2 to 3.6 m high",
        parts=(*_shell(), *_inner_walls(), *_living(), *_kitchen(), *_study_and_hall(), *_bedroom(), *_guest_room()),
        rx_position=RX_POSITION,
        tx_grid=grid[grid[:, 2] < LOW + RISE * (grid[:, 1] + DEPTH / 2) - TX_BELOW_ROOF],
    )


def _shell() -> list[Part]:
    x, y = WIDTH / 2, DEPTH / 2
    length = float(np.hypot(DEPTH, HIGH - LOW))
    up = (0.0, DEPTH / length, (HIGH - LOW) / length)
    skylights = {"skylight_living": ((1.6, 2.0, 2.8, 3.4), "glass"), "skylight_bedroom": ((7.4, 1.6, 8.6, 3.0), "glass")}
    north = {
        "window_study": ((1.0, 0.9, 2.5, 2.3), "glass"),
        "door": ((4.5, 0.0, 5.4, 2.05), "wood"),
        "window_guest": ((8.4, 0.9, 9.8, 2.3), "glass"),
    }
    west = {"window_living": ((1.6, 0.8, 3.6, 2.0), "glass")}
    east = {"window_guest_2": ((5.6, 0.9, 7.2, 2.2), "glass")}
    return [
        *wall("floor", (-x, -y, 0), (1, 0, 0), (0, 1, 0), (WIDTH, DEPTH), "wood"),
        *wall("roof", (-x, -y, LOW), (1, 0, 0), up, (WIDTH, length), "plasterboard", skylights),
        *wall("wall_north", (-x, y, 0), (1, 0, 0), (0, 0, 1), (WIDTH, HIGH), "concrete", north),
        *wall("wall_south", (-x, -y, 0), (1, 0, 0), (0, 0, 1), (WIDTH, LOW), "concrete"),
        *wall("wall_west", (-x, -y, 0), (0, 1, 0), (0, 0, 1), (DEPTH, LOW), "concrete", west, rise=RISE),
        *wall("wall_east", (x, -y, 0), (0, 1, 0), (0, 0, 1), (DEPTH, LOW), "plasterboard", east, rise=RISE),
    ]


def _inner_walls() -> list[Part]:
    x, y = WIDTH / 2, DEPTH / 2
    doors = [Door(3.25, leaf=(1, -1)), Door(6.4, leaf=(-1, -1))]
    return [
        *inner_wall("bearing", (0.35, -y), (0.35, y), LOW, "concrete", 0.15, doors, rise=RISE),
        *inner_wall("partition_guest", (0.35, 0.0), (x, 0.0), roof(0.0)),
        # The post at the study's corner contains the edges of both walls that meet there.
        *inner_wall("partition_living", (-x, 1.6), (-1.69, 1.6), roof(1.6), free=(False, True)),
        *inner_wall("partition_study", (-1.75, 1.65), (-1.75, y), roof(1.65), doors=[Door(1.4, leaf=(1, 1))], rise=RISE),
    ]


def _living() -> list[Part]:
    px, py, half = -1.9, 0.25, 0.2
    pillar = box((px - half, py - half, GAP), (px + half, py + half, roof(py - half) - GAP))
    x, y = -0.95, -1.75
    chairs = [(x - 0.4, y - 0.62, 0), (x + 0.4, y - 0.62, 0), (x - 0.4, y + 0.62, 2), (x + 0.4, y + 0.62, 2)]
    return [
        part("pillar", pillar, "concrete"),
        part("sofa", place(sofa(2.0), -3.5, -3.5), "chipboard"),
        part("coffee_table", place(table(1.0, 0.6, 0.42), -3.5, -2.3), "wood", 0.02),
        part("sideboard", place(cabinet(1.6, 0.42, 0.5), -3.6, 1.28), "wood"),
        part("screen", place(screen(1.3, 0.75, 0.7), -3.6, 1.5, facing=2), "metal"),
        part("lamp", place(lamp(), -4.9, 1.1), "metal"),
        part("bookshelf", place(shelf(1.0, 0.34, 2.0), 0.08, 0.36, facing=1), "chipboard", 0.015),
        part("table", place(table(1.6, 0.9, 0.75), x, y), "wood", 0.02),
        *(part(f"chair_{i}", place(chair(height=0.84), *where), "wood", 0.02) for i, where in enumerate(chairs, 1)),
    ]


def _kitchen() -> list[Part]:
    return [
        part("counter", place(counter(1.9), -1.4, -3.68), "chipboard"),
        part("fridge", place(cabinet(0.6, 0.62, 1.75), -0.1, -3.66), "metal"),
    ]


def _study_and_hall() -> list[Part]:
    return [
        part("desk", place(desk(1.4), -3.5, 3.63, facing=2), "wood", 0.02),
        part("desk_chair", place(office_chair(), -3.5, 2.95), "wood", 0.02),
        part("monitor", place(monitor(0.74), -3.5, 3.75, facing=2), "metal"),
        part("study_shelf", place(shelf(1.4, 0.32, 2.0), -5.07, 2.8, facing=3), "chipboard", 0.015),
        part("filing_cabinet", place(cabinet(0.9, 0.42, 1.3), -3.0, 1.9), "metal"),
        part("hall_wardrobe", place(wardrobe(0.8, 0.5), -1.2, 3.73, facing=2), "chipboard"),
    ]


def _bedroom() -> list[Part]:
    return [
        part("bed", place(bed(1.6), 4.2, -1.6, facing=1), "wood"),
        part("nightstand_1", place(cabinet(0.45, 0.4, 0.48), 5.02, -2.65, facing=1), "wood"),
        part("nightstand_2", place(cabinet(0.45, 0.4, 0.48), 5.02, -0.5, facing=1), "wood"),
        part("wardrobe", place(wardrobe(2.0), 2.7, -3.68), "chipboard"),
        part("dresser", place(cabinet(1.2, 0.45, 0.82), 2.6, -0.31), "wood"),
    ]


def _guest_room() -> list[Part]:
    return [
        part("guest_bed", place(bed(0.9), 3.5, 0.57, facing=1), "wood"),
        part("guest_desk", place(desk(1.4), 4.87, 2.4, facing=1), "wood", 0.02),
        part("guest_chair", place(office_chair(), 4.19, 2.4, facing=3), "wood", 0.02),
        part("guest_wardrobe", place(wardrobe(1.4), 1.7, 3.68, facing=2), "chipboard"),
        part("guest_shelf", place(shelf(0.7, 0.3, 1.6, boards=4), 2.79, 3.84, facing=2), "chipboard", 0.015),
    ]
