"""Parts of tables: scores of a row over its seeds, cells with the paper's value, and marks for what was not run."""

import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from experiments.jobs import Job
from experiments.results import Results
from experiments.statistics import compare, estimate, level
from wbgs_jax.data import released_scenes
from wbgs_jax.data.scene_file import load_scene
from wbgs_jax.evaluation.score import repeatability

NOT_RUN = "not run yet"
Scores = Float[np.ndarray, "seeds tx ghz"]
NAMES = {
    ("wideband", ""): "wideband (ours)",
    ("wideband", "long"): "wideband (ours), 5x samples",
    ("wideband", "pooled"): "WRF-GS, pooled",
    ("wave", ""): "coherent (ours)",
    ("wrfgs", ""): "WRF-GS",
    ("wrfgs", "long"): "WRF-GS, 5x samples",
    ("wrfgs", "longest"): "WRF-GS, 10x samples",
    ("nerf2", ""): "NeRF2-style",
}
"""Names of fields and variants in tables."""


def scores(results: Results, jobs: Sequence[Job], ghz: Sequence[float] = (), tx: Sequence[int] = ()) -> Scores | None:
    """SSIM of the seeds that were run, at some of the frequencies and transmitters (default: all that were asked); None if
    there are none."""
    found = results.all(list(jobs))
    if not found:
        return None
    return np.stack([result.at(list(ghz) or result.ghz, list(tx) or result.tx.tolist()) for result in found])


def cell(value: float | None, paper: float | None = None) -> str:
    """A figure, the paper's behind it in parentheses."""
    own = NOT_RUN if value is None else f"{value:.3f}"
    return own if paper is None else f"{own} ({paper:.2f})"


def percent(ratio: float | None, paper: float | None = None) -> str:
    """A relative gain, the paper's behind it."""
    own = NOT_RUN if ratio is None else f"{100 * ratio:+.1f} %"
    return own if paper is None else f"{own} ({100 * paper:+.1f} %)"


def median_cell(values: Scores | None, paper: float | None = None) -> str:
    """Median over seeds of the average of medians."""
    return cell(None if values is None else level(values), paper)


def summary_cells(values: Scores | None, paper: float | None = None) -> list[str]:
    """Median over seeds of the average of medians, its interval over transmitters and seeds, the seeds and their range."""
    if values is None:
        return [cell(None, paper), NOT_RUN, NOT_RUN]
    found = estimate(values)
    seeds = f"{len(found.seeds)}"
    if len(found.seeds) > 1:
        seeds += f": {min(found.seeds):.3f}-{max(found.seeds):.3f}"
    return [cell(found.value, paper), f"{found.low:.3f}-{found.high:.3f}", seeds]


def paired_cells(ours: Scores | None, theirs: Scores | None) -> list[str]:
    """At how many transmitters ours is better, the median difference, and the p-value of the paired test."""
    if ours is None or theirs is None:
        return [NOT_RUN] * 3
    test = compare(ours, theirs)
    return [f"{100 * test.share:.0f} % of {test.transmitters}", f"{test.difference:+.3f}", f"{test.p:.1e}"]


SUMMARY = ("average (paper)", "95 %", "seeds")
"""Headings of `summary_cells`."""


@functools.cache
def ceilings(scene: str) -> dict[float, float]:
    """Frequency (GHz): the score of the best possible phase-blind predictor, from the scene file."""
    rows = load_scene(released_scenes()[scene]).meta.get("ceilings", [])
    return {float(row["frequency_ghz"]): float(row["phase_blind"]) for row in rows}


def ceiling(scene: str, ghz: Sequence[float]) -> float | None:
    """Their average over frequencies."""
    known = ceilings(scene)
    return float(np.mean([known[f] for f in ghz])) if known else None


def truth_repeats(scene: str, ghz: Sequence[float]) -> float | None:
    """The truth's own repeatability, its average over frequencies."""
    return repeatability(f"scene{scene}", map(float, ghz))
