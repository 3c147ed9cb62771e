"""PLY files of plyfile in every form that its format has, and STL of numpy-stl."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from builders.conformance.entries import entries
from builders.conformance.shapes import CABINET, RAMP, WALL, Geometry, Shape, floor, geometry, mesh_of


def vertices_of(shape: Shape, kind: str = "f4", order: str = "xyz") -> np.ndarray:
    """Returns the vertex element: columns in any order."""
    rows = np.zeros(len(shape.vertices), [(axis, kind) for axis in order])
    for number, axis in enumerate("xyz"):
        rows[axis] = shape.vertices[:, number]
    return rows


def lists(rows: list[list[int]], name: str = "vertex_indices", kind: str = "i4", **more: str) -> np.ndarray:
    """Returns an element of lists, with further columns of zeros."""
    found = np.zeros(len(rows), [(name, object), *more.items()])
    found[name] = [np.array(row, kind) for row in rows]
    return found


def ply(
    name: str,
    shape: Shape,
    element: str = "face",
    faces: np.ndarray | None = None,
    vertex: dict[str, Any] | None = None,
    **how: Any,
) -> Callable[[Path], Geometry]:
    """Returns a maker of one object."""

    def make(folder: Path) -> Geometry:
        from plyfile import PlyData, PlyElement

        kinds = {key: how.pop(key) for key in ("len_types", "val_types") if key in how} if how else {}
        polygons = lists(shape.polygons) if faces is None else faces
        elements = [
            PlyElement.describe(vertices_of(shape, **(vertex or {})), "vertex", comments=["metres"]),
            PlyElement.describe(polygons, element, **kinds),
        ]
        PlyData(elements[:: how.pop("way", 1)], comments=["a room"], obj_info=["num_cols 4"], **how).write(folder / name)
        return geometry(folder / name, {Path(name).stem: shape})

    return make


def strip(folder: Path) -> Geometry:
    """Strips of triangles, two in one list."""
    from plyfile import PlyData, PlyElement

    corners = np.array([[x, y, 0] for x in range(4) for y in (0, 2)], np.float64)
    shape = Shape(corners, [[0, 2, 3, 1], [4, 6, 7, 5]])
    strips = PlyElement.describe(lists([[0, 1, 2, 3, -1, 4, 5, 6, 7]]), "tristrips")
    PlyData([PlyElement.describe(vertices_of(shape), "vertex"), strips]).write(folder / "strip.ply")
    return geometry(folder / "strip.ply", {"strip": shape})


PLY = {
    ("ply", "little endian"): ply("little.ply", CABINET, byte_order="<"),
    ("ply", "big endian"): ply("big.ply", CABINET, byte_order=">"),
    ("ply", "text"): ply("text.ply", CABINET, text=True),
    ("ply", "double precision"): ply("double.ply", RAMP, vertex={"kind": "f8"}),
    ("ply", "double precision, big endian"): ply("wide.ply", WALL, vertex={"kind": "f8"}, byte_order=">"),
    ("ply", "whole numbers"): ply("whole.ply", floor().moved(np.diag([2, 1, 1, 1.0])), vertex={"kind": "i2"}),
    ("ply", "triangles and quads together"): ply("ramp.ply", RAMP),
    ("ply", "triangles and quads together, text"): ply("ramp_text.ply", RAMP, text=True),
    ("ply", "columns in another order"): ply("order.ply", RAMP, vertex={"order": "zxy"}),
    ("ply", "faces before vertices"): ply("before.ply", CABINET, way=-1),
    ("ply", "corners as vertex_index"): ply("index.ply", CABINET, faces=lists(CABINET.polygons, "vertex_index")),
    ("ply", "corners of unsigned bytes"): ply(
        "bytes.ply", CABINET, faces=lists(CABINET.polygons, kind="u1"), val_types={"vertex_indices": "u1"}
    ),
    ("ply", "lengths of four bytes"): ply("lengths.ply", RAMP, len_types={"vertex_indices": "u4"}),
    ("ply", "faces with colours and marks"): ply(
        "marked.ply", RAMP, faces=lists(RAMP.polygons, red="u1", mark="f8"), byte_order=">"
    ),
    **{("ply", f"a concave polygon from corner {i}"): ply(f"concave{i}.ply", floor(i), text=i % 2 == 0) for i in range(6)},
    ("ply", "strips of triangles"): strip,
    ("ply", "scans without faces"): (ply("scan.ply", CABINET, "range_grid"), "refused"),
}
ENTRIES = entries("plyfile", PLY, ("plyfile",), "plyfile")


def stl(name: str, mode: str) -> Callable[[Path], Geometry]:
    """Returns a maker of an STL file."""

    def make(folder: Path) -> Geometry:
        from stl import Mode, mesh

        body = mesh.Mesh(np.zeros(12, mesh.Mesh.dtype))
        body.vectors[:] = mesh_of(CABINET).triangles
        body.save(str(folder / name), mode=Mode[mode])
        return geometry(folder / name, {Path(name).stem: CABINET})

    return make


STL = {("stl", "binary"): (stl("a.stl", "BINARY"), "refused"), ("stl", "text"): (stl("b.stl", "ASCII"), "refused")}
ENTRIES += entries("numpy-stl", STL, ("stl",), "numpy-stl")
