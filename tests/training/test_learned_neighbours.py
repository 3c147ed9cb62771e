"""Whether neighbours are asked is found on the validation part, and nothing else is looked at."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_dataset
from builders.toys import NoisyField, RippleConfig, RippleField

from wbgs_jax.data.dataset import hold_out_validation, keep_links
from wbgs_jax.inference.kriging import correct
from wbgs_jax.metrics import ssim
from wbgs_jax.training import fit_kriging as module
from wbgs_jax.training.fit_kriging import FEWEST, MOST, Choice, choices, choose, learn_neighbours


@pytest.fixture(scope="module")
def field():
    return RippleField(RippleConfig())


@pytest.fixture(scope="module")
def params(field):
    return field.init(jax.random.key(1))


def alike(dataset, rng, spread):
    """All transmitters within `spread` metres: neighbours see nearly the same."""
    _, first = np.unique(dataset.tx_index, return_index=True)
    base = {f: dataset.snapshots[np.flatnonzero(dataset.frequencies_hz == f)[0]] for f in np.unique(dataset.frequencies_hz)}
    snapshots = np.stack([base[f] for f in dataset.frequencies_hz])
    offsets = rng.uniform(-spread, spread, (len(first), 3))[dataset.tx_index]
    return dataclasses.replace(dataset, observations={"snapshots": snapshots}, tx_positions=dataset.tx_positions[0] + offsets)


@pytest.mark.heavy
def test_they_are_asked_where_neighbours_are_alike(field, params, rng):
    dataset = hold_out_validation(alike(tiny_dataset(24), rng, 0.1))
    neighbours, line, _ = learn_neighbours(field, params, dataset)
    assert neighbours is not None and "gains +" in line
    assert len(neighbours.frequency_hz) == len(dataset.train) + len(dataset.validation)
    own = jax.jit(lambda query: field.render(params, field.plan(params, dataset.receiver()), query).pas)
    query, truth = dataset.query(dataset.test), np.asarray(dataset.pas(dataset.test))
    alone = np.asarray(own(query))
    corrected = np.asarray(correct(neighbours, jnp.asarray(alone), query))
    assert ssim(corrected, truth).mean() > ssim(alone, truth).mean() + 0.2


def test_transmitters_of_different_frequencies_are_asked_together(field, params, rng):
    dataset = alike(tiny_dataset(24), rng, 0.1)
    assert not any(choice.together for choice in choices(dataset, dataset.train))
    one = keep_links(dataset, np.flatnonzero(dataset.frequencies_hz == dataset.frequencies_hz[0]))
    hopping = hold_out_validation(dataclasses.replace(one, frequencies_hz=902e6 + 1e6 * np.arange(len(one))))
    learned = learn_neighbours(field, params, hopping)
    assert learned.neighbours is not None and np.isnan(learned.neighbours.frequency_hz).all()
    own = jnp.full((len(hopping.test), 90, 360), 0.5)
    corrected = np.asarray(correct(learned.neighbours, own, hopping.query(hopping.test)))
    assert ssim(corrected, np.asarray(hopping.pas(hopping.test))).mean() > 0.8


@pytest.mark.heavy
def test_they_are_not_asked_where_they_know_nothing(field, params, rng):
    dataset = tiny_dataset(24)
    plan = field.plan(params, dataset.receiver())
    images = np.asarray(jax.jit(lambda query: field.render(params, plan, query).pas)(dataset.query(np.arange(len(dataset)))))
    told = np.clip(255 * images + rng.normal(0, 3, images.shape), 0, 255).astype(np.uint8)  # what the field says already
    noisy = dataset.with_observations(pas=told)
    neighbours, line, _ = learn_neighbours(field, params, hold_out_validation(noisy))
    assert neighbours is None and "not used" in line


@pytest.mark.heavy
def test_noise_is_nothing_that_neighbours_know(field, params):
    """They would add it to every answer: the field leaves it out, and the known spectra have it."""
    noisy, dataset = NoisyField(RippleConfig()), tiny_dataset(24)
    plan = field.plan(params, dataset.receiver())
    clean = jax.jit(lambda query: field.render(params, plan, query).pas)(dataset.query(np.arange(len(dataset))))
    observed = np.asarray(255 * noisy.as_observed(params, clean)).round().astype(np.uint8)
    told = hold_out_validation(dataset.with_observations(pas=observed))
    assert learn_neighbours(noisy, params, told)[0] is None
    assert learn_neighbours(field, params, told)[0] is not None


def test_the_smoothest_within_a_standard_error_of_the_best_is_chosen(rng):
    tx, noise = np.arange(8), rng.normal(0, 0.03, 8)
    error = noise.std(ddof=1) / 8**0.5
    best, smooth, too_smooth, harmful = (Choice("spectra", length, 1.0) for length in (0.1, 1.0, 10.0, 100.0))
    tried = {
        best: 0.3 + noise,
        smooth: 0.3 + noise - 0.9 * error,
        too_smooth: 0.3 + noise - 1.1 * error,
        harmful: noise - 0.5,
        Choice("residuals", 50.0, 1.0): 0.3 + noise - 0.5 * error,  # of equals, spectra are smoother ...
        Choice("spectra", 50.0, 0.5): 0.3 + noise - 0.5 * error,  # ... and so is the full weight
    }
    chosen, gain = choose(tried, tx)
    assert chosen == smooth and gain == pytest.approx(tried[smooth].mean())
    assert choose({harmful: tried[harmful]}, tx)[0] is None
    assert choose({best: np.array([1, -0.9, 0.2, -0.2])}, np.arange(4))[0] is None  # not sure
    assert choose({}, tx) == (None, 0.0)


def test_of_many_spectra_residuals_are_not_tried(rng, monkeypatch):
    dataset = hold_out_validation(tiny_dataset(24))
    assert {choice.kind for choice in choices(dataset, dataset.train)} == {"residuals", "spectra"}
    monkeypatch.setattr(module, "MOST_RESIDUALS", len(dataset.train) - 1)
    assert {choice.kind for choice in choices(dataset, dataset.train)} == {"spectra"}


def test_what_gains_little_is_not_worth_it():
    few = Choice("spectra", 1.0, 1.0)
    assert choose({few: np.full(8, 0.004)}, np.arange(8))[0] is None
    assert choose({few: np.full(8, 0.006)}, np.arange(8))[0] == few


@pytest.mark.heavy
def test_the_test_part_changes_nothing(field, params, rng):
    dataset = hold_out_validation(alike(tiny_dataset(24), rng, 0.1))
    poisoned = dataset.snapshots.copy()
    poisoned[dataset.test] = np.nan
    found, *_ = learn_neighbours(field, params, dataset)
    again, *_ = learn_neighbours(field, params, dataset.with_observations(snapshots=poisoned))
    jax.tree.map(np.testing.assert_array_equal, found, again)


def test_data_that_cannot_have_any_have_none_and_say_why(field, params, monkeypatch):
    dataset = hold_out_validation(tiny_dataset(24))
    held_out = dataset.tx_index[dataset.validation]
    few = np.isin(held_out, np.unique(held_out)[: FEWEST - 1])
    fewer = dataclasses.replace(dataset, validation=dataset.validation[few])
    several = hold_out_validation(tiny_dataset(24, n_rx=2))
    for data, why in ((fewer, f"{FEWEST - 1} validation transmitters are too few"), (several, "several receivers")):
        found = learn_neighbours(field, params, data)
        assert found.neighbours is None is found.of_training and why in found.line
    assert learn_neighbours(field, params, hold_out_validation(tiny_dataset(24, kind="power"))) == (None, "", None)
    monkeypatch.setattr(module, "MOST", len(dataset.train))
    found = learn_neighbours(field, params, dataset)
    assert found.neighbours is None and "measured spectra are more than" in found.line and len(dataset.train) < MOST
