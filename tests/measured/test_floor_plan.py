"""Walls between points, and the mesh that they make."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flats import RECEIVERS, WALL, places, walls_between, write_table

from wbgs_jax._util.errors import UserError
from wbgs_jax.measured.floor_plan import NO_WALLS, Walls, crossings, extruded, load_walls

SINGLE = Walls(WALL, np.ones(1))


def test_one_wall_with_a_door(rng):
    tx = places(rng, 300)
    found = crossings(SINGLE, tx[:, None, :2], RECEIVERS[None, :, :2])
    np.testing.assert_array_equal(found, walls_between(tx))
    in_jax = jax.jit(crossings)(SINGLE, jnp.asarray(tx[:, None, :2]), jnp.asarray(RECEIVERS[None, :, :2]))
    np.testing.assert_array_equal(in_jax, found)
    assert not crossings(NO_WALLS, tx[:, :2], tx[::-1, :2]).any()


def test_random_walls_by_orientations(rng):
    """Two segments cross where the ends of each lie on both sides of the other."""
    ends, start, goal = rng.uniform(0, 5, (40, 2, 2)), rng.uniform(0, 5, (60, 2)), rng.uniform(0, 5, (60, 2))

    def side(a, b, p):
        return np.sign((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]))

    expected = [
        sum(side(a, b, p) != side(a, b, q) and side(p, q, a) != side(p, q, b) for a, b in ends)
        for p, q in zip(start, goal, strict=True)
    ]
    np.testing.assert_array_equal(crossings(Walls(ends, np.ones(40)), start, goal), expected)


def test_an_outline_has_two_faces_a_wall(tmp_path):
    """Two rooms of 2 m x 2 m, a wall of 0.2 m between them with a door at its end."""
    corners = [[0, 0], [2, 0], [2, 1.5], [2.2, 1.5], [2.2, 0], [4.2, 0], [4.2, 2], [0, 2]]
    write_table(tmp_path / "layout.csv", ["x", "y"], corners)
    walls = load_walls(tmp_path / "layout.csv")
    assert len(walls.ends) == 8
    start, goal = np.array([[1.0, 1.0], [1.0, 1.8], [1.0, 1.0]]), np.array([[3.0, 1.0], [3.0, 1.8], [1.5, 0.2]])
    np.testing.assert_array_equal(crossings(walls, start, goal), [1, 0, 0])


def test_walls_stand_between_floor_and_ceiling(tmp_path):
    write_table(tmp_path / "walls.csv", ["x1", "y1", "x2", "y2"], [[0, 0, 5, 0], [5, 0, 5, 3], [2, 1, 2, 1]])
    mesh = extruded(load_walls(tmp_path / "walls.csv"), 2.5)
    assert len(mesh.faces) == 2 * (2 + 2)  # a wall of no length is none
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [5, 3, 2.5]])
    np.testing.assert_allclose(mesh.area, 2.5 * (5 + 3) + 2 * 5 * 3)


@pytest.mark.parametrize(
    ("content", "says"),
    [("x,z\n1,2\n", "has no column 'y'"), ("x1,y1,x2,y2\n1,2,3,\n", "empty cells"), ("x,y\n", "no rows")],
)
def test_what_is_wrong_is_said(tmp_path, content, says):
    (tmp_path / "walls.csv").write_text(content)
    with pytest.raises(UserError, match=says):
        load_walls(tmp_path / "walls.csv")
