"""Reads and writes meshes and point clouds as PLY files; positions are in metres, in the frame of the file.

A PLY file (Turk 1994) has elements with properties, which are numbers or lists of numbers, as text or binary. Existing
libraries are under the GPL or do not read polygons of different sizes.
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Num

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write
from wbgs_jax.mesh.bodies import triangulate

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float32": "f4", "float64": "f8"},
}


class Ragged(NamedTuple):
    """Lists of different lengths, concatenated."""

    values: Num[np.ndarray, " total"]
    sizes: Int[np.ndarray, " n"]


Columns = dict[str, np.ndarray | Ragged]
"""Properties of all rows of an element by name."""


class _Damaged(ValueError):
    """Describes a defect of a file, worded to fit into parentheses."""


@dataclass(frozen=True)
class _Property:
    name: str
    type: np.dtype
    count: np.dtype | None
    """Type of the length of a list; None for a number."""


@dataclass(frozen=True)
class _Element:
    name: str
    rows: int
    properties: list[_Property]


@dataclass(frozen=True)
class _Body:
    """Content after the header: bytes, or the numbers of a text."""

    cells: np.ndarray
    is_text: bool

    def width(self, kind: np.dtype) -> int:
        """Returns the number of cells of a value."""
        return 1 if self.is_text else kind.itemsize

    def reader(self, kind: np.dtype | None) -> Callable[[memoryview, int], tuple[float]]:
        """Returns a fast function that reads one number."""
        if self.is_text or kind is None:
            return lambda cells, place: (cells[place],)
        order = "" if kind.str[0] == "|" else kind.str[0]
        return struct.Struct(order + kind.char).unpack_from

    def at(self, places: Int[np.ndarray, " n"], kind: np.dtype) -> Num[np.ndarray, " n"]:
        """Returns the numbers that begin at the given cells."""
        if self.is_text:
            numbers = self.cells[places]
        else:
            numbers = self.cells[places[:, None] + np.arange(kind.itemsize)].reshape(-1).view(kind)
        return numbers.astype(kind.newbyteorder("="), copy=False)


def read_elements(path: Path | str) -> dict[str, Columns]:
    """Returns the elements of a PLY file by name, and their properties by name.

    Raises:
        UserError: the file is missing, truncated, or not a PLY.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}; check the path and its permissions") from error
    try:
        with np.errstate(invalid="ignore", over="ignore"):  # floats that no integer can hold give faces with invalid indices
            order, elements, body = _header(content)
            return _elements(elements, _text(body) if not order else _Body(np.frombuffer(body, np.uint8), False))
    except _Damaged as error:
        raise UserError(f"{path} is not a PLY file or is truncated ({error}); export it again") from error


def write_elements(path: Path | str, elements: Mapping[str, np.ndarray]) -> None:
    """Writes structured arrays as elements of a little-endian PLY file, atomically; a vector becomes a list.

    Raises:
        UserError: the file cannot be written.
    """
    names = {code: name for name, code in reversed(TYPES.items())}
    header, parts = ["ply", "format binary_little_endian 1.0"], []
    for element, rows in elements.items():
        header.append(f"element {element} {len(rows)}")
        layout: list[tuple[str, str, tuple[int, ...]]] = []
        for name in rows.dtype.names or ():
            base, shape = rows.dtype[name].base, rows.dtype[name].shape
            kind = names[base.str[1:]]
            header.append(f"property list uchar {kind} {name}" if shape else f"property {kind} {name}")
            layout += [(f"{name} size", "u1", ())] * bool(shape) + [(name, base.newbyteorder("<").str, shape)]
        packed = np.zeros(len(rows), np.dtype(layout))
        for name in packed.dtype.names or ():
            packed[name] = rows[name] if name in (rows.dtype.names or ()) else rows.dtype[name.removesuffix(" size")].shape[0]
        parts.append(packed.tobytes())
    with atomic_write(path) as stream:
        stream.write(("\n".join([*header, "end_header"]) + "\n").encode())
        stream.writelines(parts)


def _header(content: bytes) -> tuple[str, list[_Element], bytes]:
    """Returns the byte order (empty for text), the elements, and the rest of the content."""
    longest_header = 1 << 16  # bytes
    end = content.find(b"end_header", 0, longest_header)
    lines = [line.split() for line in content[: max(end, 0)].splitlines()]
    formats = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}  # byte orders; empty for text
    if len(lines) < 2 or lines[0] != [b"ply"] or len(lines[1]) != 3 or lines[1][1] not in formats:
        raise _Damaged("it has no valid header")
    order, elements = formats[lines[1][1]], list[_Element]()
    for words in lines[2:]:
        match words:
            case [] | [b"comment" | b"obj_info", *_]:
                pass
            case [b"element", name, count] if count.isdigit() and len(count) < 19:
                elements.append(_Element(name.decode(errors="replace"), int(count), []))
            case [b"property", b"list", count, kind, name] if elements:
                elements[-1].properties.append(
                    _Property(name.decode(errors="replace"), _type(kind, order), _type(count, order))
                )
            case [b"property", kind, name] if elements:
                elements[-1].properties.append(_Property(name.decode(errors="replace"), _type(kind, order), None))
            case _:
                raise _Damaged(f"invalid header line {b' '.join(words)[:60].decode(errors='replace')!r}")
    ends = b"\n" if b"\n" in content[:end] else b"\r"  # line end of the header: binary content may begin with either
    body = content.find(ends, end)
    return order, elements, content[body + 1 :] if body >= 0 else b""


def _type(name: bytes, order: str) -> np.dtype:
    code = TYPES.get(name.decode(errors="replace"))
    if code is None:
        raise _Damaged(f"unknown number type {name[:20].decode(errors='replace')!r}")
    return np.dtype(order + code)


def _text(body: bytes) -> _Body:
    try:
        return _Body(np.array(body.split(), np.float64), True)
    except ValueError:
        raise _Damaged("it contains something other than numbers") from None


def _elements(elements: list[_Element], body: _Body) -> dict[str, Columns]:
    found, start = dict[str, Columns](), 0
    for element in elements:
        least = sum(body.width(p.count or p.type) for p in element.properties)
        if element.rows * least > len(body.cells) - start:
            raise _Damaged(f"{element.rows} rows of {element.name} are declared, but the data end before")
        found[element.name], start = _columns(element, body, start)
    if body.is_text and start < len(body.cells):
        raise _Damaged(f"{len(body.cells) - start} numbers more than its header declares")
    return found


def _columns(element: _Element, body: _Body, start: int) -> tuple[Columns, int]:
    """Returns an element's properties and the position of its end."""
    if not element.rows or not element.properties:
        empty = {
            p.name: np.zeros(0, p.type) if p.count is None else _no_lists(element.rows, p.type) for p in element.properties
        }
        return empty, start
    places, sizes, end = _equal_rows(element, body, start) or _varying_rows(element, body, start, element.rows)
    columns: Columns = {}
    for number, p in enumerate(element.properties):
        if p.count is None:
            columns[p.name] = body.at(places[number], p.type)
            continue
        size = sizes[number]
        first = np.repeat(places[number] - body.width(p.type) * (np.cumsum(size) - size), size)
        columns[p.name] = Ragged(body.at(first + body.width(p.type) * np.arange(size.sum()), p.type), size)
    return columns, end


def _no_lists(rows: int, kind: np.dtype) -> Ragged:
    return Ragged(np.zeros(0, kind), np.zeros(rows, np.int64))


Walked = tuple[np.ndarray, np.ndarray, int]
"""First cell of every property's numbers (properties, rows), their counts, and the end of the element."""


def _equal_rows(element: _Element, body: _Body, start: int) -> Walked | None:
    """Returns the positions of rows whose lists all have the lengths of the first row; None if some differ."""
    first, sizes, end = _varying_rows(element, body, start, 1)
    stride = end - start
    if start + stride * element.rows > len(body.cells):
        return None
    places, sizes = first + stride * np.arange(element.rows), np.repeat(sizes, element.rows, 1)
    for p, begin, size in zip(element.properties, places, sizes, strict=True):
        if p.count is not None and np.any(body.at(begin - body.width(p.count), p.count) != size):
            return None
    return places, sizes, start + stride * element.rows


def _varying_rows(element: _Element, body: _Body, start: int, rows: int) -> Walked:
    """Returns the positions of rows with lists of any length, read one after the other."""
    layout = [(body.width(p.type), body.width(p.count) if p.count else 0, body.reader(p.count)) for p in element.properties]
    cells, places, sizes, place = memoryview(body.cells), list[int](), list[int](), start
    try:
        for _ in range(rows):
            for width, head, read_size in layout:
                size = int(read_size(cells, place)[0]) if head else 1
                place += head
                if size < 0:
                    raise _Damaged("a list has a negative length")
                places.append(place)
                sizes.append(size)
                place += size * width
    except (struct.error, IndexError, ValueError, OverflowError) as error:
        raise _Damaged(f"it ends within {element.name}, or a list has an invalid length") from error
    if place > len(body.cells):
        raise _Damaged(f"it ends within {element.name}")
    shape = rows, len(layout)
    return np.array(places).reshape(shape).T, np.array(sizes).reshape(shape).T, place


CORNERS = ("vertex_indices", "vertex_index")
"""Names that exporters use for the corners of faces."""


def read_ply(path: Path | str) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Returns vertices (float32) and triangles (int32) of a PLY file, ASCII or binary.

    Raises:
        UserError: as in `read_mesh`, or coordinates that are not finite in single precision.
    """
    vertices, faces = read_mesh(path)
    with np.errstate(over="ignore"):
        single = vertices.astype(np.float32)
    if not np.isfinite(single).all():
        raise UserError(f"{path} has NaN or infinite vertex coordinates; clean the mesh and export it again")
    return single, faces


def read_mesh(path: Path | str) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Returns vertices (float64) and triangles (int32) of a PLY file, ASCII or binary.

    Quads and larger polygons (also concave ones) and triangle strips are cut into triangles; polygons of fewer than three
    corners are omitted. A point cloud has no triangles.

    Raises:
        UserError: the file is missing, truncated, not a PLY file, without points, or not a valid mesh.
    """
    path, elements = Path(path), read_elements(path)
    points, polygons = elements.get("vertex", {}), elements.get("face", {})
    axes = [points.get(axis) for axis in "xyz"]
    if not all(isinstance(axis, np.ndarray) and len(axis) for axis in axes):
        raise UserError(f"{path} has no points: it needs a 'vertex' element with x, y and z; export the mesh again")
    vertices = np.stack([np.asarray(axis, np.float64) for axis in axes], -1)
    corners = next((polygons[name] for name in CORNERS if name in polygons), None)
    if isinstance(corners, np.ndarray):
        raise UserError(f"{path} has a single corner per face; export the mesh again")
    faces = np.zeros((0, 3), np.int64)
    if corners is not None:
        faces = triangulate(vertices, np.asarray(corners.values, np.int64), corners.sizes)
    # Lists of this element are triangle strips: each corner makes a triangle with the two before it; -1 begins a new strip.
    strips = elements.get("tristrips", {})
    for own in (strips[name] for name in CORNERS if name in strips):
        if isinstance(own, Ragged):
            faces = np.concatenate([faces, strip_triangles(own)])
    if faces.size and not (faces.min() >= 0 and faces.max() < len(vertices)):
        raise UserError(f"{path} has faces that refer to vertices that do not exist; export the mesh again")
    return vertices, faces.astype(np.int32)


def write_ply(path: Path | str, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> None:
    """Writes float32 vertices and int32 triangles as a binary PLY file, atomically; without triangles it is a point cloud."""
    points = np.rec.fromarrays(np.asarray(vertices, "<f4").T, dtype=[(axis, "<f4") for axis in "xyz"])
    elements: dict[str, np.ndarray] = {"vertex": points}
    if len(faces):
        elements["face"] = np.zeros(len(faces), [(CORNERS[0], "<i4", (3,))])
        elements["face"][CORNERS[0]] = faces
    write_elements(path, elements)


def strip_triangles(strips: Ragged) -> Int[np.ndarray, "n 3"]:
    """Returns the triangles of strips with alternating order undone; degenerate ones, which only connect parts, are dropped."""
    found = [np.zeros((0, 3), np.int64)]
    for own in np.split(np.asarray(strips.values, np.int64), np.cumsum(strips.sizes)[:-1]):
        for part in np.split(own, np.flatnonzero(own == -1)):
            corners = part[part != -1]
            if len(corners) < 3:
                continue
            three = np.stack([corners[:-2], corners[1:-1], corners[2:]], -1)
            three[1::2] = three[1::2, [1, 0, 2]]
            degenerate = (three[:, 0] == three[:, 1]) | (three[:, 1] == three[:, 2]) | (three[:, 0] == three[:, 2])
            found.append(three[~degenerate])
    return np.concatenate(found)
