"""Whether a field knows how good it is: intervals that hold what they promise, and scores that rise when doubtful answers are
left out."""

from typing import Any

import numpy as np
from jaxtyping import Float

from wbgs_jax.inference.confidence import LEVEL, Expected

COVERAGES = (1.0, 0.9, 0.75, 0.5, 0.25, 0.1)
"""Shares of the answers, the surest ones, whose mean score is reported."""


def calibration(expected: Expected, scores: Float[np.ndarray, "n"]) -> dict[str, Any]:
    """Returns how the expected SSIM of answers compares with what they scored: `coverage` of the intervals and their mean
    `width`, the mean `expected` and true `scored` SSIM, their rank `correlation` (Spearman), and the `risk_coverage` curve: the
    mean SSIM of the surest share."""
    expectation, low, high = (np.asarray(values, np.float64) for values in expected)
    order = np.argsort(-expectation, kind="stable")
    curve = {f"{share:g}": float(scores[order[: max(1, round(share * len(scores)))]].mean()) for share in COVERAGES}
    return {
        "level": LEVEL,
        "coverage": float(np.mean((low <= scores) & (scores <= high))),
        "width": float(np.mean(np.minimum(high, 1) - low)),
        "expected": float(expectation.mean()),
        "scored": float(scores.mean()),
        "correlation": _rank_correlation(expectation, scores),
        "risk_coverage": curve,
    }


def _rank_correlation(a: Float[np.ndarray, "n"], b: Float[np.ndarray, "n"]) -> float:
    ranks = [np.argsort(np.argsort(values, kind="stable")).astype(float) for values in (a, b)]
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1]) if len(a) > 1 else 0.0
