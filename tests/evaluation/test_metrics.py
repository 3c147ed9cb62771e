"""Metrics against scikit-image and closed forms."""

import json
import time

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from wbgs_jax._util.errors import UserError
from wbgs_jax.metrics import PSNR_LIMIT_DB, beam_loss_db, mae, psnr_db, score, ssim
from wbgs_jax.radio.array import peak_direction_error


@pytest.fixture
def pair(rng):
    """Eight predictions of eight smooth images, float32."""
    phase = np.linspace(0, 9, 360)[None] * np.linspace(1, 2, 90)[:, None] + rng.random((8, 1, 1)) * 6
    truth = (0.5 + 0.5 * np.cos(phase)).astype(np.float32)
    predicted = np.clip(truth + 0.2 * rng.normal(size=truth.shape), 0, 1).astype(np.float32)
    return predicted, truth


def test_ssim_is_scikit_image_s_in_float64(pair):
    expected = [structural_similarity(p.astype(float), t.astype(float), data_range=1) for p, t in zip(*pair, strict=True)]
    np.testing.assert_allclose(ssim(*pair), expected, atol=1e-6)
    assert ssim(*pair).dtype == np.float64


def test_psnr_is_scikit_image_s(pair):
    expected = [peak_signal_noise_ratio(t.astype(float), p.astype(float), data_range=1) for p, t in zip(*pair, strict=True)]
    np.testing.assert_allclose(psnr_db(*pair), expected, rtol=1e-9)


def test_a_constant_offset_has_a_closed_form():
    truth = np.full((2, 90, 360), 0.5, np.float32)
    predicted = truth + np.array([0.25, -0.125], np.float32)[:, None, None]
    np.testing.assert_allclose(mae(predicted, truth), [0.25, 0.125])
    np.testing.assert_allclose(psnr_db(predicted, truth), [-20 * np.log10(0.25), -20 * np.log10(0.125)])
    # Without variance SSIM is its luminance term (2 a b + C1) / (a^2 + b^2 + C1).
    a, b, c1 = 0.5, np.array([0.75, 0.375]), 0.01**2
    np.testing.assert_allclose(ssim(predicted, truth), (2 * a * b + c1) / (a**2 + b**2 + c1), rtol=1e-9)


def test_a_perfect_prediction(pair):
    _, truth = pair
    report = score(truth, truth, np.full(len(truth), 1e9))
    assert (report["median_ssim"], report["mae"], report["psnr_db"]) == (1, 0, PSNR_LIMIT_DB)
    json.dumps(report, allow_nan=False)


def test_the_report_holds_every_frequency(pair):
    predicted, truth = pair
    frequencies = np.array([94e9, 1e9, 1e9, 94e9, 2.4e9, 1e9, 2.4e9, 94e9])
    report = score(predicted, truth, frequencies)
    assert report["n"] == 8
    values = ssim(predicted, truth)
    assert report["median_ssim"] == np.median(values)
    assert report["mean_ssim"] == np.mean(values)
    assert report["psnr_db"] == np.median(psnr_db(predicted, truth))
    assert report["mae"] == np.mean(mae(predicted, truth))
    assert report["p5_ssim"] == np.percentile(values, 5) <= report["p10_ssim"] == np.percentile(values, 10)
    assert report["angle_error_deg"] == np.median(np.asarray(peak_direction_error(predicted, truth)))
    assert report["beam_loss_db"] == np.mean(beam_loss_db(predicted, truth)) > report["beam_loss_top3_db"] > 0
    rows = report["per_frequency"]
    assert [(row["frequency_ghz"], row["n"]) for row in rows] == [(1.0, 3), (2.4, 2), (94.0, 3)]
    for row in rows:
        at = frequencies == row["frequency_ghz"] * 1e9
        alone = score(predicted[at], truth[at], frequencies[at])
        assert row == {name: value for name, value in alone.items() if name != "per_frequency"} | {
            "frequency_ghz": row["frequency_ghz"]
        }
    assert json.loads(json.dumps(report, allow_nan=False)) == report


def test_what_the_receiver_sees_is_scored_apart(pair):
    predicted, truth = pair
    sight, frequencies = np.array([True, False] * 4), np.full(8, 1e9)
    report = score(predicted, truth, frequencies, sight)
    for name, chosen in (("in_sight", sight), ("out_of_sight", ~sight)):
        alone = score(predicted[chosen], truth[chosen], frequencies[chosen])
        assert report[name] == {key: value for key, value in alone.items() if key != "per_frequency"}
    assert "out_of_sight" not in score(predicted, truth, frequencies, np.ones(8, bool))
    assert "in_sight" not in score(predicted, truth, frequencies)


def test_better_predictions_score_better(pair):
    predicted, truth = pair
    reports = [score(((1 - a) * predicted + a * truth), truth, np.ones(8)) for a in np.float32([0, 0.5, 0.9])]
    for key, direction in (("median_ssim", 1), ("mean_ssim", 1), ("psnr_db", 1), ("mae", -1)):
        assert np.all(np.diff([direction * report[key] for report in reports]) > 0), key


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_prediction_that_is_no_number_is_refused(pair, value):
    predicted, truth = pair
    predicted[3, 5, 7] = value
    with pytest.raises(UserError, match="1 of 8 predicted spectra"):
        score(predicted, truth, np.ones(8))


def test_nothing_to_score():
    with pytest.raises(UserError, match="no spectra"):
        score(np.zeros((0, 90, 360), np.float32), np.zeros((0, 90, 360), np.float32), np.zeros(0))


def test_a_scene_is_scored_in_seconds(rng):
    images = rng.random((40, 90, 360), np.float32)
    start = time.process_time()  # whatever else the machine does
    score(images, images[::-1], np.ones(40))
    assert (time.process_time() - start) / 40 * 1700 < 60  # a test split of 1,700 spectra takes 2 s of processor time
