"""The comparison by today's presets: wideband against WRF-GS, a model a frequency and pooled, and where the curve leads."""

from pathlib import Path

import numpy as np

from experiments.jobs import Job
from experiments.markdown import markdown
from experiments.paper import GAIN, GHZ_10, SCENES
from experiments.results import Results
from experiments.series import curve
from experiments.statistics import gain, level
from experiments.tables.cells import NOT_RUN, Scores, median_cell, paired_cells, percent, scores, summary_cells

TITLE = "Headline"
WIDEBAND, BY_FREQUENCY, POOLED = ("wideband", ""), ("wrfgs", ""), ("wideband", "pooled")
CURVE = {
    "wideband": ("wideband", ("", "long", "longest")),
    "WRF-GS, pooled": ("wideband", ("pooled", "pooled_long", "pooled_longest")),
    "WRF-GS, a model a frequency": ("wrfgs", ("", "long", "longest")),
    "NeRF2-style": ("nerf2", ("", "long")),
}
"""What is on the curve: a field, and its variants with one, five and ten times the spectra."""
NOTE = (
    "The presets that a user gets now, with 1,000 Gaussians and 8,000 spectra seen (1,000 steps of 8). Optimisers, rates,"
    " layers and loss were chosen on a validation part of the training transmitters; inputs and octaves are older, chosen on"
    " held-out transmitters of scenes 1 and 4. *Pooled* is one WRF-GS model for all frequencies that is told none of them."
    " Averages over ten frequencies of the medians over transmitters; in parentheses the paper's gain. The paired test is"
    " Wilcoxon's, over held-out transmitters."
)
CURVE_NOTE = (
    "Scene {scene}, spectra seen: 8,000, 40,000 and 80,000. Gain: of the wideband field over WRF-GS, a model a frequency."
)


def jobs() -> list[Job]:
    """Returns the jobs of the curve."""
    return curve.jobs()


def render(results: Results, images: Path) -> str:
    """A table of six scenes, and the curve of one."""
    return "\n\n".join([NOTE, by_scene(results), CURVE_NOTE.format(scene=curve.SCENE), against_spectra(results)])


def found(results: Results, scene: str, field: str, variant: str) -> Scores | None:
    """Returns the scores of all seeds that were run."""
    own = [job for job in jobs() if (job.scene, job.field, job.variant) == (scene, field, variant)]
    return scores(results, own, GHZ_10)


def by_scene(results: Results) -> str:
    """A row a scene, and their average."""
    rows, levels = [], []
    for scene in SCENES:
        ours, theirs, pooled = (found(results, scene, *model) for model in (WIDEBAND, BY_FREQUENCY, POOLED))
        shown = [summary_cells(ours), summary_cells(theirs)]
        both = [" ".join([value, f"({interval})"]) for value, interval, _ in shown]
        rows.append([scene, *both, percent(gain(ours, theirs)), *paired_cells(ours, theirs)[:2], median_cell(pooled)])
        if ours is not None and theirs is not None and pooled is not None:
            levels.append([level(ours), level(theirs), level(pooled)])
    if levels:
        ours, theirs, pooled = np.mean(levels, 0).tolist()
        average = [f"{ours:.3f}", f"{theirs:.3f}", percent(ours / theirs - 1, GAIN), "", "", f"{pooled:.3f}"]
        rows.append([f"average of {len(levels)}", *average])
    head = ["scene", "wideband (95 %)", "WRF-GS (95 %)", "gain (paper)", "better at", "median difference", "WRF-GS, pooled"]
    return markdown(head, rows)


def against_spectra(results: Results) -> str:
    """A row a model, a column a number of spectra."""
    rows, known = [], {}
    for name, (field, variants) in CURVE.items():
        known[name] = [found(results, curve.SCENE, field, variant) for variant in variants]
        cells = [_with_seeds(values) for values in known[name]]
        rows.append([name, *cells, *[""] * (3 - len(cells))])
    pairs = zip(known["wideband"], known["WRF-GS, a model a frequency"], strict=True)
    rows.append(["gain", *(percent(gain(ours, theirs)) for ours, theirs in pairs)])
    return markdown(["model", "1x", "5x", "10x"], rows)


def _with_seeds(values: Scores | None) -> str:
    if values is None:
        return NOT_RUN
    seeds = len(values)
    return f"{level(values):.3f} ({seeds} seed{'s' if seeds > 1 else ''})"
