"""Scores of predicted spectra, in total, by frequency and by visibility: SSIM (scikit-image's), PSNR, MAE, errors of the
strongest direction, and the power lost by choosing beams from predicted spectra.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float, Int
from skimage.metrics import structural_similarity

from wbgs_jax._util.errors import UserError
from wbgs_jax.radio.array import codebook, peak_direction_error

FAINTEST_DB = -60.0
"""Power relative to the best beam below which a beam counts as receiving nothing."""


def beam_loss_db(
    predicted: Float[np.ndarray, "n 90 360"], truth: Float[np.ndarray, "n 90 360"], tried: int = 1
) -> Float[np.ndarray, " n"]:
    """Returns the power (dB, at least 0) lost relative to the codebook's best beam.

    The `tried` beams that the predicted spectrum ranks highest are compared in the true one, and the best of them is used. A
    beam is a pixel of the spectrum, which is an amplitude; power is its square.
    """
    expected, received = (spectra.reshape(len(spectra), -1)[:, codebook()] for spectra in (predicted, truth))
    ranked = np.argsort(-expected, axis=1, kind="stable")[:, :tried]
    used = np.take_along_axis(received, ranked, 1).max(1).astype(np.float64)
    best = received.max(1).astype(np.float64)
    ratio = np.where(best > 0, used / np.where(best > 0, best, 1), 1)
    return -20 * np.log10(np.maximum(ratio, 10 ** (FAINTEST_DB / 20)))


PSNR_LIMIT_DB = 100.0
"""PSNR reported for a perfect prediction, whose PSNR is infinite."""


def ssim(predicted: Float[np.ndarray, "n 90 360"], truth: Float[np.ndarray, "n 90 360"]) -> Float[np.ndarray, " n"]:
    """Returns the structural similarity of every spectrum, float64: scikit-image, data_range 1, its default 7 x 7 window."""

    def one(p: Float[np.ndarray, "90 360"], t: Float[np.ndarray, "90 360"]) -> float:
        return float(structural_similarity(p.astype(np.float64), t.astype(np.float64), data_range=1.0))

    if len(predicted) != len(truth):
        raise ValueError(f"{len(predicted)} spectra cannot be compared with {len(truth)}")
    # Its filters release the interpreter's lock; more threads than processors wait for each other's memory.
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        return np.array(list(threads.map(one, predicted, truth)), np.float64)


def mae(predicted: Float[np.ndarray, "n 90 360"], truth: Float[np.ndarray, "n 90 360"]) -> Float[np.ndarray, " n"]:
    """Returns the mean absolute error of every spectrum, float64."""
    pairs = zip(predicted, truth, strict=True)  # one at a time: float64 copies of a whole scene take gigabytes
    return np.array([np.mean(np.abs(p.astype(np.float64) - t)) for p, t in pairs])


def psnr_db(predicted: Float[np.ndarray, "n 90 360"], truth: Float[np.ndarray, "n 90 360"]) -> Float[np.ndarray, " n"]:
    """Returns the peak signal-to-noise ratio (dB, peak 1) of every spectrum, float64, at most `PSNR_LIMIT_DB`."""
    pairs = zip(predicted, truth, strict=True)
    error = np.array([np.mean((p.astype(np.float64) - t) ** 2) for p, t in pairs])
    return -10 * np.log10(np.maximum(error, 10 ** (-PSNR_LIMIT_DB / 10)))


def score(
    predicted: Float[np.ndarray, "n 90 360"],
    truth: Float[np.ndarray, "n 90 360"],
    frequencies_hz: Float[np.ndarray, " n"],
    sight: Bool[np.ndarray, " n"] | None = None,
    element_positions: Float[Array | np.ndarray, "elements 3"] | None = None,
) -> dict[str, Any]:
    """Returns a report of predicted spectra, ready for JSON.

    Args:
        predicted: spectra in 0..1.
        truth: observed spectra.
        frequencies_hz: of every spectrum.
        sight: whether there is a line of sight to the transmitter, if known.
        element_positions: of the array, for directions that it receives alike (`radio.peak_direction_error`).

    Returns:
        n; median_ssim, mean_ssim and the percentiles p5_ssim, p10_ssim; psnr_db (median); mae (mean); angle_error_deg of the
        strongest direction (median); beam_loss_db and beam_loss_top3_db, the power lost by using the best of one or three
        predicted beams (means). The same figures are in per_frequency, a list by ascending frequency_ghz, and, if `sight` is
        given and there are such spectra, in in_sight and out_of_sight.

    Raises:
        UserError: there are no spectra, or a prediction contains NaN or infinity.
    """
    return summarise(figures(predicted, truth, element_positions), frequencies_hz, sight)


def figures(
    predicted: Float[np.ndarray, "n 90 360"],
    truth: Float[np.ndarray, "n 90 360"],
    element_positions: Float[Array | np.ndarray, "elements 3"] | None = None,
) -> dict[str, Float[np.ndarray, " n"]]:
    """Returns the figures of `score` for every spectrum; raises the same errors."""
    if len(predicted) == 0:
        raise UserError("there are no spectra to score; choose a split or frequencies with at least one test spectrum")
    if broken := sum(not np.isfinite(p).all() for p in predicted):
        raise UserError(f"{broken} of {len(predicted)} predicted spectra contain NaN or infinity; the model diverged")
    return {
        "ssim": ssim(predicted, truth),
        "psnr_db": psnr_db(predicted, truth),
        "mae": mae(predicted, truth),
        "angle_error_deg": np.asarray(peak_direction_error(predicted, truth, element_positions)),
        "beam_loss_db": beam_loss_db(predicted, truth),
        "beam_loss_top3_db": beam_loss_db(predicted, truth, 3),
    }


def summarise(
    values: dict[str, Float[np.ndarray, " n"]],
    frequencies_hz: Float[np.ndarray, " n"],
    sight: Bool[np.ndarray, " n"] | None = None,
    receiver: Int[np.ndarray, " n"] | None = None,
) -> dict[str, Any]:
    """Returns the report of `score` computed from the figures of all spectra. If the receivers of the spectra are given and
    there are several, the same figures are also in per_receiver."""

    def part(chosen: Bool[np.ndarray, " n"]) -> dict[str, Any]:
        return _summary({name: value[chosen] for name, value in values.items()})

    report = _summary(values)
    if sight is not None:
        report |= {name: part(where) for name, where in (("in_sight", sight), ("out_of_sight", ~sight)) if where.any()}
    if receiver is not None and len(numbers := np.unique(receiver)) > 1:
        report["per_receiver"] = [{"receiver": int(number)} | part(receiver == number) for number in numbers]
    by_frequency = ((f, part(frequencies_hz == f)) for f in np.unique(frequencies_hz))
    return report | {"per_frequency": [{"frequency_ghz": float(f / 1e9)} | summary for f, summary in by_frequency]}


def _summary(values: dict[str, np.ndarray]) -> dict[str, Any]:
    return {
        "n": len(values["ssim"]),
        "median_ssim": float(np.median(values["ssim"])),
        "mean_ssim": float(np.mean(values["ssim"])),
        "p5_ssim": float(np.percentile(values["ssim"], 5)),
        "p10_ssim": float(np.percentile(values["ssim"], 10)),
        "psnr_db": float(np.median(values["psnr_db"])),
        "mae": float(np.mean(values["mae"])),
        "angle_error_deg": float(np.median(values["angle_error_deg"])),
        "beam_loss_db": float(np.mean(values["beam_loss_db"])),
        "beam_loss_top3_db": float(np.mean(values["beam_loss_top3_db"])),
    }
