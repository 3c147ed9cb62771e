"""Angle errors and beam losses against closed forms and a search through all beams."""

import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.metrics import FAINTEST_DB, angle_error_deg, beam_loss_db, plane_normal
from wbgs_jax.radio.array import RINGS, SECTORS, best_beams, codebook, pas_directions, planar_array, snapshot_to_pas


def spot(row, column, width=200.0):
    """A spectrum with its peak at one pixel."""
    directions = pas_directions()
    return np.exp(width * (directions @ directions[row, column] - 1)).astype(np.float32)


def test_the_angle_is_that_between_the_peaks(rng):
    rows, columns = rng.integers(1, 90, 2), rng.integers(0, 359, 2)
    a, b = (spot(row, column) for row, column in zip(rows, columns, strict=True))
    directions = pas_directions()[rows, columns]
    expected = np.degrees(np.arccos(np.clip(directions[0] @ directions[1], -1, 1)))
    np.testing.assert_allclose(angle_error_deg(a[None], b[None]), expected, atol=1e-4)
    np.testing.assert_allclose(angle_error_deg(a[None], a[None]), 0, atol=1e-6)


def test_both_ends_of_the_azimuth_are_one_direction():
    first, last = np.zeros((2, 1, 90, 360), np.float32)
    first[0, 60, 0], last[0, 60, 359] = 1, 1
    assert angle_error_deg(first, last)[0] < 1e-5


def test_the_codebook_covers_the_hemisphere():
    """No direction is further from a beam than half of a ring and of a sector."""
    beams = pas_directions().reshape(-1, 3)[codebook()]
    assert len(beams) == len(set(codebook())) == RINGS * SECTORS
    nearest = (pas_directions().reshape(-1, 3) @ beams.T).max(1)
    assert np.degrees(np.arccos(nearest.min())) < np.hypot(90 / RINGS / 2, 180 / SECTORS) + 1


def test_of_two_beams_that_hear_alike_the_one_ahead_is_best(rng):
    """A planar array hears a wave from the front at the back too."""
    array, beams = planar_array(), pas_directions().reshape(-1, 3)[codebook()]
    azimuth, zenith = rng.uniform(-1.2, 1.2, 40), rng.uniform(0.5, 1.4, 40)
    waves = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], -1)
    snapshots = np.exp(2j * np.pi * waves @ array.T)
    best = best_beams(np.asarray(snapshot_to_pas(jnp.asarray(snapshots, jnp.complex64), jnp.asarray(array, jnp.float32))))
    heard = np.abs(np.exp(-2j * np.pi * beams @ array.T) @ snapshots.T)
    np.testing.assert_allclose(heard[best, np.arange(40)], heard.max(0), rtol=0.051)
    assert (beams[best, 0] > -1e-6).all()


@pytest.mark.parametrize("tried", [1, 3])
def test_the_loss_is_that_of_the_best_beam_tried(rng, tried):
    predicted, truth = rng.random((2, 5, 90, 360)).astype(np.float32)
    for p, t, loss in zip(predicted, truth, beam_loss_db(predicted, truth, tried), strict=True):
        heard = t.reshape(-1)[codebook()].astype(float) ** 2
        ranked = sorted(range(len(heard)), key=lambda k: -p.reshape(-1)[codebook()][k])[:tried]
        assert loss == pytest.approx(10 * np.log10(heard.max() / max(heard[k] for k in ranked)), abs=1e-5)


def test_who_predicts_the_truth_loses_nothing_and_more_trials_never_lose_more(rng):
    predicted, truth = rng.random((2, 9, 90, 360)).astype(np.float32)
    assert (beam_loss_db(truth, truth) == 0).all()
    losses = [beam_loss_db(predicted, truth, tried) for tried in (1, 3, RINGS * SECTORS)]
    assert (losses[0] >= losses[1]).all() and (losses[1] >= 0).all() and (losses[2] == 0).all()


def test_a_silent_beam_and_a_silent_truth_have_finite_losses():
    nothing, heard = np.zeros((2, 1, 90, 360), np.float32)
    heard.reshape(-1)[codebook()[-1]] = 1
    assert beam_loss_db(nothing, heard)[0] == pytest.approx(-FAINTEST_DB)  # all beams look alike: the first is used
    assert beam_loss_db(heard, nothing)[0] == 0


def test_a_planar_array_does_not_tell_its_front_from_its_back(rng):
    """Twins are half a pixel off each other's places, so that which of them is the largest pixel is chance."""
    front, back = (np.zeros((1, 90, 360)) for _ in range(2))
    row, column = 60, int(rng.integers(190, 250))
    front[0, row, column] = back[0, row, (538 - column) % 359] = 1
    normal = plane_normal(planar_array())
    np.testing.assert_allclose(np.abs(normal), [1, 0, 0], atol=1e-9)
    assert angle_error_deg(front, back, normal)[0] < 1.1 and angle_error_deg(front, back)[0] > 20
    assert plane_normal(rng.normal(size=(16, 3))) is None and plane_normal(np.arange(4.0)[:, None] * np.ones(3)) is None
