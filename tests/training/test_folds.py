"""Blocks of transmitters that are left out together, and what short trainings answer to them."""

import dataclasses

import numpy as np
import pytest
from builders.synthetic import tiny_dataset
from builders.toys import toy_settings

from wbgs_jax.data.splits import hold_out_validation, training_links
from wbgs_jax.training import cross_validation
from wbgs_jax.training.cross_validation import FOLDS, blocks, held_out_blocks, shortened

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
    np.testing.assert_allclose(first.pas, second.pas, atol=1e-3)


def test_one_transmitter_cannot_be_left_out(tmp_path):
    dataset = tiny_dataset(3)
    one = dataset.train[dataset.tx_index[dataset.train] == dataset.tx_index[dataset.train[0]]]
    alone = dataclasses.replace(dataset, train=one)
    assert not len(held_out_blocks(alone, "ripple", toy_settings(), 0, tmp_path, 0, print).links)


def test_short_trainings_have_whole_epochs():
    settings = toy_settings()
    short = shortened(settings, 12)
    assert short.optim.steps % settings.loop.epoch_steps == 0 and 0 < short.optim.steps <= 12
    assert short.loop.evaluate_spectra == 0
