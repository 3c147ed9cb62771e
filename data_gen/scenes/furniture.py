"""Furniture as meshes. Everything stands on the floor (z = GAP) centred on (x, y); metres, z up.

`facing` rotates a piece about the vertical by quarter turns: 0 faces +y, 1 towards -x, 2 towards -y, 3 towards +x.
"""

import numpy as np
import trimesh

from data_gen.scenes.base import GAP, JOINT
from data_gen.scenes.geometry import box, merge

LAMP_SIDES = 8  # a round shade would be hundreds of triangles and as many diffracting edges


def place(mesh: trimesh.Trimesh, x: float, y: float, facing: int = 0) -> trimesh.Trimesh:
    """Rotates a mesh about the vertical by quarter turns, then moves it to (x, y) and onto the floor."""
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[facing % 4]
    # Whole numbers, so that rotated boxes stay exactly axis-aligned.
    turn = np.array([[cosine, -sine, 0, x], [sine, cosine, 0, y], [0, 0, 1, GAP], [0, 0, 0, 1]], np.float64)
    return mesh.copy().apply_transform(turn)


def legs(width: float, depth: float, height: float, side: float) -> list[trimesh.Trimesh]:
    """Returns four square legs at the corners of a width x depth rectangle."""
    x, y = width / 2, depth / 2
    corners = [(-x, -y), (x - side, -y), (-x, y - side), (x - side, y - side)]
    return [box((a, b, 0), (a + side, b + side, height - JOINT)) for a, b in corners]


def table(width: float, depth: float, height: float, board: float = 0.04) -> trimesh.Trimesh:
    """Returns a board on four legs."""
    top = box((-width / 2, -depth / 2, height - board), (width / 2, depth / 2, height))
    return merge([top, *legs(width - 0.1, depth - 0.1, height - board, 0.06)])


def chair(width: float = 0.45, seat: float = 0.46, height: float = 0.88) -> trimesh.Trimesh:
    """Returns a chair whose sitter faces +y."""
    half, board = width / 2, 0.04
    cushion = box((-half, -half, seat - board), (half, half, seat))
    back = box((-half, -half, seat + JOINT), (half, -half + board, height))
    return merge([cushion, back, *legs(width, width, seat - board, board)])


def sofa(width: float, depth: float = 0.9, height: float = 0.8) -> trimesh.Trimesh:
    """Returns a sofa whose sitter faces +y: seat, back and two arms."""
    half, front, arm, seat = width / 2, depth / 2, 0.18, 0.42
    inner = half - arm - JOINT
    back = box((-inner, -front, 0), (inner, -front + 0.22, height))
    cushion = box((-inner, -front + 0.22 + JOINT, 0), (inner, front, seat))
    left, right = (box((a, -front, 0), (a + arm, front, 0.6)) for a in (-half, half - arm))
    return merge([back, cushion, left, right])


def shelf(width: float, depth: float, height: float, boards: int = 5, thickness: float = 0.03) -> trimesh.Trimesh:
    """Returns an open book shelf that faces +y: two sides, a back and horizontal boards."""
    half, front = width / 2, depth / 2
    sides = [box((a, -front, 0), (a + thickness, front, height)) for a in (-half, half - thickness)]
    inner = half - thickness - JOINT
    back = box((-inner, -front, 0), (inner, -front + thickness, height))
    levels = np.linspace(0.06, height - thickness, boards)
    rows = [box((-inner, -front + thickness + JOINT, z), (inner, front, z + thickness)) for z in levels]
    return merge([*sides, back, *rows])


def cabinet(width: float, depth: float, height: float) -> trimesh.Trimesh:
    """Returns a closed cupboard."""
    return box((-width / 2, -depth / 2, 0), (width / 2, depth / 2, height))


def screen(width: float, height: float, bottom: float, thickness: float = 0.05) -> trimesh.Trimesh:
    """Returns a flat display that faces +y, its lower edge `bottom` above the floor."""
    return box((-width / 2, -thickness / 2, bottom), (width / 2, thickness / 2, bottom + height))


def lamp(height: float = 1.7, shade: float = 0.22) -> trimesh.Trimesh:
    """Returns a floor lamp: foot, pole and an eight-sided shade of radius `shade`."""
    foot = prism(0.16, 0.0, 0.03)
    pole = box((-0.015, -0.015, 0.03 + JOINT), (0.015, 0.015, height - 0.3 - JOINT))
    return merge([foot, pole, prism(shade, height - 0.3, height)])


def prism(radius: float, bottom: float, top: float) -> trimesh.Trimesh:
    """Returns a closed vertical prism with `LAMP_SIDES` sides."""
    mesh = trimesh.creation.cylinder(radius=radius, height=top - bottom, sections=LAMP_SIDES)
    mesh.apply_translation((0, 0, (top + bottom) / 2))
    return mesh


def bed(width: float, length: float = 2.0) -> trimesh.Trimesh:
    """Returns a bed whose foot is towards +y: base, mattress, pillow and a board behind the head."""
    half, head, foot = width / 2, -length / 2, length / 2
    start = head + 0.05 + JOINT
    board = box((-half, head, 0), (half, head + 0.05, 0.85))
    base = box((-half + 0.04, start, 0), (half - 0.04, foot - 0.04, 0.24))
    mattress = box((-half, start, 0.24 + JOINT), (half, foot, 0.43))
    pillow = box((-half + 0.08, start + 0.05, 0.43 + JOINT), (half - 0.08, start + 0.45, 0.49))
    return merge([board, base, mattress, pillow])


def wardrobe(width: float, depth: float = 0.58, height: float = 2.0) -> trimesh.Trimesh:
    """Returns a wardrobe with two doors towards +y."""
    half, front, leaf = width / 2, depth / 2, 0.02
    body = box((-half, -front, 0), (half, front - leaf - JOINT, height))
    doors = [box((a, front - leaf, 0.06), (a + half - 0.005, front, height)) for a in (-half, 0.005)]
    return merge([body, *doors])


def desk(width: float, depth: float = 0.7, height: float = 0.74) -> trimesh.Trimesh:
    """Returns a desk whose sitter is on the +y side: board, a side panel and drawers."""
    half, front, under = width / 2, depth / 2, height - 0.03 - JOINT
    board = box((-half, -front, height - 0.03), (half, front, height))
    panel = box((-half, -front, 0), (-half + 0.03, front, under))
    drawers = box((half - 0.42, -front, 0.05), (half, front - 0.05, under))
    return merge([board, panel, drawers])


def office_chair(seat: float = 0.46, height: float = 0.84) -> trimesh.Trimesh:
    """Returns a chair on one column whose sitter faces +y."""
    base = box((-0.26, -0.26, 0.02), (0.26, 0.26, 0.06))
    column = box((-0.03, -0.03, 0.06 + JOINT), (0.03, 0.03, seat - 0.06 - JOINT))
    cushion = box((-0.24, -0.24, seat - 0.06), (0.24, 0.24, seat))
    back = box((-0.22, -0.24, seat + JOINT), (0.22, -0.19, height))
    return merge([base, column, cushion, back])


def bench(width: float, depth: float = 0.35, height: float = 0.45) -> trimesh.Trimesh:
    """Returns a board on two side panels."""
    half, front, under = width / 2, depth / 2, height - 0.04
    board = box((-half, -front, under), (half, front, height))
    panels = [box((a, -front + 0.03, 0), (a + 0.04, front - 0.03, under - JOINT)) for a in (-half + 0.1, half - 0.14)]
    return merge([board, *panels])


def monitor(bottom: float, width: float = 0.6) -> trimesh.Trimesh:
    """Returns a computer display on a foot that faces +y and stands on something `bottom` high."""
    low = bottom + JOINT
    foot = box((-0.13, -0.09, low), (0.13, 0.09, low + 0.02))
    return merge([foot, box((-width / 2, -0.02, low + 0.02 + JOINT), (width / 2, 0.02, low + 0.38))])


def counter(width: float, depth: float = 0.6, height: float = 0.85) -> trimesh.Trimesh:
    """Returns kitchen base units with a worktop, facing +y."""
    half, front = width / 2, depth / 2
    units = box((-half, -front, 0), (half, front - 0.04, height - 0.04 - JOINT))
    return merge([units, box((-half, -front, height - 0.04), (half, front, height))])


def wall_cupboard(width: float, depth: float = 0.35, bottom: float = 1.45, top: float = 2.1) -> trimesh.Trimesh:
    """Returns a closed cupboard that hangs on a wall."""
    return box((-width / 2, -depth / 2, bottom), (width / 2, depth / 2, top))
