"""Finely tessellated meshes: flat pieces lose nothing, curved ones little and by how much is said, objects stay apart."""

import warnings

import numpy as np
import pytest
import trimesh
from builders.rooms import box, mesh_of, rectangle

from wbgs_jax.mesh import simplification
from wbgs_jax.mesh.facets import areas, facets_from_mesh
from wbgs_jax.mesh.simplification import decimated, distance_from, distances, facets_that_fit, simplified, welded


def fine(part, times):
    part = part.copy()
    for _ in range(times):
        part = part.subdivide()
    return part


def turned(part, rng):
    """Flat pieces that lie along no axis, as single precision has them."""
    part = part.copy()
    part.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    return part


def corners_of(mesh):
    return np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]


def test_flat_pieces_lose_nothing(rng):
    """A box, and a sheet whose corners nothing but its border holds."""
    for part, least in ((box((0, 0, 0), (1, 2, 3)), 12), (rectangle((0, 0, 0), (4, 0, 0), (0, 0, 3)), 2)):
        mesh = mesh_of(turned(fine(part, 5), rng))
        small, what = simplified(mesh, 4 * least)
        assert what.triangles == len(mesh.faces) and what.left == len(small.faces) <= 4 * least
        assert what.largest_mm < 1e-3
        corners = corners_of(small)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1).sum() / 2
        np.testing.assert_allclose(area, part.area, rtol=1e-5)


@pytest.mark.heavy
@pytest.mark.parametrize("count", [2000, 300])
def test_a_sphere_is_off_as_its_sagitta(count):
    """Triangles of N per sphere have sides of sqrt(4 pi r^2 / N * 4 / sqrt(3)), whose chords stand off by side^2 / 8 r."""
    radius = 0.5
    ball = trimesh.creation.icosphere(5, radius)
    points, triangles = welded(np.asarray(ball.triangles), np.zeros(len(ball.faces), int))
    left, which = decimated(points, triangles, count)
    assert len(left) == len(which) <= count
    whole = trimesh.Trimesh(points, left, process=False)
    assert whole.is_watertight and whole.is_winding_consistent
    side = np.sqrt(4 * np.pi * radius**2 / count * 4 / np.sqrt(3))
    far = distances(np.asarray(ball.triangles), points[left], 0)
    assert np.quantile(far, 0.99) < 4 * side**2 / (8 * radius)
    away = np.linalg.norm(points[left].mean(1), axis=1)
    assert (np.sum(whole.face_normals * points[left].mean(1), 1) > 0.7 * away).all()  # nothing is turned over


def test_objects_and_materials_stay_apart(rng):
    """Two cubes that touch in a whole face, of two materials, among a fine sphere."""
    cubes = [fine(box((x, 0, 0), (x + 1, 1, 1)), 3) for x in (0, 1)]
    ball = trimesh.creation.icosphere(4, 0.4)
    ball.apply_translation((5, 0.5, 0.5))
    small, what = simplified(mesh_of(*cubes, ball), 200)
    assert what.left <= 200
    corners, part = corners_of(small), np.asarray(small.part)
    np.testing.assert_array_equal(np.asarray(small.material), part)
    for k, (low, high) in enumerate((((0, 0, 0), (1, 1, 1)), ((1, 0, 0), (2, 1, 1)))):
        own = corners[part == k].reshape(-1, 3)
        np.testing.assert_allclose([own.min(0), own.max(0)], [low, high], atol=1e-6)
    assert len(facets_from_mesh(small).offset) >= 12 + 50


def test_nothing_is_pinched():
    """A thin tube keeps its hole as long as there are enough triangles for one."""
    tube = trimesh.creation.annulus(0.05, 0.06, 1.0, sections=64)
    points, triangles = welded(np.asarray(fine(tube, 1).triangles), np.zeros(4 * len(tube.faces), int))
    left, _ = decimated(points, triangles, 60)
    whole = trimesh.Trimesh(points, left, process=False)
    assert whole.is_watertight and whole.euler_number == tube.euler_number == 0


def test_distances_are_those_of_parallel_planes(rng):
    height = rng.uniform(0.01, 1)
    low, high = (np.asarray(rectangle((0, 0, z), (2, 0, 0), (0, 3, 0)).triangles) for z in (0, height))
    np.testing.assert_allclose(distances(low, high, 0), height, rtol=1e-12)


def test_distances_are_those_of_trimesh(rng):
    near, far = rng.normal(size=(20, 3, 3)), rng.normal(size=(30, 3, 3))
    mesh = trimesh.Trimesh(far.reshape(-1, 3), np.arange(90).reshape(-1, 3), process=False)
    points = near.reshape(-1, 3)
    expected = [
        np.linalg.norm(trimesh.triangles.closest_point(mesh.triangles, np.tile(p, (30, 1))) - p, axis=1).min() for p in points
    ]
    np.testing.assert_allclose([distance_from(p, far) for p in points], expected, atol=1e-12)


def test_what_fits_is_not_simplified():
    """Left out is the smallest of three boxes, less than a fiftieth of the surface."""
    parts = [box((0, 0, 0), (3, 2, 3)), box((5, 0, 0), (8, 2, 3)), box((9, 0, 0), (9.1, 0.1, 0.1))]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = facets_that_fit(mesh_of(*parts), 12)
    assert areas(found).min() >= 6


def test_of_many_facets_those_are_kept_that_make_up_the_surface(monkeypatch):
    """A city of equal blocks, and gravel: no fewer than cost little, no more than count."""
    monkeypatch.setattr(simplification, "FEW", 10)
    blocks = [box((5 * i, 0, 0), (5 * i + 3, 2, 3)) for i in range(4)]
    gravel = [box((5 * i + 4, 0, 0), (5 * i + 4.1, 0.1, 0.1)) for i in range(4)]
    for parts, most, expected in (([*blocks, *gravel], 100, 24), ([blocks[0], *gravel], 100, 10), ([*blocks, *gravel], 23, 23)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert len(facets_that_fit(mesh_of(*parts), most).offset) == expected


@pytest.mark.heavy
def test_a_curved_mesh_keeps_its_surface():
    """The largest triangles of a ball would be half of it."""
    ball = trimesh.creation.icosphere(4, 1.0)
    with pytest.warns(UserWarning, match="of 5,120 triangles was simplified to .* mm in the median"):
        found = facets_that_fit(mesh_of(ball), 400)
    assert 200 < len(found.offset) <= 400
    assert areas(found).sum() == pytest.approx(ball.area, rel=0.05)


@pytest.mark.slow
def test_a_million_triangles(rng):
    room = fine(box((0, 0, 0), (8, 6, 3)), 6)
    balls = [trimesh.creation.icosphere(7, 0.3) for _ in range(3)]
    for k, ball in enumerate(balls):
        ball.apply_translation((2 + 2 * k, 3, 1))
    mesh = mesh_of(room, *balls)
    assert len(mesh.faces) > 1e6
    with pytest.warns(UserWarning, match="was simplified"):
        found = facets_that_fit(mesh, 3000)
    on_walls = np.asarray(found.body) == found.body[0]
    np.testing.assert_allclose(areas(found)[on_walls].sum(), 180, rtol=1e-5)
    assert 6 <= on_walls.sum() < 100
    np.testing.assert_allclose(areas(found)[~on_walls].sum(), 3 * 4 * np.pi * 0.09, rtol=0.02)
