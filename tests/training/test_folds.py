"""Blocks of transmitters that are left out together, and what short trainings answer to them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_dataset
from builders.toys import RippleConfig, RippleField, toy_settings

from wbgs_jax.data.dataset import hold_out_validation, training_links
from wbgs_jax.training import cross_validation
from wbgs_jax.training.cross_validation import FOLDS, Training, blocks, held_out_blocks, is_few, learn_few, shortened
from wbgs_jax.training.fit_mixture import Found, start_mixture

pytestmark = pytest.mark.usefixtures("ripple")


def test_blocks_lie_together(rng):
    positions = np.concatenate([rng.normal(centre, 0.1, (12, 3)) for centre in ([0, 0, 0], [9, 0, 0], [0, 5, 0], [9, 5, 1])])
    tx = rng.permutation(48)
    found = blocks(positions, tx)
    assert sorted(np.bincount(found)) == [12] * 4
    for block in range(FOLDS):
        assert np.ptp(positions[found == block], axis=0).max() < 2


def test_links_of_a_transmitter_share_a_block(rng):
    tx = np.repeat(np.arange(7), 3)
    positions = rng.normal(size=(7, 3))[tx]
    found = blocks(positions, tx)
    assert all(len(np.unique(found[tx == one])) == 1 for one in range(7)) and set(found) == set(range(FOLDS))
    assert set(blocks(positions[:6], tx[:6])) == {0, 1}
    assert set(blocks(positions[:3], tx[:3])) == {0}


def test_nothing_answers_that_was_trained_with_it(tmp_path, monkeypatch):
    dataset = hold_out_validation(tiny_dataset(15))
    trained = []
    true_train = cross_validation.train

    def watched(part, *arguments, **options):
        trained.append(part)
        return true_train(part, *arguments, **options)

    monkeypatch.setattr(cross_validation, "train", watched)
    said = []
    found = held_out_blocks(dataset, "ripple", shortened(toy_settings(), 8), 0, tmp_path, 0, said.append)
    known = training_links(dataset)
    assert len(trained) == len(said) == FOLDS and not (tmp_path / cross_validation.FOLDER).exists()
    assert set(found.links) == set(known)
    for link, use, group in zip(found.links, found.known, found.group, strict=True):
        own = trained[group]
        assert link not in own.train and set(known[use]) == set(own.train)
        assert dataset.tx_index[link] not in dataset.tx_index[own.train]
        assert not np.isin(dataset.test, own.train).any()


def test_what_is_done_is_not_done_again(tmp_path, monkeypatch):
    dataset = hold_out_validation(tiny_dataset(9))
    asked = dataset, "ripple", shortened(toy_settings(), 8), 0, tmp_path, 0
    monkeypatch.setattr(cross_validation, "shutil", type("kept", (), {"rmtree": staticmethod(lambda *_, **__: None)}))
    first = held_out_blocks(*asked, lambda line: None)
    monkeypatch.setattr(cross_validation, "train", lambda *_, **__: pytest.fail("trained again"))
    second = held_out_blocks(*asked, lambda line: None)
    np.testing.assert_array_equal(first.pas, second.pas)


def test_one_transmitter_cannot_be_left_out(tmp_path):
    dataset = tiny_dataset(3)
    one = dataset.train[dataset.tx_index[dataset.train] == dataset.tx_index[dataset.train[0]]]
    alone = dataclasses.replace(dataset, train=one)
    assert not len(held_out_blocks(alone, "ripple", toy_settings(), 0, tmp_path, 0, print).links)


@pytest.fixture
def learned(tmp_path, monkeypatch):
    """Calls `learn_few` for a toy field whose mixture is chosen by `found`."""
    dataset = hold_out_validation(tiny_dataset(15))
    settings = toy_settings()
    field = RippleField(RippleConfig())
    seen = []

    def learn(alone: bool, distance=1.0):
        def found(_, known, held, with_paths):
            seen.append(held)
            scores = np.linspace(0.4, 0.9, len(held.links))
            return Found(start_mixture(dataset, known, 1.0), scores, held.pas, np.full(len(scores), distance), alone, "line")

        monkeypatch.setattr(cross_validation, "learn_mixture", found)
        how = Training("ripple", settings, 8, 0, tmp_path)
        return dataset, learn_few(field, field.init(jax.random.key(0)), dataset, how, print), seen[-1]

    return learn


@pytest.mark.parametrize("alone", [False, True])
def test_blocks_alone_decide_and_give_the_intervals(learned, alone):
    """Not the validation part, which lies between training transmitters."""
    dataset, few, held = learned(alone)
    assert set(held.group) == set(range(FOLDS)) and len(np.unique(held.links)) == len(held.links)
    assert few.confidence is not None and (few.mixture is None) == alone
    frequencies = () if alone else np.unique(dataset.frequencies_hz[training_links(dataset)])
    np.testing.assert_allclose(few.confidence.frequency_hz, frequencies, rtol=1e-6)


@pytest.mark.parametrize("together", [False, True])
def test_intervals_measure_distances_as_queries_do(learned, monkeypatch, together):
    """To transmitters of any frequency; spectra that are used at all frequencies have intervals at all."""
    fitted = []
    confidence_of = cross_validation.confidence_of
    monkeypatch.setattr(cross_validation, "confidence_of", lambda *own: fitted.append(own) or confidence_of(*own))
    if together:
        start = start_mixture
        nan = jnp.full(len(training_links(tiny_dataset(15))), jnp.nan)
        monkeypatch.setitem(globals(), "start_mixture", lambda *own: dataclasses.replace(start(*own), frequency_hz=nan))
    dataset, few, held = learned(False, 50.0)
    known = dataset.tx_positions[training_links(dataset)]
    pairs = zip(held.links, held.known, strict=True)
    away = [np.linalg.norm(known[use] - dataset.tx_positions[link], axis=1).min() for link, use in pairs]
    np.testing.assert_allclose(np.exp(fitted[0][0][:, 0]), np.hypot(away, 0.01), rtol=1e-6)
    assert len(few.confidence.frequency_hz) == (0 if together else len(np.unique(dataset.frequencies_hz)))


def test_links_without_measurements_at_their_frequency_give_no_intervals(learned):
    assert learned(False, np.inf)[1].confidence is None


def test_many_transmitters_are_not_few_whatever_is_held_out():
    few, many = hold_out_validation(tiny_dataset(30)), tiny_dataset(280, kind="power")
    assert is_few(few) and is_few(dataclasses.replace(few, validation=few.validation[:0]))
    assert not is_few(many)  # powers alone
    spectra = dataclasses.replace(few, tx_index=np.arange(len(few)))
    assert is_few(spectra) == (len(training_links(spectra)) < 200)


def test_short_trainings_have_whole_epochs():
    settings = toy_settings()
    short = shortened(settings, 12)
    assert short.optim.steps % settings.loop.epoch_steps == 0 and 0 < short.optim.steps <= 12
    assert short.loop.evaluate_spectra == 0
