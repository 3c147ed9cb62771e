"""Writes room.obj, the example of docs/own_scene.md: a room of 6 x 4.5 x 2.7 m with a window, a door, a table and a cabinet.

    python -m data_gen.example.make_room

The origin lies on the floor in a corner, x along the long wall, z up, metres. Walls are single sheets, cut where the window
and the door are; furniture is made of closed boxes that stand 1 cm off the floor.
"""

import itertools
from pathlib import Path

HERE = Path(__file__).parent
X, Y, Z = 6.0, 4.5, 2.7
WINDOW = (2.0, 0.9, 4.0, 2.2)
"""Left, bottom, right and top in the wall at y = Y."""
DOOR = (4.4, 0.0, 5.3, 2.05)
"""The same in the wall at y = 0."""
GAP, JOINT = 0.01, 0.002
"""Metres between furniture and the floor, and between the boxes of one piece."""

Corners = list[tuple[float, ...]]


def panel(axis: int, at: float, low: tuple[float, float], high: tuple[float, float]) -> Corners:
    """Returns the corners of a rectangle across an axis (0, 1 or 2 for x, y or z), in order around it."""
    (a, b), (c, d) = low, high
    return [(*uv[:axis], at, *uv[axis:]) for uv in ((a, b), (c, b), (c, d), (a, d))]


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> list[Corners]:
    """Returns the six faces of a box; those on the low side are reversed, so that all normals point outward."""
    faces = []
    for axis, (i, j) in enumerate(((1, 2), (0, 2), (0, 1))):
        for at, outward in ((low[axis], axis == 1), (high[axis], axis != 1)):
            face = panel(axis, at, (low[i], low[j]), (high[i], high[j]))
            faces.append(face if outward else face[::-1])
    return faces


def wall_with_hole(at: float, hole: tuple[float, float, float, float]) -> list[Corners]:
    """Returns a wall across y, cut into panels left, right, above and below a hole."""
    left, bottom, right, top = hole
    pieces = [((0, 0), (left, Z)), ((right, 0), (X, Z)), ((left, top), (right, Z)), ((left, 0), (right, bottom))]
    return [panel(1, at, low, high) for low, high in pieces if low[1] < high[1]]


def table(x: float, y: float, length: float = 1.6, depth: float = 0.8, height: float = 0.75) -> list[Corners]:
    """Returns a board on four legs, centred on (x, y)."""
    half, under = (length / 2, depth / 2), height - 0.04
    faces = box((x - half[0], y - half[1], under), (x + half[0], y + half[1], height))
    for dx, dy in itertools.product((-1, 1), repeat=2):
        leg = (x + dx * (half[0] - 0.08), y + dy * (half[1] - 0.08))
        faces += box((leg[0] - 0.03, leg[1] - 0.03, GAP), (leg[0] + 0.03, leg[1] + 0.03, under - JOINT))
    return faces


OBJECTS: dict[str, list[Corners]] = {
    "floor": [panel(2, 0, (0, 0), (X, Y))],
    "ceiling": [panel(2, Z, (0, 0), (X, Y))],
    "wall_west": [panel(0, 0, (0, 0), (Y, Z))],
    "wall_east": [panel(0, X, (0, 0), (Y, Z))],
    "wall_south": wall_with_hole(0, DOOR),
    "wall_north": wall_with_hole(Y, WINDOW),
    "door": [panel(1, 0, DOOR[:2], DOOR[2:])],
    "window": [panel(1, Y, WINDOW[:2], WINDOW[2:])],
    "table": table(3.4, 2.0),
    "cabinet": box((5.4, 3.2, GAP), (5.9, 4.3, 1.9)),
}


def obj(objects: dict[str, list[Corners]]) -> str:
    """Returns the text of an OBJ file: for every object its name, corners and rectangles, which count corners from 1."""
    lines, first = ["# python -m data_gen.example.make_room"], 1
    for name, faces in objects.items():
        lines.append(f"o {name}")
        lines += (f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in itertools.chain.from_iterable(faces))
        lines += (f"f {' '.join(map(str, range(i, i + 4)))}" for i in range(first, first + 4 * len(faces), 4))
        first += 4 * len(faces)
    return "\n".join(lines) + "\n"


def main(folder: Path = HERE) -> None:
    """Writes the file."""
    (folder / "room.obj").write_text(obj(OBJECTS))


if __name__ == "__main__":
    main()
