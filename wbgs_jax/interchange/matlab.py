"""Reads numeric arrays, and nothing else, from MATLAB files (.mat, version 5, as SciPy and DeepMIMO write them), or from .npz
files with the same arrays.

SciPy's own reader crashes the process on files with damaged sizes; this one checks every size first.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wbgs_jax._util.files import MOST_BYTES, check_file, read_arrays, reported

HEADER, MATRIX, COMPRESSED = 128, 14, 15
STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""NumPy types of data elements."""
CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
"""NumPy types of arrays; characters, cells and structures are skipped."""


class Element(NamedTuple):
    """A data element of a file."""

    type: int
    content: memoryview


def read_mat_or_npz(path: Path, advice: str) -> dict[str, np.ndarray]:
    """Returns the numeric arrays of a .mat file, or those of an .npz file, by name; `advice` ends messages about the latter.

    Raises:
        UserError: the file is missing or damaged.
    """
    return read_mat(path) if path.suffix.lower() == ".mat" else read_arrays(path, "", advice)


def read_mat(path: Path) -> dict[str, np.ndarray]:
    """Returns the numeric arrays of a .mat file by name.

    Raises:
        UserError: the file is missing, damaged, or of another version.
    """
    advice = "give a .mat file of version 5 (MATLAB: save -v7), or an .npz file"
    with reported(str(path), advice):
        check_file(path, str(path), advice)
        whole = memoryview(path.read_bytes())
        order = {b"IM": "<", b"MI": ">"}.get(bytes(whole[126:HEADER]))
        if order is None:
            raise ValueError("it is not a .mat file of version 5")
        return dict(_arrays(whole[HEADER:], order))


def _arrays(content: memoryview, order: str) -> Iterator[tuple[str, np.ndarray]]:
    for element in _elements(content, order):
        if element.type == COMPRESSED:
            yield from _arrays(_decompressed(element.content), order)
        elif element.type == MATRIX and (found := _array(element.content, order)):
            yield found


def _decompressed(content: memoryview) -> memoryview:
    machine = zlib.decompressobj()
    found = machine.decompress(content, MOST_BYTES)
    if machine.unconsumed_tail:
        raise ValueError("it expands to more than fits into memory")
    return memoryview(found)


def _elements(content: memoryview, order: str) -> Iterator[Element]:
    """Yields the data elements of a piece: a type, a size and the content; content of at most four bytes is packed."""
    place = 0
    while place + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, place)
        start = place + 8
        if kind >> 16:
            kind, size, start = kind & 0xFFFF, kind >> 16, place + 4
        if start + size > len(content) or (start == place + 4 and size > 4):
            raise ValueError("it is truncated")
        yield Element(kind, content[start : start + size])
        # Compressed elements follow each other without padding; all others start at multiples of eight bytes.
        place = place + 8 if start == place + 4 else start + size + (0 if kind == COMPRESSED else -size % 8)


def _array(content: memoryview, order: str) -> tuple[str, np.ndarray] | None:
    """Returns name and values of a numeric array, None for anything else."""
    flags, sizes, name, *parts = _elements(content, order)
    kind = struct.unpack_from(f"{order}I", flags.content)[0]
    dtype = CLASSES.get(kind & 0xFF)
    if dtype is None:
        return None
    shape = np.frombuffer(sizes.content, f"{order}i4").tolist()
    most_axes = 16
    if not 2 <= len(shape) <= most_axes or min(shape) < 0:
        raise ValueError(f"an array in it has the shape {shape[:most_axes]}")
    is_complex = bool(kind >> 8 & 0x08)  # then a second part has the imaginary numbers
    values = [_numbers(part, order, dtype, shape) for part in parts[: 1 + is_complex]]
    label = bytes(name.content).decode("ascii", errors="replace")
    return label, values[0] if len(values) == 1 else values[0] + 1j * values[1]


def _numbers(element: Element, order: str, dtype: str, shape: list[int]) -> np.ndarray:
    if element.type not in STORED:
        raise ValueError(f"it contains the unknown number type {element.type}")
    found = np.frombuffer(element.content, order + STORED[element.type])
    if len(found) != math.prod(shape):
        raise ValueError(f"an array in it has {len(found)} numbers instead of {math.prod(shape)}")
    return found.astype(dtype).reshape(shape, order="F")
