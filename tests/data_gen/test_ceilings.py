"""The ceilings on paths whose answer is known, and the helpers around them. No simulator."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from data_gen import ceilings
from data_gen.convergence import correlation
from data_gen.picture import draw
from data_gen.scenes import get_scene
from wbgs_jax.array import planar_array


@dataclass
class Paths:
    """What the ceilings read of `data_gen.solve.TxPaths`."""

    coefficients: np.ndarray
    delays: np.ndarray
    order: np.ndarray


def paths(rng, amplitudes, order):
    k = rng.normal(size=(len(order), 3))
    k /= np.linalg.norm(k, axis=1, keepdims=True)
    waves = np.exp(2j * np.pi * (k @ planar_array().T + rng.random((len(order), 1))))
    return Paths(np.array(amplitudes)[:, None] * waves, np.arange(len(order)) * 1e-9, np.array(order))


def measure(made):
    simulator = SimpleNamespace(settings=SimpleNamespace(tx_per_call=2), paths=lambda tx: [made[int(i)] for i in tx[:, 0]])
    return ceilings.measure(simulator, np.arange(len(made))[:, None] * [1.0, 0, 0])


def test_one_path_has_no_phase_to_lose(rng):
    result = measure([paths(rng, [1e-6], [0]) for _ in range(3)])
    assert result == {"order<=0": 1.0, "order<=1": 1.0, "order<=2": 1.0, "order<=3": 1.0, "phase_blind": 1.0}


def test_equal_paths_need_their_phases_and_every_order(rng):
    result = measure([paths(rng, [1, 1, 1, 1], [0, 1, 2, 4]) for _ in range(5)])
    assert result["phase_blind"] < 0.95
    assert result["order<=0"] < result["order<=3"] < 1.0


def test_order_is_cumulative(rng):
    result = measure([paths(rng, [1, 0.3, 0.1], [0, 2, 3]) for _ in range(3)])
    assert result["order<=0"] == result["order<=1"] < result["order<=2"] < result["order<=3"] == 1.0


def test_phase_blind_image_is_reproducible_and_ignores_phases_of_draws(rng):
    made = paths(rng, [1, 0.5], [0, 1])
    first, second = ceilings.phase_blind_image(made), ceilings.phase_blind_image(made)
    np.testing.assert_array_equal(first, second)
    assert first.shape == (90, 360) and 0.5 < first.max() <= 1 + 1e-6


def test_correlation_ignores_a_common_phase(rng):
    y = rng.normal(size=(4, 16)) + 1j * rng.normal(size=(4, 16))
    np.testing.assert_allclose(correlation(y, 3 * np.exp(0.7j) * y), 1)
    assert (correlation(y, rng.permutation(y, axis=1)) < 1).all()


def test_picture_is_written(tmp_path):
    draw(get_scene(1), tmp_path / "docs" / "scene1.png")
    image = pytest.importorskip("PIL.Image").open(tmp_path / "docs" / "scene1.png")
    assert image.format == "PNG" and image.width > 1000
