"""Simple methods against their equations, and how they share an answer with a field."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import RX, tiny_dataset

from wbgs_jax.evaluation.baselines import line_of_sight, nearest_tx
from wbgs_jax.inference.kriging import (
    MEMBERS,
    correct,
    field_share,
    for_receiver,
    member_spectra,
    member_weights,
    mixed_spectra,
    read_neighbours,
    without_queried,
    write_neighbours,
)
from wbgs_jax.training.fit_mixture import Known, start_mixture
from wbgs_jax.types import make_query, make_receiver

SOME = 0.3


def made(dataset, **changes):
    """A mixture of all training links."""
    mixture = start_mixture(dataset, Known(dataset.train, dataset.eight_bit(dataset.train)), 0.5)
    log_distance = jnp.array([0.0, 1.0, -3.0, 2.0])
    values = {"log_distance": log_distance, "length": jnp.float32(0.8), "nugget": jnp.float32(0.05)} | changes
    return dataclasses.replace(mixture, **values)


@pytest.fixture(scope="module", params=["wavelengths", "metres"])
def dataset(request):
    return tiny_dataset(14, unit=request.param)


def spectra_at(mixture, position, frequency, known=None):
    known = jnp.ones(len(mixture.frequency_hz), bool) if known is None else jnp.asarray(known)
    return member_spectra(mixture, mixture.mean, jnp.asarray(position, jnp.float32), jnp.float32(frequency), known)


@pytest.mark.heavy
def test_every_simple_method_is_that_of_its_equation(dataset, rng):
    mixture, link = made(dataset), dataset.test[rng.integers(len(dataset.test))]
    position, frequency = dataset.tx_positions[link], dataset.frequencies_hz[link]
    found, distance = spectra_at(mixture, position, frequency)
    found = dict(zip(MEMBERS, np.asarray(found), strict=True))
    same = dataset.frequencies_hz[dataset.train] == frequency
    places, values = dataset.tx_positions[dataset.train][same], np.asarray(mixture.images)[same] / 255
    d = np.linalg.norm(places - position, axis=1)
    assert distance == pytest.approx(d.min(), rel=1e-4)
    np.testing.assert_allclose(found["mean"], np.asarray(mixture.images).mean(0) / 255, atol=1e-5)
    np.testing.assert_allclose(found["nearest"], nearest_tx(dataset)(np.array([link]))[0], atol=2.1e-3)
    np.testing.assert_allclose(found["inverse_distance"], np.average(values, 0, d**-2), atol=1e-4)
    np.testing.assert_allclose(found["line_of_sight"], line_of_sight(dataset)(np.array([link]))[0], atol=2e-3)
    # Ordinary kriging with a Lagrange multiplier: another way to its weights.
    n = len(places)
    system = np.ones((n + 1, n + 1))
    system[:n, :n] = np.exp(-np.linalg.norm(places[:, None] - places[None], axis=-1) / 0.8) + 0.05 * np.eye(n)
    system[n, n] = 0
    weights = np.linalg.solve(system, np.append(np.exp(-d / 0.8), 1))[:n]
    np.testing.assert_allclose(found["kriging"], np.tensordot(weights, values, 1), atol=1e-3)


def test_what_is_left_out_is_not_looked_at(dataset, rng):
    mixture = made(dataset)
    left = rng.random(len(dataset.train)) < 0.6
    poisoned = dataclasses.replace(mixture, images=jnp.where(left[:, None, None], mixture.images, 255))
    link = dataset.train[0]
    asked = dataset.tx_positions[link], dataset.frequencies_hz[link]
    for a, b in zip(spectra_at(mixture, *asked, left), spectra_at(poisoned, *asked, left), strict=True):
        np.testing.assert_array_equal(a, b)


def test_far_away_kriging_is_a_mean_and_nothing_is_infinite(dataset):
    mixture = made(dataset, length=jnp.float32(0.01))
    for metres in (0.5, 1.0, 30.0, 1e4):
        found, _ = spectra_at(mixture, dataset.tx_positions[0] + [metres, 0, 0], dataset.frequencies_hz[0])
        assert np.isfinite(found).all() and found.min() > -1e-3 and found.max() < 1 + 1e-3
    same = dataset.frequencies_hz[dataset.train] == dataset.frequencies_hz[0]
    mean = np.asarray(mixture.images)[same].mean(0) / 255  # of transmitters far from each other
    np.testing.assert_allclose(found[MEMBERS.index("kriging")], mean, atol=5e-3)


def test_an_answer_is_shared_by_the_distance(dataset, rng):
    members = jnp.asarray(rng.normal(size=(len(MEMBERS), 2)), jnp.float32)
    mixture = made(dataset, members=members, field=jnp.array([0.3, -0.8]))
    positions = dataset.tx_positions[dataset.train[0]] + rng.normal(size=(3, 3)) * [[0.01], [0.5], [40]]
    frequency = np.full(3, dataset.frequencies_hz[dataset.train[0]])
    own = rng.random((3, 90, 360)).astype(np.float32)
    got = mixed_spectra(mixture, jnp.asarray(own), make_query(positions, frequency))
    for i in range(3):
        spectra, distance = spectra_at(mixture, positions[i], frequency[i])
        u = np.clip(np.log(distance), -3, 2)
        weights = np.exp(members[:, 0] + members[:, 1] * u)
        share = 1 / (1 + np.exp(-0.3 + 0.8 * u))
        simple = np.tensordot(weights / weights.sum(), np.asarray(spectra), 1)
        np.testing.assert_allclose(got[i], np.clip(share * own[i] + (1 - share) * simple, 0, 1), atol=1e-4)
        assert member_weights(mixture, distance).sum() == pytest.approx(1, abs=1e-5)
        assert field_share(mixture, distance) == pytest.approx(share, abs=1e-5)


def test_at_frequencies_that_nobody_observed_the_field_answers(dataset, rng):
    own = jnp.asarray(rng.random((1, 90, 360)), jnp.float32)
    query = make_query(dataset.tx_positions[:1], np.array([33e9]))
    np.testing.assert_array_equal(correct(made(dataset), own, query), own)


@pytest.mark.heavy
def test_it_can_be_differentiated_at_a_known_transmitter(dataset):
    mixture = made(dataset, field=jnp.zeros(2))
    own, frequency = jnp.full((1, 90, 360), SOME), np.array([dataset.frequencies_hz[dataset.train[0]]])

    def brightness(position):
        return mixed_spectra(mixture, own, make_query(position[None], frequency)).sum()

    gradient = jax.grad(brightness)(jnp.asarray(dataset.tx_positions[dataset.train[0]], jnp.float32))
    assert np.isfinite(gradient).all()


def test_it_is_exported_for_other_platforms(dataset, rng):
    mixture, query = made(dataset), make_query(dataset.tx_positions[:2] + 0.1, dataset.frequencies_hz[:2])
    own = jnp.asarray(rng.random((2, 90, 360)), jnp.float32)
    exported = jax.export.export(jax.jit(correct), platforms=("cpu", "cuda"))(mixture, own, query)
    np.testing.assert_allclose(exported.call(mixture, own, query), correct(mixture, own, query), atol=1e-5)


def test_it_comes_back_from_a_run_folder_and_belongs_to_its_receiver(dataset, tmp_path):
    mixture = made(dataset)
    write_neighbours(tmp_path, mixture)
    again = read_neighbours(tmp_path)
    for a, b in zip(jax.tree.leaves(mixture), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
    assert for_receiver(again, dataset.receiver()) is again
    assert for_receiver(again, make_receiver(RX + 0.1)) is None
    assert for_receiver(again, make_receiver(RX, (np.cos(0.05), 0, 0, np.sin(0.05)))) is None


def test_what_is_scored_is_not_known(dataset):
    mixture = made(dataset)
    left = without_queried(mixture, dataset.query(dataset.train[:6]))
    np.testing.assert_array_equal(left.images, mixture.images[6:])
    np.testing.assert_allclose(left.mean, np.asarray(mixture.images[6:]).mean(0) / 255, atol=1e-6)
