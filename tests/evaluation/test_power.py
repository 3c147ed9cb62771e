"""Received powers: errors in decibels against arithmetic, baselines against Friis and a search, links that nothing reaches."""

import dataclasses
import json

import numpy as np
import pytest
from builders.synthetic import tiny_dataset

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.evaluation.score import free_space, nearest_power, power_figures, score_power


def test_powers_are_scored_in_decibels():
    truth = np.array([-60.0, -70, -80, -90])
    frequencies = np.array([1e9, 94e9, 1e9, 1e9])
    report = score_power((truth + np.array([1, -7, 2, -6])).astype(np.float32), truth, frequencies)
    assert report == {
        "n": 4,
        "power_error_db": 4.0,
        "power_mae_db": 4.0,
        "per_frequency": [
            {"frequency_ghz": 1.0, "n": 3, "power_error_db": 2.0, "power_mae_db": 3.0},
            {"frequency_ghz": 94.0, "n": 1, "power_error_db": 7.0, "power_mae_db": 7.0},
        ],
    }
    assert json.loads(json.dumps(report, allow_nan=False)) == report


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_a_power_that_is_no_number_is_refused(value):
    with pytest.raises(UserError, match="1 of 3 predicted powers"):
        score_power(np.array([1, value, 2]), np.zeros(3), np.ones(3))
    with pytest.raises(UserError, match="no links"):
        score_power(np.zeros(0), np.zeros(0), np.zeros(0))


@pytest.fixture
def dataset(rng) -> Dataset:
    """Snapshots of random powers at two receivers."""
    found = tiny_dataset(n_rx=2)
    assert found.snapshots is not None
    scale = 10 ** rng.uniform(-5, -3, len(found))
    return found.with_observations(snapshots=(found.snapshots * scale[:, None]).astype(np.complex64))


def test_the_power_of_snapshots_is_the_mean_over_the_elements(dataset, rng):
    index = rng.permutation(len(dataset))[:7]
    expected = 10 * np.log10((np.abs(dataset.snapshots[index].astype(complex)) ** 2).mean(1))
    np.testing.assert_allclose(dataset.received_db(index), expected, atol=1e-4)
    assert tiny_dataset(kind="pas").received_db(index) is None
    powers = tiny_dataset(n_rx=2, kind="power")
    np.testing.assert_array_equal(powers.received_db(index), powers.power_db[index])


def test_free_space_loses_six_decibels_with_twice_the_distance(dataset):
    receivers = np.asarray(dataset.receivers.position)
    far = dataclasses.replace(
        dataset,
        tx_positions=receivers[dataset.receiver_index] + 2 * (dataset.tx_positions - receivers[dataset.receiver_index]),
        frequencies_hz=np.full(len(dataset), 1e9),
    )
    near = dataclasses.replace(dataset, frequencies_hz=far.frequencies_hz)
    index = np.arange(len(dataset))
    np.testing.assert_allclose(free_space(near, index) - free_space(far, index), 20 * np.log10(2), atol=1e-3)
    at_a_metre = dataclasses.replace(near, tx_positions=receivers[dataset.receiver_index] + [0, 0.6, 0.8])
    np.testing.assert_allclose(free_space(at_a_metre, index), -32.45, atol=0.01)  # 20 log10(MHz) - 27.55


def test_the_nearest_transmitter_lends_its_power(dataset):
    everything = dataset.received_db(np.arange(len(dataset)))
    for link, found in zip(dataset.test, nearest_power(dataset, dataset.test), strict=True):
        same = (dataset.frequencies_hz == dataset.frequencies_hz[link]) & (
            dataset.receiver_index == dataset.receiver_index[link]
        )
        candidates = [i for i in dataset.train if same[i]]
        distances = [np.linalg.norm(dataset.tx_positions[i] - dataset.tx_positions[link]) for i in candidates]
        assert found == everything[candidates[int(np.argmin(distances))]]


def test_links_that_nothing_reaches_are_left_out(dataset):
    silent = dataset.snapshots.copy()
    silent[dataset.test[0]] = silent[dataset.train[0]] = 0
    dataset = dataset.with_observations(snapshots=silent)
    truth = dataset.received_db(dataset.test)
    report = power_figures(truth + 1, dataset, dataset.test)
    assert report["n"] == len(dataset.test) - 1 and report["power_mae_db"] == pytest.approx(1, abs=1e-4)
    assert report["baselines"].keys() == {"free_space", "nearest_tx"}
    assert report["baselines"]["nearest_tx"]["power_mae_db"] < 60  # silence lends nothing
    assert power_figures(truth, tiny_dataset(kind="pas"), dataset.test) is None


def test_a_receiver_that_heard_nothing_spoils_no_other():
    """Neither are the nearest transmitters of the others silent, nor does silence count as a prediction."""
    dataset = tiny_dataset(12, n_rx=3, kind="power")
    powers = np.array(dataset.power_db)
    train = np.isin(np.arange(len(dataset)), dataset.train)
    powers[train & (dataset.receiver_index == 2)] = -250
    powers[np.flatnonzero(train & (dataset.receiver_index == 0))[::2]] = -250
    some = dataset.with_observations(power_db=powers)
    found = nearest_power(some, some.test)
    assert ((found == -250) == (some.receiver_index[some.test] == 2)).all()
    zeros = np.zeros(len(some.test), np.float32)
    assert power_figures(zeros, some, some.test)["baselines"].keys() == {"free_space"}
    heard = some.test[some.receiver_index[some.test] != 2]
    report = power_figures(zeros[: len(heard)], some, heard)
    assert report["baselines"]["nearest_tx"]["power_mae_db"] < 6
