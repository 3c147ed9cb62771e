"""What scenes are built of: furniture, walls with openings, grids, and the geometry of meshes."""

import sys

import numpy as np
import pytest
import trimesh

from data_gen.scenes.base import grid_3d, part
from data_gen.scenes.furniture import (
    bed,
    bench,
    cabinet,
    chair,
    counter,
    desk,
    lamp,
    monitor,
    office_chair,
    place,
    shelf,
    sofa,
    table,
    wardrobe,
)  # fmt: skip
from data_gen.scenes.geometry import box, crossings, distance, winding_number
from data_gen.scenes.walls import Door, inner_wall, wall
from wbgs_jax._util.errors import UserError
from wbgs_jax.mesh import bodies

MORE = [bed(1.6), bench(1.5), cabinet(1, 0.5, 1), counter(2), desk(1.5), monitor(0.7), office_chair(), wardrobe(1.2)]


def test_winding_number_knows_inside(rng):
    mesh = box((-1, -2, -3), (1, 2, 3))
    points = rng.uniform(-4, 4, (500, 3))
    inside = (np.abs(points) < [1, 2, 3]).all(1)
    np.testing.assert_allclose(np.abs(winding_number(mesh, points)), inside, atol=1e-6)


@pytest.mark.parametrize("mesh", [table(1.8, 0.9, 0.75), chair(), sofa(2.0), shelf(1.2, 0.3, 2.0), lamp(), *MORE])
def test_furniture_turns_about_its_middle(mesh):
    for facing in range(4):
        turned = place(mesh, 1.0, 2.0, facing)
        extents = mesh.extents[[1, 0, 2]] if facing % 2 else mesh.extents
        np.testing.assert_allclose(turned.extents, extents, atol=1e-9)
        assert turned.is_watertight and turned.volume > 0


def test_an_inner_wall_turns_with_its_direction():
    """The same wall along +x and along +y: a quarter turn about the start."""
    args = {"height": 2.6, "doors": [Door(2.0, leaf=(1, -1))], "free": (False, True), "rise": 0.1}
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for p, q in zip(inner_wall("a", (0, 0), (4, 0), **args), inner_wall("a", (0, 0), (0, 4), **args), strict=True):
        assert (p.name, p.kind, p.material) == (q.name, q.kind, q.material)
        turned = p.mesh.vertices @ turn.T
        np.testing.assert_allclose(np.sort(turned, axis=0), np.sort(q.mesh.vertices, axis=0), atol=1e-12)
    assert [p.name for p in inner_wall("a", (0, 0), (4, 0), **args)] == ["a", "a_frames", "a_leaves", "a_posts"]


def test_a_slanting_inner_wall_is_refused():
    with pytest.raises(ValueError, match="along"):
        inner_wall("a", (0, 0), (1, 1), 2.6)


def test_a_part_is_of_a_known_kind():
    with pytest.raises(ValueError, match="one of"):
        part("a", box((0, 0, 0), (1, 1, 1)), "wood", kind="fog")


def test_crossings_are_counted(rng):
    mesh = box((-1, -1, -1), (1, 1, 1))
    start = rng.uniform(-3, 3, (300, 3))
    inside = (np.abs(start) < 1).all(1)
    np.testing.assert_array_equal(crossings(mesh, start, np.array([0.011, 0.007, 0.003])) == 0, inside)
    assert (crossings(mesh, start, np.array([50.0, 41.0, 33.0])) % 2 == inside).all()
    assert len(crossings(mesh, start[:0], np.ones(3))) == 0
    nothing = trimesh.Trimesh()
    np.testing.assert_array_equal(crossings(nothing, start, np.ones(3)), np.zeros(300))


def test_without_rtree_the_message_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rtree", None)
    for ask in (lambda: distance(chair(), np.ones((1, 3))), lambda: crossings(chair(), np.zeros((1, 3)), np.ones(3))):
        with pytest.raises(UserError, match="rtree, which is not installed; `make simulator`"):
            ask()


def test_chunks_change_nothing(monkeypatch, rng):
    mesh, points = chair(), rng.uniform(-1, 1, (50, 3))
    whole = winding_number(mesh, points)
    monkeypatch.setattr(bodies, "CHUNK", 200)
    np.testing.assert_array_equal(winding_number(mesh, points), whole)


def test_wall_is_cut_without_hole_or_overlap():
    openings = {"window": ((1.0, 1.0, 2.0, 2.0), "glass"), "door": ((3.0, 0.0, 4.0, 2.1), "wood")}
    parts = wall("wall", (0, 0, 0), (1, 0, 0), (0, 0, 1), (5.0, 3.0), "concrete", openings)
    assert {p.name: round(p.mesh.area, 9) for p in parts} == {"wall": 15 - 1 - 2.1, "window": 1.0, "door": 2.1}
    assert [p.material for p in parts] == ["concrete", "glass", "wood"]


def test_a_hole_and_a_rising_edge():
    parts = wall("wall", (0, 0, 0), (1, 0, 0), (0, 0, 1), (4.0, 2.0), "wood", {"hole": ((1, 0, 2, 1), None)}, rise=0.5)
    assert [p.name for p in parts] == ["wall"]
    assert parts[0].mesh.area == pytest.approx(4 * 2 + 4 * 2 / 2 - 1)
    assert parts[0].mesh.bounds[1].tolist() == [4, 0, 4]


def test_grid_order():
    grid = grid_3d((0, 0, 0), (1, 2, 3), (2, 3, 4))
    assert grid.shape == (24, 3)
    np.testing.assert_array_equal(grid[:2], [[0, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(grid[-1], [1, 2, 3])


@pytest.mark.parametrize("name", ["brick", "marble", ""])
def test_unknown_material_is_refused(name):
    with pytest.raises(UserError, match="unknown material"):
        part("wall", box((0, 0, 0), (1, 1, 1)), name)
