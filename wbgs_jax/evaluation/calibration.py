"""Whether a field knows how good it is: intervals that hold what they promise, and scores that rise when doubtful answers are
left out."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import rankdata

from wbgs_jax.inference.confidence import Expected, ExpectedPower

COVERAGES = (1.0, 0.9, 0.75, 0.5, 0.25, 0.1)
"""Shares of the answers, the surest ones, whose mean score is reported."""


def calibration(expected: Expected, scores: Float[np.ndarray, " n"], level: float) -> dict[str, Any]:
    """Returns how the expected SSIM of answers compares with what they scored: `coverage` of the intervals and their mean
    `width`, the mean `expected` and true `scored` SSIM, their rank `correlation` (Spearman), and the `risk_coverage` curve: the
    mean SSIM of the surest share."""
    expectation, low, high = (np.asarray(values, np.float64) for values in expected)
    held = (low <= scores) & (scores <= high)
    return _figures(expectation, scores, -expectation, held, level) | {"width": float(np.mean(np.minimum(high, 1) - low))}


def power_calibration(expected: ExpectedPower, errors_db: Float[np.ndarray, " n"], level: float) -> dict[str, Any]:
    """Returns how the expected errors of received powers compare with the true absolute ones (dB): `coverage` of what they were
    to stay within, its mean `within_db`, the mean `expected` and true `scored` error, their rank `correlation`, and the
    `risk_coverage` curve: the mean error of the surest share."""
    expectation, within = (np.asarray(values, np.float64) for values in expected)
    return _figures(expectation, errors_db, expectation, errors_db <= within, level) | {"within_db": float(within.mean())}


def _figures(
    expectation: Float[np.ndarray, " n"],
    truth: Float[np.ndarray, " n"],
    doubt: Float[np.ndarray, " n"],
    held: Bool[np.ndarray, " n"],
    level: float,
) -> dict[str, Any]:
    """Returns what both have in common; `doubt` orders the answers, the surest first, and those of equal doubt count as their
    mean."""
    ranks, equal = np.unique(doubt, return_inverse=True)
    means = np.bincount(equal, truth, len(ranks)) / np.bincount(equal, minlength=len(ranks))
    surest = means[np.sort(equal)]
    return {
        "level": round(level, 4),
        "coverage": float(held.mean()),
        "expected": float(expectation.mean()),
        "scored": float(truth.mean()),
        "correlation": _rank_correlation(expectation, truth),
        "risk_coverage": {f"{share:g}": float(surest[: max(1, round(share * len(truth)))].mean()) for share in COVERAGES},
    }


def _rank_correlation(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> float:
    """Returns Spearman's; 0 where one of both is constant."""
    ranks = [rankdata(values) for values in (a, b)]
    return float(np.corrcoef(*ranks)[0, 1]) if min(map(np.ptp, ranks)) > 0 else 0.0
