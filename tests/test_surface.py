"""Where Gaussians start."""

import numpy as np
import pytest
import trimesh

from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.surface import MESH_SIZED, make_surface, surface_from_points
from wbgs_jax.types import make_receiver


def room(with_faces=True, with_vertices=True, orientation=(1.0, 0.0, 0.0, 0.0)):
    box = trimesh.creation.box(extents=(8.0, 6.0, 3.0))
    box.apply_translation((0, 0, 1.5))
    return Dataset(
        name="room",
        receiver=make_receiver([-3.0, 0.5, 1.0], orientation),
        tx_positions=np.array([[1.0, 1.0, 1.0], [2.0, -1.0, 2.0]]),
        frequencies_hz=np.array([1e9, 1e9]),
        tx_index=np.arange(2),
        train=np.array([0]),
        test=np.array([1]),
        snapshots=np.ones((2, 16), np.complex64),
        images=None,
        vertices=np.asarray(box.vertices, np.float32) if with_vertices else np.zeros((0, 3), np.float32),
        faces=np.asarray(box.faces, np.int32) if with_faces else np.zeros((0, 3), np.int32),
    )


def on_the_box(points):
    offset = np.abs(np.abs(points - [0, 0, 1.5]) - [4, 3, 1.5])  # from the planes of the three pairs of walls
    return offset.min(-1) < 1e-4


@pytest.mark.parametrize("sampling", ["solid_angle", "area"])
def test_points_lie_on_the_surface_and_repeat_with_the_seed(sampling):
    surface = make_surface(room(), 500, 3, sampling)
    points = np.asarray(surface.points)
    assert points.shape == (500, 3) and on_the_box(points).all()
    np.testing.assert_array_equal(points, make_surface(room(), 500, 3, sampling).points)
    assert not np.array_equal(points, make_surface(room(), 500, 4, sampling).points)


def test_solid_angle_sampling_is_even_over_the_hemisphere():
    surface = make_surface(room(), 4000, 0, "solid_angle")
    offset = np.asarray(surface.points) - np.asarray([-3.0, 0.5, 1.0])
    cosine = offset[:, 2] / np.linalg.norm(offset, axis=1)
    assert (cosine > -0.11).all()
    # Directions even over the sphere have an even cosine of the zenith angle.
    counts, _ = np.histogram(cosine, bins=np.linspace(0, 1, 6))
    assert counts.min() > 0.8 * counts.mean() and counts.max() < 1.2 * counts.mean()
    by_area = np.asarray(make_surface(room(), 4000, 0, "area").points)
    assert (by_area[:, 2] < 0.5).mean() > 0.3


def test_the_horizon_is_that_of_the_receiver():
    face_down = (0.0, 1.0, 0.0, 0.0)  # half a turn about x: local +z points to the floor
    points = np.asarray(make_surface(room(orientation=face_down), 500, 0, "solid_angle").points)
    offset = points - np.asarray([-3.0, 0.5, 1.0])
    assert (offset[:, 2] / np.linalg.norm(offset, axis=1) < 0.11).all()


def test_clouds_and_nothing_at_all():
    cloud = make_surface(room(with_faces=False), 500, 0)
    assert len(cloud.points) == 8  # the cloud has no more
    nothing = np.asarray(make_surface(room(with_faces=False, with_vertices=False), 300, 0).points)
    assert nothing.shape == (300, 3)
    assert (nothing >= [-4.0, -2.0, 0.0]).all() and (nothing <= [3.0, 2.0, 3.0]).all()


def test_zero_means_the_size_of_the_mesh():
    assert len(make_surface(room(), 0, 0).points) == MESH_SIZED[0]


def test_spacing_is_the_mean_distance_to_three_neighbours():
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), [0.0], indexing="ij"), -1).reshape(-1, 3) * 0.5
    spacing = np.asarray(surface_from_points(grid).spacing)
    np.testing.assert_allclose(spacing[12], 0.5)  # the middle has four neighbours at 0.5 m
    np.testing.assert_allclose(spacing[0], (0.5 + 0.5 + 0.5 * np.sqrt(2)) / 3, rtol=1e-6)
