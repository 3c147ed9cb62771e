"""The ceilings on paths whose answer is known, and the helpers around them. No simulator."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pytest

from data_gen import ceilings
from data_gen.picture import draw
from data_gen.scenes import get_scene
from wbgs_jax.radio.array import planar_array
from wbgs_jax.radio.channel import correlation


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


def measure(made, elements=None):
    values = ceilings.measure(made, planar_array() if elements is None else elements)
    return dict(zip(ceilings.NAMES, values.tolist(), strict=True))


def test_one_path_has_no_phase_to_lose(rng):
    assert measure(paths(rng, [1e-6], [0])) == pytest.approx(dict.fromkeys(ceilings.NAMES, 1.0), abs=1e-6)


def test_equal_paths_need_their_phases_and_every_order(rng):
    results = [measure(paths(rng, [1, 1, 1, 1], [0, 1, 2, 4])) for _ in range(5)]
    median = {name: np.median([result[name] for result in results]) for name in ceilings.NAMES}
    assert median["phase_blind"] < 0.95
    assert median["order<=0"] < median["order<=3"] < 1.0


def test_order_is_cumulative(rng):
    """More interactions explain more of most images; of one image they need not."""
    results = [measure(paths(rng, [1, 0.3, 0.1], [0, 2, 3])) for _ in range(9)]
    assert all(result["order<=0"] == result["order<=1"] < 1.0 == result["order<=3"] for result in results)
    median = {name: np.median([result[name] for result in results]) for name in ceilings.NAMES}
    assert median["order<=1"] < median["order<=2"] < 1.0


def test_images_are_those_of_the_array(rng):
    across = np.roll(planar_array(), 1, axis=1)  # in another plane, the same paths make another image
    differences = []
    for made in [paths(rng, [1, 0.5], [0, 1]) for _ in range(10)]:
        assert measure(made, across)["order<=1"] == 1.0
        differences.append(abs(measure(made, across)["order<=0"] - measure(made)["order<=0"]))
    assert np.median(differences) > 1e-3


def test_nothing_is_measured_without_a_path(rng):
    assert np.isnan(ceilings.measure(paths(rng, [], []), planar_array())).all()


def test_phase_blind_image_is_reproducible_and_ignores_phases_of_draws(rng):
    made = paths(rng, [1, 0.5], [0, 1])
    first, second = (ceilings.phase_blind_image(made, planar_array()) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert first.shape == (90, 360) and 0.5 < first.max() <= 1 + 1e-6


def test_correlation_ignores_a_common_phase(rng):
    y = rng.normal(size=(4, 16)) + 1j * rng.normal(size=(4, 16))
    np.testing.assert_allclose(correlation(jnp.asarray(y), jnp.asarray(3 * np.exp(0.7j) * y)), 1, atol=1e-6)
    assert (np.asarray(correlation(jnp.asarray(y), jnp.asarray(rng.permutation(y, axis=1)))) < 1).all()


def test_picture_is_written(tmp_path):
    draw(get_scene(1), tmp_path / "docs" / "scene1.png")
    image = pytest.importorskip("PIL.Image").open(tmp_path / "docs" / "scene1.png")
    assert image.format == "PNG" and image.width > 1000
