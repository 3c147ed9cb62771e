"""Summary of the results: wideband against WRF-GS, a model per frequency and pooled, the end of the curve, and the loss at
unseen frequencies."""

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.patches import Patch

from experiments.jobs import Job
from experiments.markdown import markdown
from experiments.paper import COMBINATIONS, GAIN, GHZ_10, GHZ_21, SCENES, TABLE_1_OVERALL, ZERO_SHOT_DROP
from experiments.results import Results
from experiments.series.comparisons import CURVE as CURVE_JOBS
from experiments.series.comparisons import SCENE_OF_CURVE
from experiments.statistics import gain, level
from experiments.tables import figure7, figure8, table1, table3
from experiments.tables.baselines import best_baseline
from experiments.tables.cells import (
    NAMES,
    NOT_RUN,
    Scores,
    ceiling,
    cell,
    median_cell,
    paired_cells,
    percent,
    scores,
    summary_cells,
)
from experiments.tables.plots import STYLES, save

TITLE = "Headline"
WIDEBAND, BY_FREQUENCY, POOLED = ("wideband", ""), ("wrfgs", ""), ("wideband", "pooled")
CURVE = {
    "wideband": ("wideband", ("", "long", "longest")),
    "WRF-GS, pooled": ("wideband", ("pooled", "pooled_long", "pooled_longest")),
    "WRF-GS, a model a frequency": ("wrfgs", ("", "long", "longest")),
    "NeRF2-style": ("nerf2", ("", "long")),
}
"""Entries of the curve: a field, and its variants with one, five and ten times the spectra."""
UNSEEN = [float(f) for f in GHZ_21 if f not in COMBINATIONS["D"]]
NOTE = (
    "**Gain over WRF-GS** with equal numbers of spectra seen; *pooled* is one WRF-GS model for all frequencies without a"
    " frequency input. Averages over ten frequencies of the medians over transmitters; in parentheses the paper's, which trains"
    " all models in full. The paired test is Wilcoxon's, over held-out transmitters."
)
CURVE_NOTE = (
    "**Gain against spectra seen**: WRF-GS starts anew at every frequency and needs more samples than one model for all of"
    " them. Scene {scene}, 8,000, 40,000 and 80,000 spectra; with 80,000 a model of WRF-GS sees as many at its frequency as the"
    " wideband field with 8,000 at all of them."
)
UNSEEN_NOTE = (
    "**Unseen frequencies**: half of the 21 frequencies of scene 1 in training (combination D) against all of them. Where a"
    " field without a frequency input does as well (last row, and table 3), spectra change so little with the frequency, apart"
    " from interference, that a small change here is weak evidence of generalisation ([why](decisions.md))."
)


def jobs() -> list[Job]:
    """Returns the jobs of the curve."""
    return CURVE_JOBS.jobs()


def render(results: Results, images: Path) -> str:
    """A picture, a table of six scenes, the curve of one, and what unseen frequencies cost."""
    parts = [NOTE, by_scene(results), CURVE_NOTE.format(scene=SCENE_OF_CURVE), against_spectra(results)]
    parts += [UNSEEN_NOTE, zero_shot_drop(results)]
    bars = {m: [scores(results, table1.jobs_of(scene, *m), GHZ_10) for scene in SCENES] for m in table1.MODELS}
    if any(v is not None for values in bars.values() for v in values):
        nothing = [best_baseline(results, scene) for scene in SCENES]
        parts.insert(0, save(draw(bars, nothing), images, "headline", "average SSIM by scene and model"))
    return "\n\n".join(parts)


def draw(bars: dict[tuple[str, str], list[Scores | None]], nothing: list[float | None]) -> plt.Figure:
    """A group a scene, a bar a model; lines for the ceiling and for what learns nothing."""
    figure, axis = plt.subplots(figsize=(8.5, 4), layout="constrained")
    width, legend = 0.8 / len(bars), list[Patch]()
    for i, (model, values) in enumerate(bars.items()):
        known = [(scene, v) for scene, v in enumerate(values) if v is not None]
        places = [scene + (i - (len(bars) - 1) / 2) * width for scene, _ in known]
        axis.bar(places, [level(v) for _, v in known], 0.9 * width, color=STYLES[model]["color"])
        legend.append(Patch(label=NAMES[model], color=STYLES[model]["color"]))
    best = [ceiling(scene, GHZ_10) for scene in SCENES]
    lines = []
    for levels, line, label in ((best, "-", "phase-blind ceiling"), (nothing, ":", "best that learns nothing")):
        shown = [(scene, value) for scene, value in enumerate(levels) if value is not None]
        left, right = ([scene + side for scene, _ in shown] for side in (-0.43, 0.43))
        lines.append(axis.hlines([v for _, v in shown], left, right, color="k", lw=1.2, ls=line, label=label))
    axis.set(xticks=range(len(SCENES)), xticklabels=[f"scene {scene}" for scene in SCENES], ylabel="SSIM", ylim=(0, 1))
    axis.grid(axis="y", alpha=0.3)
    axis.legend(handles=[*legend, *lines], fontsize=7.5, ncols=4, loc="lower center", framealpha=0.95)
    return figure


def found(results: Results, scene: str, field: str, variant: str) -> Scores | None:
    """Returns the scores of all seeds that were run."""
    return scores(results, table1.jobs_of(scene, field, variant), GHZ_10)


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
        pair = [cell(ours, TABLE_1_OVERALL["wideband"]), cell(theirs, TABLE_1_OVERALL["wrfgs"])]
        average = [*pair, percent(ours / theirs - 1, GAIN), "", "", f"{pooled:.3f}"]
        rows.append([f"average of {len(levels)} (paper)", *average])
    head = ["scene", "wideband (95 %)", "WRF-GS (95 %)", "gain", "better at", "median difference", "WRF-GS, pooled"]
    return markdown(head, rows)


def against_spectra(results: Results) -> str:
    """A row a model, a column a number of spectra."""
    rows, known = [], {}
    for name, (field, variants) in CURVE.items():
        known[name] = [found(results, SCENE_OF_CURVE, field, variant) for variant in variants]
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


def zero_shot_drop(results: Results) -> str:
    """Combination D against the field that saw all frequencies: as the paper compares, and like with like."""
    everything, blind = figure7.jobs_of("wideband"), figure7.jobs_of("wideband", "pooled")
    mixed = (scores(results, table3.cross_frequency("")), scores(results, everything))
    alike = (scores(results, figure8.held_out(), UNSEEN), scores(results, everything, UNSEEN))
    pooled = (scores(results, table3.cross_frequency("pooled")), scores(results, blind))
    as_paper = "as the paper: D at trained transmitters, unseen frequencies; all at held-out transmitters"
    rows = [
        [as_paper, *drop_cells(*mixed, ZERO_SHOT_DROP)],
        ["like with like: both at held-out transmitters, frequencies that D has not seen", *drop_cells(*alike)],
        ["as the paper, with a field without a frequency input", *drop_cells(*pooled)],
    ]
    return markdown(["comparison", "trained on D", "trained on all", "change (paper)"], rows)


def drop_cells(partial: Scores | None, full: Scores | None, paper: float | None = None) -> list[str]:
    """Both averages and the relative change; `paper` is the paper's drop."""
    change = percent(gain(partial, full), None if paper is None else -paper)
    return [median_cell(partial), median_cell(full), change]
