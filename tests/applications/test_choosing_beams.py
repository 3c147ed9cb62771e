"""Beams against a search through all of them."""

import numpy as np
import pytest

from wbgs_jax.applications.beams import RIGHT_DB, choose_beams, rank_beams, score_beams
from wbgs_jax.radio.array import codebook


def test_beams_are_ranked_as_a_search_through_all_of_them_ranks_them(rng):
    spectra = rng.random((4, 90, 360)).astype(np.float32)
    for spectrum, ranked in zip(spectra, rank_beams(spectra, 5), strict=True):
        heard = [spectrum[divmod(pixel, 360)] for pixel in codebook()]
        assert ranked.tolist() == sorted(range(64), key=lambda beam: -heard[beam])[:5]


def test_spectra_and_counts_are_checked(rng):
    assert rank_beams(np.zeros((0, 90, 360)), 4).shape == (0, 4)
    assert rank_beams(rng.random((2, 90, 360)), 64).shape == (2, 64)
    for shape, count, words in (((90, 360), 3, "shape"), ((2, 360, 90), 3, "shape"), ((2, 90, 360), 65, "1 to 64 beams")):
        with pytest.raises(ValueError, match=words):
            rank_beams(np.zeros(shape), count)


def test_scores_are_those_of_a_search_through_all_beams(rng):
    predicted, truth = rng.random((2, 30, 90, 360)).astype(np.float32) ** 0.05
    scores, losses = score_beams(predicted, truth), []
    for p, t in zip(predicted, truth, strict=True):
        heard = t.reshape(-1)[codebook()].astype(float)
        order = np.argsort(-p.reshape(-1)[codebook()], kind="stable")
        losses.append([-20 * np.log10(heard[order[:tried]].max() / heard.max()) for tried in (1, 3)])
    first, three = np.array(losses).T
    assert scores == pytest.approx(
        ((first <= RIGHT_DB).mean(), (three <= RIGHT_DB).mean(), first.mean(), three.mean()), abs=1e-5
    )
    assert scores.top1 <= scores.top3 and scores.loss_db >= scores.loss_top3_db


def test_who_knows_the_truth_is_always_right(rng):
    truth = rng.random((5, 90, 360)).astype(np.float32)
    assert score_beams(truth, truth) == (1, 1, 0, 0)


def test_spectra_of_other_links_and_missing_ones_are_refused(rng):
    truth = rng.random((5, 90, 360)).astype(np.float32)
    wrong = truth.copy()
    wrong[2, 3, 4] = np.nan
    for predicted, true, words in ((truth[:1], truth, "same links"), (truth, wrong, "true"), (wrong, truth, "predicted")):
        with pytest.raises(ValueError, match=words):
            score_beams(predicted, true)


def test_beams_for_transmitters_are_those_of_their_spectra(rng):
    spectra = rng.random((20, 90, 360)).astype(np.float32)
    positions = np.arange(60.0).reshape(20, 3)

    def predict(tx_position, frequency_hz):
        return spectra[(np.asarray(tx_position)[:, 0] / 3).astype(int)]

    np.testing.assert_array_equal(choose_beams(predict, positions, 28e9), rank_beams(spectra))


def test_spectra_of_eight_bits_rank_like_their_values(rng):
    """Unsigned integers, as in an image, have no negative: a dark beam would count as the brightest."""
    image = rng.integers(0, 256, (4, 90, 360)).astype(np.uint8)
    np.testing.assert_array_equal(rank_beams(image), rank_beams(image.astype(float)))
    assert score_beams(image, image) == score_beams(image.astype(float), image.astype(float))
