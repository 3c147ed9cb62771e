"""Helpers of the account of the published sample, on a scene where the answers are plain."""

import dataclasses

import numpy as np
from synthetic import tiny_scene

from experiments.sample_account import by_group, in_sight, obstructed
from wbgs_jax.data import scene_dataset


def test_directions_and_groups():
    dataset = scene_dataset(tiny_scene(6))
    local = in_sight(dataset)
    np.testing.assert_allclose(np.linalg.norm(local, axis=-1), 1, atol=1e-6)
    groups = by_group(dataset, local[:, 2], {"score": np.arange(len(dataset), dtype=float)})
    assert sum(group["transmitters"] for group in groups.values() if group["transmitters"]) == 6


def test_a_triangle_in_between_obstructs():
    dataset = scene_dataset(tiny_scene(4))
    start = np.asarray(dataset.receiver().position, np.float64)
    wall = np.array([[1, -5, -5], [1, 5, -5], [1, 0, 8]]) + start
    walled = dataclasses.replace(dataset, vertices=wall.astype(np.float32), faces=np.array([[0, 1, 2]]), face_part=None)
    assert obstructed(walled, start + np.array([2.0, 0.1, 0.2]))
    assert not obstructed(walled, start + np.array([0.9, 0.1, 0.2]))
    assert not obstructed(walled, start + np.array([2.0, 30.0, 0.2]))
