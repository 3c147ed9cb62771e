"""Angle errors and beam losses against closed forms and a search through all beams."""

import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.metrics import FAINTEST_DB, beam_loss_db
from wbgs_jax.radio.array import (
    RINGS,
    SECTORS,
    best_beams,
    codebook,
    pas_directions,
    peak_direction_error,
    planar_array,
    snapshot_to_pas,
)


def spot(row, column, width=200.0):
    """A spectrum with its peak at one pixel."""
    directions = pas_directions()
    return np.exp(width * (directions @ directions[row, column] - 1)).astype(np.float32)


def test_the_angle_is_that_between_the_peaks(rng):
    rows, columns = rng.integers(1, 90, 2), rng.integers(0, 359, 2)
    a, b = (spot(row, column) for row, column in zip(rows, columns, strict=True))
    directions = pas_directions()[rows, columns]
    expected = np.degrees(np.arccos(np.clip(directions[0] @ directions[1], -1, 1)))
    np.testing.assert_allclose(peak_direction_error(a[None], b[None]), expected, atol=1e-4)
    np.testing.assert_allclose(peak_direction_error(a[None], a[None]), 0, atol=1e-6)


def test_both_ends_of_the_azimuth_are_one_direction():
    first, last = np.zeros((2, 1, 90, 360), np.float32)
    first[0, 60, 0], last[0, 60, 359] = 1, 1
    assert peak_direction_error(first, last)[0] < 1e-5


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
    assert peak_direction_error(front, back, planar_array())[0] < 1.1 and peak_direction_error(front, back)[0] > 20
    spread = rng.normal(size=(16, 3))  # resolves all directions
    np.testing.assert_allclose(peak_direction_error(front, back, spread), peak_direction_error(front, back), rtol=1e-5)


@pytest.mark.parametrize(("kind", "dimensions"), [("planar", 2), ("linear", 1), ("single", 0)])
def test_the_error_is_the_smallest_angle_to_a_direction_that_the_array_receives_alike(rng, kind, dimensions):
    """Against a search through directions that have the same components in the span of the array."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    array = rng.normal(size=(12 if dimensions else 1, dimensions)) @ axes[:dimensions]
    rows, columns = rng.integers(1, 90, (2, 6)), rng.integers(0, 359, (2, 6))
    a, b = (np.stack([spot(*pixel) for pixel in zip(*place, strict=True)]) for place in zip(rows, columns, strict=True))
    found = peak_direction_error(a, b, array)
    true, shown = pas_directions()[rows[1], columns[1]], pas_directions()[rows[0], columns[0]]
    for one, other, error in zip(shown, true, np.asarray(found), strict=True):
        fixed, free = axes[:dimensions], axes[dimensions:]
        around = rng.normal(size=(200_000, len(free)))
        around *= np.linalg.norm(free @ one) / np.linalg.norm(around, axis=1, keepdims=True)
        twins = fixed.T @ (fixed @ one) + around @ free
        best = np.degrees(np.arccos(np.clip(twins @ other, -1, 1).max()))
        assert best - 1.5 < error <= best + 0.05
