"""Walls between points, and the mesh that they make."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.flats import RECEIVERS, WALL, places, walls_between, write_table

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.floor_plan import NO_WALLS, ON_WALL, Walls, crossings, extruded, load_walls

SINGLE = Walls(WALL, np.ones(1))


def test_one_wall_with_a_door(rng):
    tx = places(rng, 300)
    found = crossings(SINGLE, tx[:, None, :2], RECEIVERS[None, :, :2])
    np.testing.assert_array_equal(found, walls_between(tx))
    in_jax = jax.jit(crossings)(SINGLE, jnp.asarray(tx[:, None, :2]), jnp.asarray(RECEIVERS[None, :, :2]))
    np.testing.assert_array_equal(in_jax, found)
    assert not crossings(NO_WALLS, tx[:, :2], tx[::-1, :2]).any()


def test_random_walls_by_orientations(rng):
    """Two segments cross where the ends of each lie on both sides of the other; no point lies on a wall."""
    ends, points = rng.uniform(0, 5, (20, 2, 2)), rng.uniform(0, 5, (400, 2))
    along = (ends[:, 1] - ends[:, 0]) / np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1, keepdims=True)
    apart = (points[:, None] - ends[:, 0]) @ np.array([[0, 1], [-1, 0]])
    points = points[(np.abs(np.sum(apart * along, -1)) > 2 * ON_WALL).all(1)]
    start, goal = points[: len(points) // 2], points[len(points) // 2 : 2 * (len(points) // 2)]

    def side(a, b, p):
        return np.sign((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]))

    expected = [
        sum(side(a, b, p) != side(a, b, q) and side(p, q, a) != side(p, q, b) for a, b in ends)
        for p, q in zip(start, goal, strict=True)
    ]
    np.testing.assert_array_equal(crossings(Walls(ends, np.ones(20)), start, goal), expected)
    assert len(expected) > 50


def test_an_outline_has_two_faces_a_wall(tmp_path):
    """Two rooms of 2 m x 2 m, a wall of 0.2 m between them with a door at its end."""
    corners = [[0, 0], [2, 0], [2, 1.5], [2.2, 1.5], [2.2, 0], [4.2, 0], [4.2, 2], [0, 2]]
    write_table(tmp_path / "layout.csv", ["x", "y"], corners)
    walls = load_walls(tmp_path / "layout.csv")
    assert len(walls.ends) == 8
    start, goal = np.array([[1.0, 1.0], [1.0, 1.8], [1.0, 1.0]]), np.array([[3.0, 1.0], [3.0, 1.8], [1.5, 0.2]])
    np.testing.assert_array_equal(crossings(walls, start, goal), [1, 0, 0])


def test_outlines_of_several_rooms_are_told_apart(tmp_path):
    """Two rooms of 4 m x 5 m and 0.2 m between them."""
    rows = [f"{name},{x},{y}" for name, left, right in (("A", 0, 4), ("B", 4.2, 8.2)) for x, y in
            ((left, 0), (right, 0), (right, 5), (left, 5))]  # fmt: skip
    (tmp_path / "walls.csv").write_text("\n".join(["room,x,y", *rows]))
    walls = load_walls(tmp_path / "walls.csv")
    assert len(walls.ends) == 8
    start, goal = np.array([[1.0, 2.0], [1.0, 2.0], [5.0, 1.0]]), np.array([[3.0, 4.5], [6.0, 2.0], [8.0, 4.0]])
    np.testing.assert_array_equal(crossings(walls, start, goal), [0, 1, 0])


ROOMS = [[f"{x},{y}" for x, y in ((left, 0), (left + 4, 0), (left + 4, 5), (left, 5))] for left in (0, 4.2)]


@pytest.mark.parametrize("between", ["\n\n", "\n,\n", "\r\n\r\n\r\n"])
@pytest.mark.parametrize("closed", [False, True])
def test_empty_lines_and_repeated_corners_separate_outlines(tmp_path, between, closed):
    outlines = ["\n".join([*room, *room[:closed]]) for room in ROOMS]
    for text in (between.join(outlines), "\n".join(outlines) if closed else between.join(outlines)):
        (tmp_path / "walls.csv").write_text(f"x,y\n{text}\n\n")
        corners = np.array([[row.split(",") for row in room] for room in ROOMS], float)
        expected = np.concatenate([np.stack([room, np.roll(room, -1, 0)], 1) for room in corners])
        np.testing.assert_array_equal(load_walls(tmp_path / "walls.csv").ends, expected)


def test_empty_lines_after_all_corners_separate_nothing(tmp_path):
    (tmp_path / "walls.csv").write_bytes("\r\r\n".join(["x,y", *ROOMS[0], ""]).encode())
    assert len(np.unique(load_walls(tmp_path / "walls.csv").ends, axis=0)) == 4


def test_corners_after_a_closed_outline_are_refused(tmp_path):
    (tmp_path / "walls.csv").write_text("\n".join(["x,y", *ROOMS[0], ROOMS[0][0], *ROOMS[1]]))
    with pytest.raises(
        UserError, match=r"returns to its first corner \[0.0, 0.0\], but .*; separate the outlines by a column room"
    ):
        load_walls(tmp_path / "walls.csv")


def test_walls_stand_between_floor_and_ceiling(tmp_path):
    write_table(tmp_path / "walls.csv", ["x1", "y1", "x2", "y2"], [[0, 0, 5, 0], [5, 0, 5, 3], [2, 1, 2, 1]])
    mesh = extruded(load_walls(tmp_path / "walls.csv"), 2.5)
    assert len(mesh.faces) == 2 * (2 + 2)  # a wall of no length is none
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [5, 3, 2.5]])
    np.testing.assert_allclose(mesh.area, 2.5 * (5 + 3) + 2 * 5 * 3)


def test_classes_of_walls_are_read(tmp_path):
    path = tmp_path / "walls.csv"
    path.write_text("x1,y1,x2,y2,material\n0,0,5,0,Glass\n5,0,5,3,concrete\n5,3,0,3,glass \n")
    walls = load_walls(path)
    assert walls.classes == ("concrete", "glass")
    np.testing.assert_array_equal(walls.of_class, [[0, 1], [1, 0], [0, 1]])
    path.write_text("x1,y1,x2,y2,material\n0,0,5,0,glass\n5,0,5,3,\n")
    np.testing.assert_array_equal(load_walls(path).of_class, [[1], [0]])
    path.write_text("x1,y1,x2,y2,type\n0,0,5,0,brick\n5,0,5,3,brick\n")
    assert load_walls(path).of_class is None


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("x1,y1,x2,y2,type,class\n0,0,5,0,a,b\n", "has the columns 'class' and 'type'"),
        ("x1,y1,x2,y2,type\n" + "".join(f"0,0,5,{k},{k}\n" for k in range(11)), "has 11 different values in the column 'type'"),
        ("x,z\n1,2\n", "has no column 'y'"),
        ("x1,y1,x2,y2\n1,2,3,\n", "corners must be coordinates in metres"),
        ("x,y\n1,1e300\n2,2\n", "corners must be coordinates in metres"),
        ("x,y\n", "no rows"),
        ("floor,x,y\n1,0,0\n1,1,0\n1,1,1\n", "has an unknown column 'floor'"),
        ("x1,y1,x2,y2,storey\n0,0,1,1,2\n", "has an unknown column 'storey'"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, content, says):
    (tmp_path / "walls.csv").write_text(content)
    with pytest.raises(UserError, match=says):
        load_walls(tmp_path / "walls.csv")


def test_a_receiver_on_a_wall_is_not_behind_it(rng):
    """On a slanted wall, in single and in double precision."""
    ends = rng.uniform(0, 5, (1, 2, 2))
    wall, share = Walls(ends, np.ones(1)), rng.uniform(0.1, 0.9, (200, 1))
    on = ends[0, 0] + share * (ends[0, 1] - ends[0, 0])
    tx = rng.uniform(-5, 10, (200, 2))
    assert not crossings(wall, tx, on).any()
    single = [jnp.asarray(a, jnp.float32) for a in (tx, on)]
    assert not crossings(jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), wall), *single).any()
