"""Splits never cut through a transmitter."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.splits import group_transmitters, select_frequencies, tx_disjoint_split
from wbgs_jax.errors import UserError
from wbgs_jax.types import make_receiver


@pytest.fixture
def dataset():
    """Five transmitters at 1, 2.4 and 24.25 GHz; the first four train."""
    n_tx, ghz = 5, [1.0, 2.4, 24.25]
    tx_index = np.repeat(np.arange(n_tx), len(ghz))
    return Dataset(
        name="five",
        receiver=make_receiver((0, 0, 0)),
        tx_positions=np.repeat(np.eye(n_tx, 3), len(ghz), 0) + tx_index[:, None],
        frequencies_hz=np.tile(np.array(ghz) * 1e9, n_tx),
        tx_index=tx_index,
        train=np.flatnonzero(tx_index < 4),
        test=np.flatnonzero(tx_index == 4),
        snapshots=np.zeros((15, 16), np.complex64),
        images=None,
        vertices=np.zeros((0, 3), np.float32),
        faces=np.zeros((0, 3), np.int32),
    )


@settings(deadline=None)
@given(
    tx_index=st.lists(st.integers(0, 30), min_size=2, max_size=200).filter(lambda values: len(set(values)) > 1),
    fraction=st.floats(0.001, 0.999),
    seed=st.integers(0, 2**32),
)
def test_a_split_is_a_partition_by_transmitter(tx_index, fraction, seed):
    tx_index = np.array(tx_index)
    train, test = tx_disjoint_split(tx_index, fraction, seed)
    np.testing.assert_array_equal(np.sort(np.concatenate([train, test])), np.arange(len(tx_index)))
    assert not set(tx_index[train]) & set(tx_index[test])
    n_tx = len(set(tx_index.tolist()))
    assert len(set(tx_index[test])) == np.clip(round(fraction * n_tx), 1, n_tx - 1)


def test_the_seed_decides():
    tx_index = np.repeat(np.arange(100), 3)
    draws = [tx_disjoint_split(tx_index, 0.2, seed)[1].tolist() for seed in (0, 0, 1)]
    assert draws[0] == draws[1] != draws[2]


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.1, 2.0, float("nan")])
def test_a_fraction_outside_0_and_1(fraction):
    with pytest.raises(UserError, match="fraction"):
        tx_disjoint_split(np.arange(10), fraction, 0)


def test_one_transmitter_cannot_be_split():
    with pytest.raises(UserError, match="two TX"):
        tx_disjoint_split(np.zeros(10, int), 0.2, 0)


def test_transmitters_are_numbered_by_first_appearance():
    positions = np.array([[5.0, 0, 0], [1, 2, 3], [5 + 1e-9, 0, 0], [-1, 0, 0], [1, 2, 3]])
    assert group_transmitters(positions).tolist() == [0, 1, 0, 2, 1]


def test_plus_and_minus_zero_are_one_place():
    assert group_transmitters(np.array([[0.0, 0, 0], [-0.0, 0, 0], [-1e-9, 0, 0]])).tolist() == [0, 0, 0]


def test_frequencies_restrict_training_and_test_apart(dataset):
    chosen = select_frequencies(dataset, train_ghz=[1.0, 24.25], test_ghz=[2.4])
    assert set(chosen.frequencies_hz[chosen.train] / 1e9) == {1, 24.25}
    assert set(chosen.frequencies_hz[chosen.test] / 1e9) == {2.4}
    assert set(chosen.tx_index[chosen.train]) == {0, 1, 2, 3}
    assert set(chosen.tx_index[chosen.test]) == {4}
    assert len(chosen) == len(dataset)


def test_none_keeps_all_frequencies(dataset):
    chosen = select_frequencies(dataset, test_ghz=[1.0])
    np.testing.assert_array_equal(chosen.train, dataset.train)
    assert len(chosen.test) == 1


@pytest.mark.parametrize("role", ["train_ghz", "test_ghz"])
def test_an_unknown_frequency_names_those_that_exist(dataset, role):
    with pytest.raises(UserError, match=r"five has no spectra at 5 GHz.*1, 2\.4, 24\.25 GHz"):
        select_frequencies(dataset, **{role: [1.0, 5.0]})


def test_an_empty_selection(dataset):
    with pytest.raises(UserError, match="leave no test spectrum"):
        select_frequencies(dataset, test_ghz=[])
