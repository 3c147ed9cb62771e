"""Where Gaussians start."""

import dataclasses

import numpy as np
import pytest
import trimesh
from builders.synthetic import RECEIVERS, ROOM, tiny_dataset

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import Dataset, Materials, select_receivers
from wbgs_jax.data.scene import MESH_SIZED, DatasetScene, make_mesh, make_surface, surface_from_points
from wbgs_jax.types import Scene, make_receiver, stack_receivers

RX = (-3.0, 0.5, 1.0)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
FACE_DOWN = (0.0, 1.0, 0.0, 0.0)
"""Half a turn about x: local +z points to the floor."""


def room(with_faces=True, with_vertices=True, receivers=((RX, UPRIGHT),), **known):
    box = trimesh.creation.box(extents=(8.0, 6.0, 3.0))
    box.apply_translation((0, 0, 1.5))
    return Dataset(
        name="room",
        receivers=stack_receivers([make_receiver(*place) for place in receivers]),
        tx_positions=np.array([[1.0, 1.0, 1.0], [2.0, -1.0, 2.0]]),
        frequencies_hz=np.array([1e9, 1e9]),
        receiver_index=np.zeros(2, int),
        tx_index=np.arange(2),
        train=np.array([0]),
        validation=np.zeros(0, int),
        test=np.array([1]),
        observations={"snapshots": np.ones((2, 16), np.complex64)},
        **known,
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
    points = np.asarray(make_surface(room(receivers=[(RX, FACE_DOWN)]), 500, 0, "solid_angle").points)
    offset = points - np.asarray([-3.0, 0.5, 1.0])
    assert (offset[:, 2] / np.linalg.norm(offset, axis=1) < 0.11).all()


def test_several_receivers_share_the_points():
    """One that looks up and one that looks down: half of the points each, and each half as it would be alone."""
    below = (1.0, -1.0, 2.0)
    points = np.asarray(make_surface(room(receivers=[(RX, UPRIGHT), (below, FACE_DOWN)]), 4000, 0).points)
    up = np.asarray(make_surface(room(), 4000, 1).points)
    down = np.asarray(make_surface(room(receivers=[(below, FACE_DOWN)]), 4000, 2).points)
    bins = [np.linspace(-4, 4, 5), np.linspace(-3, 3, 4), np.linspace(0, 3, 4)]
    both, alone_up, alone_down = (np.histogramdd(p, bins)[0] for p in (points, up, down))
    np.testing.assert_allclose(both, (alone_up + alone_down) / 2, atol=6 * np.sqrt(both.max()))
    assert abs(alone_up - alone_down).max() > 12 * np.sqrt(both.max())
    swapped = room(receivers=[(below, FACE_DOWN), (RX, UPRIGHT)])
    np.testing.assert_array_equal(points, make_surface(swapped, 4000, 0).points)


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


def test_a_data_set_is_a_scene():
    dataset = tiny_dataset(n_rx=3)
    scene: Scene = DatasetScene(dataset)
    assert scene.receivers is dataset.receivers
    np.testing.assert_array_equal(scene.box, np.float32(ROOM))
    np.testing.assert_array_equal(scene.surface(50, 2, "area").points, make_surface(dataset, 50, 2, "area").points)
    mesh = scene.mesh()
    assert mesh.part.tolist() == mesh.material.tolist() == [0] * len(dataset.faces)
    np.testing.assert_allclose(mesh.thickness, [0.1])


def test_the_box_holds_surfaces_transmitters_and_receivers():
    bare = room(with_faces=False, with_vertices=False, receivers=[(RX, UPRIGHT), ((0.0, 5.0, 0.5), UPRIGHT)])
    np.testing.assert_array_equal(DatasetScene(bare).box, [[-3, -1, 0.5], [2, 5, 2]])
    np.testing.assert_array_equal(DatasetScene(room()).box, [[-4, -3, 0], [4, 3, 3]])
    outside = room(receivers=[((-3.0, 0.5, 9.0), UPRIGHT)])
    np.testing.assert_array_equal(DatasetScene(outside).box, [[-4, -3, 0], [4, 3, 9]])
    one = select_receivers(tiny_dataset(n_rx=3), [1])
    assert len(DatasetScene(one).receivers.position) == 1
    np.testing.assert_array_equal(DatasetScene(one).receivers.position, np.float32(RECEIVERS[1:2]))


def test_parts_and_materials_of_a_mesh():
    part = np.arange(12, dtype=np.int32) // 2
    materials = Materials(np.int32(part > 2), ("wood 0.03", "glass 0.008"), np.array([0.03, 0.008]))
    mesh = make_mesh(room(face_part=part, materials=materials))
    np.testing.assert_array_equal(mesh.part, part)
    np.testing.assert_array_equal(mesh.material, part > 2)
    np.testing.assert_allclose(mesh.thickness, [0.03, 0.008])
    unknown = make_mesh(room())
    assert not np.asarray(unknown.part).any() and not np.asarray(unknown.material).any()
    assert unknown.thickness.tolist() == [0]


@pytest.mark.parametrize("vertices", [True, False])
def test_points_are_no_mesh(vertices):
    with pytest.raises(UserError, match=r"room has no mesh.*give a scene with a mesh") as error:
        make_mesh(room(with_faces=False, with_vertices=vertices))
    assert "\n" not in str(error.value)
    what, _, advice = str(error.value).partition("; ")  # the hybrid field passes on the first part alone
    assert ("only points" in what) == vertices and "choose a field" in advice


def test_too_few_points_and_unknown_samplings_are_refused():
    for count in (-1, 3):
        with pytest.raises(ValueError, match=f"count is {count}; give at least 4, or 0"):
            make_surface(room(), count, 0)
    with pytest.raises(ValueError, match=r"points has shape \(3, 3\); expected \(n, 3\) with n at least 4"):
        surface_from_points(np.eye(3))


def test_a_cloud_of_too_few_points_counts_as_none():
    few = room(with_faces=False)
    few = dataclasses.replace(few, vertices=few.vertices[:3])
    surface = make_surface(few, 50, 0)
    assert surface.points.shape == (50, 3) and np.isfinite(surface.spacing).all()
