"""Units that OBJ and PLY files state in their comments, as SketchUp (`# File units = inches`) and Maya (`# This file uses
centimeters as units ...`) write them; the formats themselves have none."""

import re
from pathlib import Path

_SPELLINGS = {
    1.0: "m meter meters metre metres",
    0.1: "dm decimeter decimeters decimetre decimetres",
    0.01: "cm centimeter centimeters centimetre centimetres",
    0.001: "mm millimeter millimeters millimetre millimetres",
    0.0254: "in inch inches",
    0.3048: "ft foot feet",
    0.9144: "yd yard yards",
}
METRES = {word: metres for metres, words in _SPELLINGS.items() for word in words.split()}
"""Metres per unit, by the spelling of the unit."""
_STATED = re.compile(
    r"^\s*(?:#|comment\s).*?(?:\bunits?\b\s*(?:[:=]|is\b|are\b|in\b)?\s*[\"']?(\w+)|\buses\s+(\w+)\s+as\s+units\b)",
    re.IGNORECASE | re.MULTILINE,
)


def stated_unit(file: Path) -> tuple[str, float] | None:
    """Returns the unit that the comments at the beginning of a file state, and its length in metres; None if they state no
    known one."""
    beginning = 4096  # bytes: comments of that kind stand in front of the geometry
    with file.open("rb") as stream:
        text = stream.read(beginning).decode("latin-1").replace("\r", "\n")
    for stated in _STATED.finditer(text):
        word = (stated[1] or stated[2]).lower()
        if word in METRES:
            return word, METRES[word]
    return None
