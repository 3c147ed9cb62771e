"""Helpers of the account of the published sample, on a scene where the answers are plain."""

import numpy as np
from builders.synthetic import tiny_scene

from experiments.studies.sample_account import by_group, directions_to_tx
from wbgs_jax.data import scene_dataset


def test_directions_and_groups():
    dataset = scene_dataset(tiny_scene(6))
    local = directions_to_tx(dataset)
    np.testing.assert_allclose(np.linalg.norm(local, axis=-1), 1, atol=1e-6)
    groups = by_group(dataset, local[:, 2], {"score": np.arange(len(dataset), dtype=float)})
    assert sum(group["transmitters"] for group in groups.values() if group["transmitters"]) == 6
