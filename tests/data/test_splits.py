"""Splits never cut through a transmitter."""

import dataclasses
import warnings

import numpy as np
import pytest
from builders.synthetic import FREQUENCIES_HZ, RECEIVERS, tiny_dataset, tiny_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from wbgs_jax._util.errors import UserError
from wbgs_jax.data import scene_dataset
from wbgs_jax.data.dataset import (
    Dataset,
    fewer_transmitters,
    group_places,
    group_transmitters,
    hold_out_box,
    hold_out_validation,
    note_shared_transmitters,
    places_of,
    select_frequencies,
    select_receivers,
    tx_disjoint_split,
    unseen_frequencies,
    without_test,
)
from wbgs_jax.training.cross_validation import is_few
from wbgs_jax.training.fit_kriging import spacing
from wbgs_jax.types import make_receiver, stack_receivers


@pytest.fixture
def dataset():
    """Five transmitters at 1, 2.4 and 24.25 GHz; the first four train."""
    n_tx, ghz = 5, [1.0, 2.4, 24.25]
    tx_index = np.repeat(np.arange(n_tx), len(ghz))
    return Dataset(
        name="five",
        receivers=stack_receivers([make_receiver((0, 0, 0))]),
        tx_positions=np.repeat(np.eye(n_tx, 3), len(ghz), 0) + tx_index[:, None],
        frequencies_hz=np.tile(np.array(ghz) * 1e9, n_tx),
        receiver_index=np.zeros(len(tx_index), int),
        tx_index=tx_index,
        train=np.flatnonzero(tx_index < 4),
        validation=np.zeros(0, int),
        test=np.flatnonzero(tx_index == 4),
        observations={"snapshots": np.zeros((15, 16), np.complex64)},
    )


@pytest.fixture(scope="module", params=["snapshot", "pas", "power"])
def three(request):
    """A data set of each kind: six transmitters, three receivers, three frequencies; a third of the transmitters test."""
    return tiny_dataset(n_rx=3, kind=request.param)


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


def test_the_test_part_is_that_of_the_first_release():
    """Splits are drawn, not stored: runs of older versions must keep theirs."""
    train, test = tx_disjoint_split(np.repeat(np.arange(10), 2), 0.3, 7)
    assert test.tolist() == [0, 1, 14, 15, 16, 17]
    assert train.tolist() == np.setdiff1d(np.arange(20), test).tolist()


# Validation


@pytest.mark.parametrize("fraction", [0.01, 0.3, 0.5, 0.99])
def test_whole_transmitters_move_to_the_validation(three, fraction):
    held = hold_out_validation(three, fraction)
    np.testing.assert_array_equal(held.test, three.test)
    np.testing.assert_array_equal(np.sort(np.concatenate([held.train, held.validation])), three.train)
    assert not set(held.tx_index[held.train]) & set(held.tx_index[held.validation])
    assert len(set(held.tx_index[held.validation])) == np.clip(round(4 * fraction), 1, 3)
    assert len(held.validation) == 9 * len(set(held.tx_index[held.validation]))  # all receivers, all frequencies
    assert (held.name, len(held)) == (three.name, len(three))


def test_the_validation_depends_on_the_split_alone(dataset):
    """Equal splits, whatever else of the data differs; other splits draw anew."""
    held = hold_out_validation(dataset, 0.25)
    louder = dataset.with_observations(snapshots=2 * dataset.snapshots)
    np.testing.assert_array_equal(hold_out_validation(louder, 0.25).validation, held.validation)
    once_more = hold_out_validation(held, 0.25)
    np.testing.assert_array_equal(once_more.validation, held.validation)  # data that name a part keep it
    many = tiny_dataset(60)
    other = dataclasses.replace(many, train=many.train[: len(many.train) // 2])
    places = [np.searchsorted(d.train, hold_out_validation(d).validation) for d in (many, other)]
    assert len(places[0]) > len(places[1]) and places[0][: len(places[1])].tolist() != places[1].tolist()


def test_a_training_sees_no_test(three):
    """Links that are gone cannot be looked at; the others are what they were."""
    held = hold_out_validation(three, 0.3)
    seen = without_test(held)
    kept = np.sort(np.concatenate([held.train, held.validation]))
    assert len(seen) == len(kept) and len(seen.test) == 0 and seen.name == held.name
    np.testing.assert_array_equal(kept[seen.train], held.train)
    np.testing.assert_array_equal(kept[seen.validation], held.validation)
    np.testing.assert_array_equal(seen.tx_positions, held.tx_positions[kept])
    np.testing.assert_array_equal(seen.receiver_index, held.receiver_index[kept])
    (found,), (values,) = seen.observations.values(), held.observations.values()
    np.testing.assert_array_equal(found, values[kept])
    assert sorted(set(seen.tx_index)) == list(range(seen.tx_index.max() + 1))


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.1, float("nan")])
def test_a_validation_fraction_outside_0_and_1(dataset, fraction):
    with pytest.raises(UserError, match="validation fraction"):
        hold_out_validation(dataset, fraction)


@pytest.mark.parametrize(
    ("count", "fraction", "moved"),
    [(1, 0.1, 0), (1, 0.5, 0), (2, 0.1, 0), (3, 0.1, 0), (3, 0.3, 0), (4, 0.1, 1), (2, 0.5, 1), (3, 0.7, 2)],
)
def test_of_few_training_transmitters_all_stay_unless_more_are_wanted(count, fraction, moved):
    few = fewer_transmitters(tiny_dataset(8), count, 0)
    held = hold_out_validation(few, fraction)
    assert len(np.unique(held.tx_index[held.validation])) == moved
    assert len(held.train) + len(held.validation) == len(few.train)


def test_validation_keeps_the_training_frequencies(dataset):
    held = hold_out_validation(dataset, 0.25)
    chosen = unseen_frequencies(held, [1.0, 24.25])
    assert set(chosen.frequencies_hz[chosen.validation] / 1e9) == {1, 24.25}
    assert set(chosen.frequencies_hz[chosen.test] / 1e9) == {2.4}
    assert set(chosen.tx_index[chosen.validation]) == set(held.tx_index[held.validation])


# Whole rooms


def test_a_box_tests_all_that_is_in_it_and_trains_nothing_of_it(three):
    held = hold_out_validation(three, 0.3)
    places = np.sort(held.tx_positions[:, 0])
    low, high = [(places[0] + places[1]) / 2 - 1, -99, -99], [np.median(places), 99, 99]
    split = hold_out_box(held, low, high)
    inside = (held.tx_positions[:, 0] >= low[0]) & (held.tx_positions[:, 0] <= high[0])
    np.testing.assert_array_equal(split.test, np.flatnonzero(inside))
    for part in ("train", "validation"):
        before, after = getattr(held, part), getattr(split, part)
        np.testing.assert_array_equal(after, before[~inside[before]])
    assert not set(split.tx_index[split.train]) & set(split.tx_index[split.test]) and split.name.startswith("box_box")


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ((0, 0, 0), (1, -1, 1), "is empty"),
        ((90, 90, 90), (91, 91, 91), "no transmitter of five"),
        ((-99, -99, -99), (99, 99, 99), "every training transmitter of five"),
    ],
)
def test_a_box_of_nothing_or_everything(dataset, low, high, message):
    with pytest.raises(UserError, match=message):
        hold_out_box(dataset, low, high)


# Receivers


def test_other_selections_know_several_receivers(three):
    few = fewer_transmitters(three, 2, 0)
    assert len(few.train) == 2 * 3 * 3 and len(set(few.tx_index[few.train])) == 2
    chosen = select_frequencies(three, [1.0], [10.0, 94.0])
    assert (len(chosen.train), len(chosen.test)) == (4 * 3, 2 * 3 * 2)


def test_receivers_are_chosen_and_numbered_in_order(three):
    held = hold_out_validation(three, 0.3)
    chosen = select_receivers(held, [2, 0])
    assert len(chosen) == 36 and chosen.n_receivers == 2 and chosen.name == "box_rx2-0"
    np.testing.assert_array_equal(chosen.receivers.position, np.float32(RECEIVERS[[2, 0]]))
    np.testing.assert_array_equal(chosen.vertices, three.vertices)
    before = np.flatnonzero(three.receiver_index != 1)
    np.testing.assert_array_equal(np.array([2, 0])[chosen.receiver_index], three.receiver_index[before])
    for key in ("tx_positions", "frequencies_hz", "tx_index"):
        np.testing.assert_array_equal(getattr(chosen, key), getattr(three, key)[before])
    (found,), (values,) = chosen.observations.values(), three.observations.values()
    np.testing.assert_array_equal(found, values[before])
    for part in ("train", "validation", "test"):
        np.testing.assert_array_equal(before[getattr(chosen, part)], np.intersect1d(before, getattr(held, part)))


def test_transmitters_that_no_chosen_receiver_hears_are_gone():
    full = tiny_dataset(n_rx=3, kind="power")
    scarce = np.flatnonzero((full.receiver_index == 0) | ~np.isin(full.tx_index, [1, 2]))
    heard = select_receivers(dataclasses.replace(
        full, receiver_index=full.receiver_index[scarce], tx_index=full.tx_index[scarce],
        observations={"power_db": full.power_db[scarce]},
        tx_positions=full.tx_positions[scarce], frequencies_hz=full.frequencies_hz[scarce],
        train=np.arange(len(scarce) - 1), test=np.array([len(scarce) - 1]),
    ), [1])  # fmt: skip
    assert heard.tx_index.tolist() == np.repeat([0, 1, 2, 3], len(FREQUENCIES_HZ)).tolist()


@pytest.mark.parametrize("which", [[], [3], [-1], [0, 0]])
def test_receivers_that_are_not_there(three, which):
    with pytest.raises(UserError, match="box has receivers 0 to 2; choose each once"):
        select_receivers(three, which)


def test_repeated_positions_with_jitter_are_noted(rng):
    places = rng.uniform(0, 6, (40, 3))
    repeated = np.repeat(places, 10, 0) + rng.normal(0, 1e-3, (400, 3))
    for positions, noted in ((repeated, True), (rng.uniform(0, 6, (400, 3)), False)):
        tx = group_transmitters(positions)
        train, test = tx_disjoint_split(tx)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            note_shared_transmitters("mine", tx, {"train": train, "test": test}, positions)
        assert [str(one.message).startswith("mine: 100 % of the test's TX positions lie within 1 cm") for one in caught] == (
            [True] if noted else []
        )
    np.testing.assert_allclose(spacing(repeated), spacing(places), rtol=0.1)
    assert spacing(places[:2] * 1e-4) < 1e-3


def test_places_measured_again_are_not_divided(rng):
    """Repeats up to millimetres: a random half of them would reveal what the other half measures."""
    places = np.repeat(rng.uniform(-3, 3, (20, 3)), 5, 0)
    scene = tiny_scene(100)
    repeats = places + rng.normal(0, 1e-3, places.shape)
    dataset = scene_dataset(dataclasses.replace(scene, tx_positions=repeats, split=np.zeros(100, np.int8)))
    assert len(np.unique(dataset.tx_index)) == 100
    place = places_of(dataset)
    assert len(np.unique(place)) == 20
    for one in np.unique(place):
        assert np.ptp(dataset.tx_positions[place == one], axis=0).max() < 0.02
    held = hold_out_validation(dataset)
    assert len(held.validation) and not np.isin(place[held.validation], place[held.train]).any()
    assert is_few(held)


def test_dense_places_and_chance_repeats_are_no_places_measured_again(rng):
    tx = np.arange(60)
    alone = rng.uniform(-3, 3, (60, 3))
    track = np.linspace(0, 0.3, 60)[:, None] * [1.0, 0, 0]
    grid = np.stack([*np.meshgrid(np.arange(10) / 1000, np.arange(6) / 1000), np.zeros((6, 10))], -1).reshape(-1, 3)
    chance = alone.copy()
    chance[1] = chance[0] + 0.002
    slow = np.cumsum(rng.choice([0.004, 0.015], 60))[:, None] * [0, 1.0, 0]  # parts of it are closer than others
    for positions in (alone, track, grid, chance, slow, alone[:1], alone[:0]):
        np.testing.assert_array_equal(group_places(positions, tx[: len(positions)]), tx[: len(positions)])
    both = np.concatenate([track, np.repeat(alone[:10], 4, 0) + rng.normal(0, 1e-4, (40, 3))])
    found = group_places(both, np.arange(100))
    assert len(np.unique(found[:60])) == 60 and len(np.unique(found[60:])) == 10
