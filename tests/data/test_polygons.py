"""Polygons become triangles: of the same area, in the same plane, whichever corner comes first."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wbgs_jax.mesh.bodies import triangulate

L_SHAPE = [(0, 0), (6, 0), (6, 2), (2, 2), (2, 5), (0, 5)]
COMB = [
    (0, 0),
    (7, 0),
    (7, 3),
    (6, 3),
    (6, 1),
    (5, 1),
    (5, 3),
    (4, 3),
    (4, 1),
    (3, 1),
    (3, 3),
    (2, 3),
    (2, 1),
    (1, 1),
    (1, 3),
    (0, 3),
]
SPIRAL = [(0, 0), (5, 0), (5, 5), (1, 5), (1, 2), (3, 2), (3, 3), (2, 3), (2, 4), (4, 4), (4, 1), (0, 1)]
HOLE = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]
"""A square with a square hole, joined by a bridge."""
LINE = [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)]
"""With corners that are none."""


def shoelace(corners):
    x, y = np.array(corners, float).T
    return (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


@pytest.mark.parametrize("corners", [L_SHAPE, COMB, SPIRAL, HOLE, LINE], ids=["L", "comb", "spiral", "hole", "line"])
@pytest.mark.parametrize("backwards", [False, True])
def test_any_polygon_in_any_plane_from_any_corner(corners, backwards, rng):
    """Areas are those of the polygon, never more; normals point its way; no triangle reaches outside."""
    corners = corners[::-1] if backwards else corners
    turn = Rotation.random(random_state=rng)
    for first in range(len(corners)):
        own = corners[first:] + corners[:first]
        points = turn.apply(np.column_stack([np.array(own, float), np.zeros(len(own))])) + rng.normal(size=3)
        faces = triangulate(points, np.arange(len(own)), np.array([len(own)]))
        assert faces.shape == (len(own) - 2, 3)
        a, b, c = np.moveaxis(points[faces], 1, 0)
        normal = np.cross(b - a, c - a)
        assert np.linalg.norm(normal, axis=1).sum() / 2 == pytest.approx(abs(shoelace(own)))
        up = turn.apply([0, 0, np.sign(shoelace(own))])
        assert (normal @ up > -1e-9).all()
        assert set(faces.ravel()) <= set(range(len(own)))


def test_polygons_of_all_sizes_keep_their_order(rng):
    points = np.column_stack([rng.normal(size=(4, 2)), np.zeros(4)])
    square = np.array([[0, 0, 1.0], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    dart = np.array([[0, 0, 2.0], [2, 0, 2], [0.5, 0.5, 2], [0, 2, 2]])
    vertices = np.concatenate([points, square, dart])
    corners, sizes = np.array([0, 1, 2, 4, 5, 6, 7, 0, 1, 8, 9, 10, 11]), np.array([3, 4, 2, 4])
    faces = triangulate(vertices, corners, sizes)
    np.testing.assert_array_equal(faces[:3], [[0, 1, 2], [4, 5, 6], [4, 6, 7]])
    a, b, c = np.moveaxis(vertices[faces[3:]], 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(1.0)


def test_a_polygon_that_crosses_itself_or_has_no_area_is_cut_somehow():
    for corners in ([(0, 0), (2, 2), (2, 0), (0, 2)], [(0, 0), (1, 1), (2, 2), (3, 3), (1, 1)], [(0, 0)] * 5):
        points = np.column_stack([np.array(corners, float), np.zeros(len(corners))])
        assert len(triangulate(points, np.arange(len(corners)), np.array([len(corners)]))) == len(corners) - 2


def test_no_polygon_and_corners_that_do_not_exist():
    nothing = triangulate(np.zeros((0, 3)), np.zeros(0, int), np.zeros(0, int))
    assert nothing.shape == (0, 3)
    assert triangulate(np.zeros((3, 3)), np.array([0, 1, 9, 2]), np.array([4])).max() == 9  # for the caller to refuse
