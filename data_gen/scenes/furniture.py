"""Furniture and room surfaces as meshes. Everything stands on the floor (z = GAP) centred on (x, y); metres, z up.

`facing` turns a piece about the vertical by quarter turns: 0 looks towards +y, 1 towards -x, 2 towards -y, 3 towards +x.
"""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
import trimesh

from data_gen.scenes.base import GAP, JOINT, Part, Vec3, merge, part

LAMP_SIDES = 8  # a round shade would be hundreds of triangles and as many diffracting edges


def box(low: Vec3, high: Vec3) -> trimesh.Trimesh:
    """A closed axis-aligned box."""
    mesh = trimesh.creation.box(extents=np.subtract(high, low))
    mesh.apply_translation(np.add(low, high) / 2)
    return mesh


def place(mesh: trimesh.Trimesh, x: float, y: float, facing: int = 0) -> trimesh.Trimesh:
    """Turn a mesh about the vertical by quarter turns, then move it to (x, y) and onto the floor."""
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[facing % 4]
    # Whole numbers, so that turned boxes stay exactly axis-aligned.
    turn = np.array([[cosine, -sine, 0, x], [sine, cosine, 0, y], [0, 0, 1, GAP], [0, 0, 0, 1]], np.float64)
    return mesh.copy().apply_transform(turn)


def legs(width: float, depth: float, height: float, side: float) -> list[trimesh.Trimesh]:
    """Four square legs at the corners of a width x depth rectangle."""
    x, y = width / 2, depth / 2
    corners = [(-x, -y), (x - side, -y), (-x, y - side), (x - side, y - side)]
    return [box((a, b, 0), (a + side, b + side, height - JOINT)) for a, b in corners]


def table(width: float, depth: float, height: float, board: float = 0.04) -> trimesh.Trimesh:
    """A board on four legs."""
    top = box((-width / 2, -depth / 2, height - board), (width / 2, depth / 2, height))
    return merge([top, *legs(width - 0.1, depth - 0.1, height - board, 0.06)])


def chair(width: float = 0.45, seat: float = 0.46, height: float = 0.88) -> trimesh.Trimesh:
    """A chair whose sitter looks towards +y."""
    half, board = width / 2, 0.04
    cushion = box((-half, -half, seat - board), (half, half, seat))
    back = box((-half, -half, seat + JOINT), (half, -half + board, height))
    return merge([cushion, back, *legs(width, width, seat - board, board)])


def sofa(width: float, depth: float = 0.9, height: float = 0.8) -> trimesh.Trimesh:
    """A sofa whose sitter looks towards +y: seat, back and two arms."""
    half, front, arm, seat = width / 2, depth / 2, 0.18, 0.42
    inner = half - arm - JOINT
    back = box((-inner, -front, 0), (inner, -front + 0.22, height))
    cushion = box((-inner, -front + 0.22 + JOINT, 0), (inner, front, seat))
    left, right = (box((a, -front, 0), (a + arm, front, 0.6)) for a in (-half, half - arm))
    return merge([back, cushion, left, right])


def shelf(width: float, depth: float, height: float, boards: int = 5, thickness: float = 0.03) -> trimesh.Trimesh:
    """An open book shelf that looks towards +y: two sides, a back and horizontal boards."""
    half, front = width / 2, depth / 2
    sides = [box((a, -front, 0), (a + thickness, front, height)) for a in (-half, half - thickness)]
    inner = half - thickness - JOINT
    back = box((-inner, -front, 0), (inner, -front + thickness, height))
    levels = np.linspace(0.06, height - thickness, boards)
    rows = [box((-inner, -front + thickness + JOINT, z), (inner, front, z + thickness)) for z in levels]
    return merge([*sides, back, *rows])


def cabinet(width: float, depth: float, height: float) -> trimesh.Trimesh:
    """A closed cupboard."""
    return box((-width / 2, -depth / 2, 0), (width / 2, depth / 2, height))


def screen(width: float, height: float, bottom: float, thickness: float = 0.05) -> trimesh.Trimesh:
    """A flat display that looks towards +y, its lower edge `bottom` above the floor."""
    return box((-width / 2, -thickness / 2, bottom), (width / 2, thickness / 2, bottom + height))


def lamp(height: float = 1.7, shade: float = 0.22) -> trimesh.Trimesh:
    """A floor lamp: foot, pole and an eight-sided shade of radius `shade`."""
    foot = prism(0.16, 0.0, 0.03)
    pole = box((-0.015, -0.015, 0.03 + JOINT), (0.015, 0.015, height - 0.3 - JOINT))
    return merge([foot, pole, prism(shade, height - 0.3, height)])


def prism(radius: float, bottom: float, top: float) -> trimesh.Trimesh:
    """A closed vertical prism with `LAMP_SIDES` sides."""
    mesh = trimesh.creation.cylinder(radius=radius, height=top - bottom, sections=LAMP_SIDES)
    mesh.apply_translation((0, 0, (top + bottom) / 2))
    return mesh


Rectangle = tuple[float, float, float, float]
"""(u low, v low, u high, v high) in the coordinates of a wall, metres."""


def wall(
    name: str, corner: Vec3, along: Vec3, up: Vec3, size: tuple[float, float], material: str,
    openings: Mapping[str, tuple[Rectangle, str]] | None = None,
) -> list[Part]:  # fmt: skip
    """A rectangular surface with doors or windows flush in it.

    The rectangle is cut along the lines of all openings; a cell belongs to the opening that covers it, otherwise to the wall.
    The parts meet at shared vertices, without a hole and without overlap.

    Args:
        corner, along, up: the point (0, 0) of the surface and its two unit directions.
        size: lengths (metres) along the two directions.
        openings: by name a rectangle in the surface's coordinates and a material.
    """
    openings = openings or {}
    rectangles = [rectangle for rectangle, _ in openings.values()]
    us = np.unique([0.0, size[0], *(r[i] for r in rectangles for i in (0, 2))])
    vs = np.unique([0.0, size[1], *(r[i] for r in rectangles for i in (1, 3))])
    cells: dict[str, list[Rectangle]] = {name: [], **{key: [] for key in openings}}
    for u0, u1 in itertools.pairwise(us):
        for v0, v1 in itertools.pairwise(vs):
            cells[_owner(openings, (u0 + u1) / 2, (v0 + v1) / 2) or name].append((u0, v0, u1, v1))
    materials = {name: material, **{key: value[1] for key, value in openings.items()}}
    return [part(key, _sheet(found, corner, along, up), materials[key], closed=False) for key, found in cells.items()]


def _owner(openings: Mapping[str, tuple[Rectangle, str]], u: float, v: float) -> str | None:
    for key, ((u0, v0, u1, v1), _) in openings.items():
        if u0 < u < u1 and v0 < v < v1:
            return key
    return None


def _sheet(cells: Sequence[Rectangle], corner: Vec3, along: Vec3, up: Vec3) -> trimesh.Trimesh:
    uv = np.array([[(a, b), (c, b), (c, d), (a, d)] for a, b, c, d in cells]).reshape(-1, 2)
    vertices = np.asarray(corner) + uv[:, :1] * np.asarray(along) + uv[:, 1:] * np.asarray(up)
    faces = (4 * np.arange(len(cells))[:, None] + np.array([[[0, 1, 2]], [[0, 2, 3]]])).reshape(-1, 3)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices()
    return mesh
