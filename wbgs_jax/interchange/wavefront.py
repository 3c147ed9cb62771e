"""Objects of OBJ files (Wavefront, appendix B of the Advanced Visualizer's manual): polygons alone.

Corners count from 1, or backwards from the newest one if they are negative. Objects begin with `o`; where there is none, groups
(`g`) are objects. Text in any encoding: names of one file only have to differ.
"""

import re
from pathlib import Path

import numpy as np

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.polygons import triangulate
from wbgs_jax.interchange.bodies import Body

CURVED = {"curv", "curv2", "surf", "bzp", "bsp", "cdc", "cdp"}
"""Statements of curves and curved surfaces."""
WIDE = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}


def read_obj(file: Path) -> list[Body]:
    """Returns the objects of a file; a curved surface, or a face of corners that are none, is a `UserError`."""
    statements = [words for line in _text(file.read_bytes()).splitlines() if (words := line.split("#", 1)[0].split())]
    begins = "o" if any(words[0] == "o" for words in statements) else "g"
    vertices: list[list[float]] = []
    faces: dict[str, tuple[list[int], list[int]]] = {}
    name = file.stem
    for number, words in enumerate(statements, 1):
        match words[0]:
            case "v":
                vertices.append([float(word) for word in words[1:4]])
            case "f":
                corners = [_corner(word, len(vertices), file) for word in words[1:]]
                own, sizes = faces.setdefault(name, ([], []))
                own += corners
                sizes.append(len(corners))
            case kind if kind == begins:
                name = " ".join(words[1:]) or f"object_{number}"
            case kind if kind in CURVED:
                raise UserError(f"object {name!r} of {file} has a curved surface ({kind}); export it as polygons")
    points = np.array(vertices, np.float64).reshape(-1, 3)
    return [
        Body(name, points, triangulate(points, np.array(own, int), np.array(sizes, int)))
        for name, (own, sizes) in faces.items()
    ]


def _corner(word: str, count: int, file: Path) -> int:
    """Returns the place of a vertex, "7", "7/1/2" or "-1"."""
    number = int(word.split("/", 1)[0])
    place = number - 1 if number > 0 else count + number
    if number == 0 or place < 0:
        raise UserError(f"{file} has a face with the corner {word!r}, which does not exist; export it again")
    return place


def _text(content: bytes) -> str:
    """Returns the text, continued lines in one; bytes of no known encoding are kept apart from each other."""
    coding = WIDE.get(content[:2], "utf-8-sig")
    try:
        text = content.decode(coding)
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    return re.sub(r"\\\r?\n", " ", text.removeprefix("\ufeff"))
