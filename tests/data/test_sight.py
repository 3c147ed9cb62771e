"""Lines of sight against plain cases and another search of trimesh's."""

import dataclasses

import numpy as np
import pytest
import trimesh
from builders.synthetic import RX, tiny_dataset

from wbgs_jax.data import scene
from wbgs_jax.data.scene import in_sight


def with_mesh(mesh, tx):
    dataset = tiny_dataset(len(tx))
    positions = np.asarray(tx)[dataset.tx_index]
    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
    return dataclasses.replace(dataset, tx_positions=positions, vertices=vertices, faces=faces, face_part=None, materials=None)


def of_transmitters(dataset):
    """One value a transmitter, which all of its links share."""
    seen = in_sight(dataset, np.arange(len(dataset)))
    first = np.unique(dataset.tx_index, return_index=True)[1]
    np.testing.assert_array_equal(seen, seen[first][dataset.tx_index])
    return seen[first]


def test_a_triangle_in_between_obstructs():
    wall = trimesh.Trimesh(np.array([[1, -5, -5], [1, 5, -5], [1, 0, 8]]) + RX, [[0, 1, 2]])
    tx = np.array([[2.0, 0.1, 0.2], [0.9, 0.1, 0.2], [2.0, 30.0, 0.2]]) + RX
    np.testing.assert_array_equal(of_transmitters(with_mesh(wall, tx)), [False, True, True])


def test_triangles_far_from_a_line_need_no_look(rng):
    """Against all of them, line by line."""
    triangles = rng.uniform(-2, 2, (80, 1, 3)) + rng.uniform(-0.5, 0.5, (80, 3, 3)) + RX
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(240).reshape(-1, 3), process=False)
    dataset = with_mesh(mesh, rng.uniform(-2, 2, (200, 3)) + RX)
    corners = dataset.vertices[dataset.faces].astype(float)
    normals = trimesh.unitize(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    start = np.asarray(dataset.receivers.position, float)[0]
    ends = dataset.tx_positions[np.unique(dataset.tx_index, return_index=True)[1]]
    expected = [not scene._obstructed(np.stack([start, end]), corners, normals) for end in ends]
    assert 0 < sum(expected) < 200
    np.testing.assert_array_equal(of_transmitters(dataset), expected)


def test_it_agrees_with_trimeshs_search(rng):
    pytest.importorskip("rtree")
    centres = rng.uniform(-2, 2, (60, 3))
    centres = centres[np.abs(centres - RX).max(1) > 0.4][:12]  # a receiver within a box sees nothing at all
    boxes = [trimesh.creation.box((0.5, 0.4, 0.6), trimesh.transformations.translation_matrix(p)) for p in centres]
    mesh = trimesh.util.concatenate(boxes)
    mesh.vertices = np.asarray(mesh.vertices, np.float32)
    tx = rng.uniform(-2.5, 2.5, (60, 3))
    tx = tx[~np.any([box.contains(tx) for box in boxes], 0) & (np.linalg.norm(tx - RX, axis=-1) > 0.1)]
    dataset = with_mesh(mesh, tx)
    start = np.asarray(dataset.receivers.position, float)[0]
    offset = tx - start
    distance = np.linalg.norm(offset, axis=-1)
    places, ray, _ = mesh.ray.intersects_location(np.broadcast_to(start, tx.shape), offset / distance[:, None])
    along = np.linalg.norm(places - start, axis=-1)
    blocked = np.zeros(len(tx), bool)
    blocked[ray[(along > 1e-3) & (along < distance[ray] - 1e-3)]] = True
    np.testing.assert_array_equal(of_transmitters(dataset), ~blocked)
    assert 0 < blocked.sum() < len(tx)


def test_what_an_antenna_is_mounted_on_does_not_hide_it():
    floor = trimesh.Trimesh([[-9, -9, 0], [9, -9, 0], [0, 9, 0]], [[0, 1, 2]])
    tx = np.array([[0.5, 0.2, 0.0], [0.5, 0.2, 1e-4], [0.5, 0.2, -0.1]])
    np.testing.assert_array_equal(of_transmitters(with_mesh(floor, tx)), [True, True, RX[2] < 0])


def test_points_without_faces_do_not_tell():
    points = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.zeros((0, 3), int), process=False)
    assert in_sight(with_mesh(points, np.ones((2, 3))), np.arange(3)) is None
