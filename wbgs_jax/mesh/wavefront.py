"""Reads objects from OBJ files (Wavefront, appendix B of the Advanced Visualizer's manual): polygons only.

Corners are numbered from 1, or backwards from the newest one if negative. Objects begin with `o`; if these do not divide the
faces of a file, groups (`g`) are objects, or else materials (`usemtl`). Text may be in any encoding: the names within a file
only have to differ.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from wbgs_jax._util.errors import UserError
from wbgs_jax.mesh.bodies import Body, triangulate

CURVED = {"curv", "curv2", "surf", "bzp", "bsp", "cdc", "cdp"}
"""Statements that define curves and curved surfaces."""
NAMED = re.compile(r"\s*((o|g|usemtl|mtllib)\s|#)")
"""Name statements and comments, which are not continued on the next line."""
COMMENT, REMARK = re.compile("#"), re.compile(r"(?:^|\s)#(?=\s|$)|^\s*#")
"""Patterns that begin a comment; after a name, which may itself contain `#`, the sign must stand alone."""
LINES = re.compile(r"\r\n|\r|\n")


def read_obj(file: Path) -> list[Body]:
    """Returns the objects of a file.

    Raises:
        UserError: curved surfaces, vertices without three coordinates, or faces with corners that do not exist.
    """
    statements = list(_statements(_text(file.read_bytes())))
    begins = _divider(statements)
    vertices: list[list[float]] = []
    faces: dict[str, tuple[list[int], list[int]]] = {}
    names, latest = {"o": "", "g": "", "usemtl": ""}, file.stem
    for number, words in enumerate(statements, 1):
        match words[0]:
            case "v":
                if len(words) < 4:
                    raise UserError(f"{file} has the vertex '{' '.join(words)}' without x, y and z; export it again")
                vertices.append([float(word) for word in words[1:4]])
            case "f" | "fo":  # the former name
                corners = [_corner(word, len(vertices), file) for word in words[1:]]
                name = names[begins] or names["o"] or names["g"] or file.stem
                own, sizes = faces.setdefault(name, ([], []))
                own += corners
                sizes.append(len(corners))
            case "o" | "g" | "usemtl" as kind:
                names[kind] = " ".join(words[1:]) or f"object_{number}"
                latest = latest if kind == "usemtl" else names[kind]
            case "call":
                raise UserError(f"{file} calls another file ({' '.join(words[1:])}); export it in one")
            case kind if kind in CURVED:
                raise UserError(f"object {latest!r} of {file} has a curved surface ({kind}); export it as polygons")
    points = np.array(vertices, np.float64).reshape(-1, 3)
    return [
        Body(name, points, triangulate(points, np.array(own, int), np.array(sizes, int)))
        for name, (own, sizes) in faces.items()
    ]


def _divider(statements: list[list[str]]) -> str:
    """Returns the first kind of statement that divides the faces: by objects, groups or materials; "o" if none does."""
    names, found = {"o": "", "g": "", "usemtl": ""}, set()
    for words in statements:
        if words[0] in names:
            names[words[0]] = " ".join(words[1:])
        elif words[0] in ("f", "fo"):
            found.add(tuple(names.values()))
    return next((kind for kind, own in zip(names, zip(*found, strict=True), strict=False) if len(set(own)) > 1), "o")


def _corner(word: str, count: int, file: Path) -> int:
    """Returns the index of a vertex given as "7", "7/1/2" or "-1"."""
    number = int(word.split("/", 1)[0])
    place = number - 1 if number > 0 else count + number
    if number == 0 or place < 0:
        raise UserError(f"{file} has a face with the corner {word!r}, which does not exist; export it again")
    return place


def _statements(text: str) -> Iterator[list[str]]:
    """Yields the words of every statement, with continued lines joined. Names may contain a `#` and end with a backslash, which
    is the second byte of some Shift-JIS and GBK characters if the encoding is unknown."""
    begun = ""
    for line in LINES.split(text):
        whole = begun + line
        kind = NAMED.match(whole)
        if whole.endswith("\\") and not kind:
            begun = whole[:-1] + " "
            continue
        begun = ""
        if words := (REMARK if kind else COMMENT).split(whole, maxsplit=1)[0].split():
            yield words


def _text(content: bytes) -> str:
    """Returns the text; bytes in an unknown encoding are mapped to distinct characters."""
    wide = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
    coding = wide.get(content[:2], "utf-8-sig")
    try:
        text = content.decode(coding)
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    return text.removeprefix("\ufeff")
