"""Statistics of scores of a few hundred transmitters and a few seeds: intervals, seeds, paired tests.

Spectra of one transmitter at several frequencies are no independent samples, so the transmitter is what is drawn again and
what is paired. All scores of a row come as (seeds, transmitters, frequencies).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import wilcoxon

DRAWS, AT_ONCE = 1000, 50
LEVEL = 0.95
SEED = 0
"""Seed of the bootstrap."""


@dataclass(frozen=True)
class Estimate:
    """A median SSIM with its bootstrap interval over transmitters and seeds, and the seeds' own values."""

    value: float
    low: float
    high: float
    seeds: tuple[float, ...]


def typical(scores: Float[np.ndarray, "*seeds tx ghz"]) -> Float[np.ndarray, "*seeds"]:
    """Returns the median over transmitters at every frequency, averaged over frequencies: the paper's "Avg." """
    return np.median(scores, axis=-2).mean(-1)


def level(scores: Float[np.ndarray, "seeds tx ghz"]) -> float:
    """Returns the median over seeds of `typical`: what stands in a cell."""
    return float(np.median(typical(scores)))


def gain(ours: Float[np.ndarray, "seeds tx ghz"] | None, theirs: Float[np.ndarray, "seeds2 tx ghz"] | None) -> float | None:
    """Returns by how much one level is above another, relative to that; None if one of them is missing."""
    return None if ours is None or theirs is None else level(ours) / level(theirs) - 1


def estimate(scores: Float[np.ndarray, "seeds tx ghz"]) -> Estimate:
    """Returns the level, and the interval of drawing other transmitters from the same scene, and other seeds.

    Both are drawn at once, which `scipy.stats.bootstrap` does not do: it draws along one axis.
    """
    rng = np.random.default_rng(SEED)
    k, n, _ = scores.shape
    drawn = [np.ix_(rng.integers(0, k, (k,)), rng.integers(0, n, (n,))) for _ in range(DRAWS)]
    blocks = (drawn[start : start + AT_ONCE] for start in range(0, DRAWS, AT_ONCE))
    levels = np.concatenate([np.median(typical(np.stack([scores[i] for i in block])), -1) for block in blocks])
    low, high = np.quantile(levels, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Estimate(level(scores), float(low), float(high), tuple(typical(scores).tolist()))


@dataclass(frozen=True)
class Comparison:
    """One field against another on the same transmitters."""

    difference: float
    """Median over transmitters of the difference of their mean SSIM."""
    share: float
    """Share of the transmitters at which the first is better."""
    p: float
    """Wilcoxon's signed-rank test, two-sided."""
    transmitters: int


def compare(ours: Float[np.ndarray, "seeds tx ghz"], theirs: Float[np.ndarray, "seeds2 tx ghz"]) -> Comparison:
    """Returns the test paired over transmitters, each with the mean of its spectra and of as many seeds on both sides, the
    first ones."""
    seeds = min(len(ours), len(theirs))
    gap = ours[:seeds].mean((0, 2)) - theirs[:seeds].mean((0, 2))
    p = float(wilcoxon(gap).pvalue) if np.any(gap) else 1.0
    return Comparison(float(np.median(gap)), float(np.mean(gap > 0)), p, len(gap))
