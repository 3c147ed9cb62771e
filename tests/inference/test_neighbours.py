"""Known spectra beside the field: kriging against its equations, what it leaves alone, what it costs on disk."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import RX, tiny_dataset

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.statistics import standard_error
from wbgs_jax.data.dataset import hold_out_validation
from wbgs_jax.inference import kriging
from wbgs_jax.inference.kriging import NEAREST, NOISE, correct, for_receiver, read_neighbours, write_neighbours
from wbgs_jax.training.fit_kriging import Choice, choices, images_of, make_neighbours
from wbgs_jax.types import make_query, make_receiver


@pytest.fixture
def known(rng):
    """(dataset, links, truth, what a field says)."""
    dataset = tiny_dataset(12)
    index = np.sort(rng.permutation(len(dataset))[:20])
    truth = np.asarray(dataset.pas(index))
    return dataset, index, truth, np.clip(truth + rng.normal(0, 0.1, truth.shape), 0, 1).astype(np.float32)


def made(choice, dataset, index, predicted):
    """Neighbours of known links."""
    return make_neighbours(choice, dataset, index, images_of(choice.kind, dataset.eight_bit(index), predicted))


def by_the_equations(dataset, index, choice, values, position, frequency):
    """k (K + noise)^-1 values, at one frequency."""
    same = dataset.frequencies_hz[index] == frequency
    places = dataset.tx_positions[index][same]
    kernel = np.exp(-np.linalg.norm(places[:, None] - places[None], axis=-1) / choice.length)
    k = np.exp(-np.linalg.norm(places - position, axis=-1) / choice.length)
    weights = choice.weight * np.linalg.solve(kernel + NOISE * np.eye(len(places)), k)
    return np.tensordot(weights, values[same], 1), weights.sum()


def test_what_is_scored_is_not_asked(known):
    dataset, index, _, predicted = known
    neighbours = made(Choice("spectra", 1.0, 1.0), dataset, index, predicted)
    left = kriging.without_queried(neighbours, dataset.query(index[:5]))
    np.testing.assert_array_equal(left.images, neighbours.images[5:])
    np.testing.assert_allclose(left.tx_position, dataset.tx_positions[index[5:]], rtol=1e-6)
    np.testing.assert_array_equal(left.frequency_hz, neighbours.frequency_hz[5:])
    assert (
        kriging.without_queried(neighbours, dataset.query(index)) is None is kriging.without_queried(None, dataset.query(index))
    )


@pytest.mark.parametrize("kind", ["residuals", "spectra"])
def test_it_is_simple_kriging_at_the_same_frequency(known, rng, kind):
    dataset, index, truth, predicted = known
    choice = Choice(kind, length=rng.uniform(0.3, 3), weight=rng.uniform(0.2, 1))
    neighbours = made(choice, dataset, index, predicted)
    positions, frequency = rng.uniform(-1, 1, (3, 3)) + RX, dataset.frequencies_hz[index[0]]
    own = rng.uniform(0.4, 0.6, (3, 90, 360)).astype(np.float32)
    got = correct(neighbours, jnp.asarray(own), make_query(positions, np.full(3, frequency)))
    for i, position in enumerate(positions):
        if kind == "residuals":
            said, _ = by_the_equations(dataset, index, choice, truth - predicted, position, frequency)
            expected = own[i] + said
        else:
            said, total = by_the_equations(dataset, index, choice, truth, position, frequency)
            expected = own[i] + said - total * own[i]
        np.testing.assert_allclose(got[i], np.clip(expected, 0, 1), atol=4e-3)  # bytes and half precision


def test_the_nearest_say_what_all_of_many_say(rng):
    """Of 300 places where spectra change over 2 m, kriging from the nearest agrees with kriging from all."""
    count, length = 300, 2.0
    dataset = tiny_dataset(count)
    places = rng.uniform(-1, 1, (count, 3))
    first = np.array([np.flatnonzero(dataset.tx_index == tx)[0] for tx in range(count)])
    dataset = dataclasses.replace(dataset, tx_positions=places[dataset.tx_index] + RX)
    shapes = rng.uniform(0, 1, (2, 90, 360))
    share = 0.5 + 0.5 * np.sin(places[:, 0])
    images = np.round(255 * (share[:, None, None] * shapes[0] + (1 - share)[:, None, None] * shapes[1])).astype(np.uint8)
    frequency = dataset.frequencies_hz[first[0]]
    dataset = dataclasses.replace(dataset, frequencies_hz=np.full(len(dataset), frequency))
    choice = Choice("spectra", length, 1.0)
    neighbours = make_neighbours(choice, dataset, first, jnp.asarray(images))
    assert len(neighbours.images) > 5 * NEAREST
    own = np.full((1, 90, 360), 0.5, np.float32)
    position = rng.uniform(-0.8, 0.8, 3) + RX
    got = np.asarray(correct(neighbours, jnp.asarray(own), make_query(position[None], [frequency])))[0]
    said, total = by_the_equations(dataset, first, choice, images / 255, position, frequency)
    np.testing.assert_allclose(got, np.clip(own[0] + said - total * own[0], 0, 1), atol=0.05)
    true = 0.5 + 0.5 * np.sin(position[0] - RX[0])
    assert np.abs(got - (true * shapes[0] + (1 - true) * shapes[1])).mean() < 0.02


def test_a_neighbour_itself_is_nearly_given_back(known):
    dataset, index, truth, predicted = known
    query = dataset.query(index)
    for kind in ("residuals", "spectra"):
        neighbours = made(Choice(kind, 1e-2, 1.0), dataset, index, predicted)
        got = np.asarray(correct(neighbours, jnp.asarray(predicted), query))
        np.testing.assert_allclose(got, truth, atol=0.03)  # the noise takes a hundredth of the difference


def test_far_away_and_at_other_frequencies_the_field_answers_alone(known):
    dataset, index, _, predicted = known
    neighbours = made(Choice("spectra", 0.5, 1.0), dataset, index, predicted)
    own = jnp.asarray(predicted[:2])
    elsewhere = make_query([[900.0, 0, 0], [0, 900, 0]], dataset.frequencies_hz[index[:2]])
    between = make_query(dataset.tx_positions[index[:2]], np.full(2, 33.3e9))
    for query in (elsewhere, between):
        np.testing.assert_allclose(correct(neighbours, own, query), own, atol=1e-6)
    np.testing.assert_array_equal(correct(None, own, between), own)


def test_it_is_differentiable_at_a_neighbour_itself(known):
    dataset, index, _, predicted = known
    neighbours = made(Choice("residuals", 1.0, 1.0), dataset, index, predicted)
    query = dataset.query(index[:1])

    def total(position):
        return correct(neighbours, jnp.asarray(predicted[:1]), make_query(position, query.frequency_hz)).sum()

    assert np.isfinite(jax.grad(total)(query.tx_position)).all()


def test_they_belong_to_one_receiver_and_to_a_run_folder(known, tmp_path):
    dataset, index, _, predicted = known
    assert read_neighbours(tmp_path) is None
    neighbours = made(Choice("spectra", 1.0, 0.5), dataset, index, predicted)
    assert for_receiver(neighbours, dataset.receiver()) is neighbours
    assert for_receiver(neighbours, make_receiver(np.add(RX, [0, 0, 0.1]))) is None
    assert for_receiver(neighbours, make_receiver(RX, (np.cos(0.05), 0, 0, np.sin(0.05)))) is None
    assert for_receiver(None, dataset.receiver()) is None
    write_neighbours(tmp_path, neighbours)
    found, query = read_neighbours(tmp_path), dataset.query(index[:4])
    own = jnp.asarray(predicted[:4])
    np.testing.assert_allclose(correct(found, own, query), correct(neighbours, own, query), atol=0.01)
    (tmp_path / kriging.FILE).write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(UserError, match=r"neighbours\.npz is damaged"):
        read_neighbours(tmp_path)
    write_neighbours(tmp_path, None)
    assert read_neighbours(tmp_path) is None


def test_lengths_that_are_tried_follow_the_spacing_of_the_transmitters(known):
    dataset, index, _, _ = known
    near, far = (choices(dataclasses.replace(dataset, tx_positions=scale * dataset.tx_positions), index) for scale in (1, 10))
    assert len(near) == len(far) == len(set(near))
    np.testing.assert_allclose([choice.length for choice in far], [10 * choice.length for choice in near])
    one = dataclasses.replace(dataset, tx_positions=np.zeros_like(dataset.tx_positions))
    assert choices(one, index) == []


def test_the_standard_error_is_that_of_transmitters(rng):
    by_tx = rng.normal(size=5)
    gains, tx = np.repeat(by_tx, 3), np.repeat(np.arange(5), 3)
    mean, error = standard_error(gains, tx)
    assert mean == pytest.approx(by_tx.mean()) and error == pytest.approx(by_tx.std(ddof=1) / np.sqrt(5))
    assert standard_error(gains[:3], tx[:3])[1] == np.inf


def test_validation_is_large_enough_to_decide():
    for n_tx, expected in ((200, 0.1), (45, 8 / 30), (18, 0.25)):  # a third of the transmitters is the test
        dataset = tiny_dataset(n_tx)
        held = hold_out_validation(dataset)
        share = len(np.unique(held.tx_index[held.validation])) / len(np.unique(dataset.tx_index[dataset.train]))
        assert share == pytest.approx(min(expected, 0.25), abs=0.05)
