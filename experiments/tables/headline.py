"""What the results come to: the gain over WRF-GS, and what unseen frequencies cost."""

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.patches import Patch

from experiments.jobs import Job
from experiments.markdown import markdown
from experiments.paper import COMBINATIONS, GAIN, GHZ_10, GHZ_21, SCENES, TABLE_1_AVERAGE, TABLE_1_OVERALL, ZERO_SHOT_DROP
from experiments.results import Results
from experiments.statistics import gain, level
from experiments.tables import figure7, figure8, table1, table3
from experiments.tables.baselines import best_baseline
from experiments.tables.cells import NAMES, NOT_RUN, Scores, ceiling, cell, median_cell, paired_cells, percent, scores
from experiments.tables.plots import STYLES, save
from experiments.variants import HIGHER_RATE, VARIANTS

TITLE = "Headline by the presets of version 0.1"
Model = tuple[str, str]
"""A field and its variant."""
COMPARISONS: dict[tuple[Model, Model], str] = {
    # (ours, theirs): in words
    (("wideband", ""), ("wrfgs", "")): "equal samples",
    (("wideband", "fast"), ("wrfgs", "fast")): f"equal samples, learning rate {HIGHER_RATE:g}",
    (("wideband", "long"), ("wrfgs", "long")): f"equal samples, {VARIANTS['long'].budget:g} times as many",
    (("wideband", ""), ("wrfgs", "longest")): "WRF-GS sees as many for every frequency as ours for all",
    (("wave", ""), ("wrfgs", "longest")): "the same WRF-GS; the coherent field knows much more",
}
UNSEEN = [float(f) for f in GHZ_21 if f not in COMBINATIONS["D"]]


def jobs() -> list[Job]:
    """Jobs of table 1, and those with another learning rate."""
    models = dict.fromkeys(model for pair in COMPARISONS for model in pair)
    return [job for scene in SCENES for model in models for job in table1.jobs_of(scene, *model)]


def render(results: Results, images: Path) -> str:
    """A picture, the gain in short, what unseen frequencies cost, the gain scene by scene."""
    parts = [gain_in_short(results), zero_shot_drop(results), gain_by_scene(results)]
    bars = {m: [scores(results, table1.jobs_of(scene, *m), GHZ_10) for scene in SCENES] for m in table1.MODELS}
    if any(v is not None for values in bars.values() for v in values):
        nothing = [best_baseline(results, scene) for scene in SCENES]
        parts.insert(0, save(draw(bars, nothing), images, "headline", "average SSIM by scene and model"))
    return "\n\n".join(parts)


def draw(bars: dict[Model, list[Scores | None]], nothing: list[float | None]) -> plt.Figure:
    """A group a scene, a bar a model; lines for the ceiling and for what learns nothing."""
    figure, axis = plt.subplots(figsize=(8.5, 4), layout="constrained")
    width, legend = 0.8 / len(bars), list[Patch]()
    for i, (model, values) in enumerate(bars.items()):
        known = [(scene, v) for scene, v in enumerate(values) if v is not None]
        places = [scene + (i - (len(bars) - 1) / 2) * width for scene, _ in known]
        style = {"facecolor": STYLES[model]["color"], "alpha": 1 if model[1] == "long" or model[0] == "wave" else 0.5}
        style |= {"hatch": "//"} if model[1] == "longest" else {}
        axis.bar(places, [level(v) for _, v in known], 0.9 * width, **style)
        legend.append(Patch(label=NAMES[model], **style))
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


def gain_in_short(results: Results) -> str:
    """Averages over all scenes, a row a budget."""
    rows = []
    for (own, other), words in COMPARISONS.items():
        both = [pair_of(results, scene, own, other) for scene in SCENES]
        pairs = [(ours, theirs) for ours, theirs in both if ours is not None and theirs is not None]
        papers = [TABLE_1_OVERALL.get(own[0]), TABLE_1_OVERALL["wrfgs"]] if words == "equal samples" else [None, None]
        means = np.mean([[level(v) for v in pair] for pair in pairs], 0).tolist() if pairs else []
        above_it = percent(means[0] / means[1] - 1 if means else None, GAIN if all(papers) else None)
        above = sum(level(ours) > level(theirs) for ours, theirs in pairs)
        shown = [cell(value, paper) for value, paper in zip(means or [None, None], papers, strict=True)]
        rows.append([NAMES[own], NAMES[other], words, *shown, above_it, f"{above} of {len(pairs)}" if pairs else NOT_RUN])
    note = (
        "**Gain over WRF-GS**: averages over ten frequencies of the median SSIM, averaged over the scenes that both were run in"
        " (in parentheses the paper's, which trains all models in full). WRF-GS starts anew at every frequency and needs more"
        " samples than one model for all of them: rows with a rate that suits short trainings, and with more samples, say how"
        " much of the gain that is."
    )
    head = ["ours", "theirs", "", "ours (paper)", "theirs (paper)", "gain (paper)", "ours above in"]
    return note + "\n\n" + markdown(head, rows)


def gain_by_scene(results: Results) -> str:
    """Scene by scene and budget by budget, with a paired test."""
    parts = [
        "**Scene by scene**: the same, with a paired test over held-out transmitters: at how many of them ours is better (mean"
        " over frequencies, and over as many seeds of both), and the p-value of Wilcoxon's signed-rank test."
    ]
    for (own, other), words in COMPARISONS.items():
        rows = []
        for scene in SCENES:
            papers = [TABLE_1_AVERAGE[scene].get(field) if not variant else None for field, variant in (own, other)]
            rows.append([scene, *gain_cells(*pair_of(results, scene, own, other), papers)])
        known = {m: " (paper)" for m in (own, other) if m in (("wideband", ""), ("wrfgs", ""))}
        names = [NAMES[m].replace(" (ours)", "") + known.get(m, "") for m in (own, other)]
        head = ["scene", *names, "gain", "better at", "median difference", "p"]
        parts += [f"*{words[0].upper()}{words[1:]}:*", markdown(head, rows)]
    return "\n\n".join(parts)


def pair_of(results: Results, scene: str, own: Model, other: Model) -> tuple[Scores | None, Scores | None]:
    """Scores of two models in a scene at ten frequencies."""
    ours, theirs = (scores(results, table1.jobs_of(scene, *model), GHZ_10) for model in (own, other))
    return ours, theirs


def gain_cells(ours: Scores | None, theirs: Scores | None, papers: list[float | None]) -> list[str]:
    """Both averages, the gain, the paired test."""
    shown = [median_cell(v, paper) for v, paper in zip((ours, theirs), papers, strict=True)]
    return [*shown, percent(gain(ours, theirs)), *paired_cells(ours, theirs)]


def zero_shot_drop(results: Results) -> str:
    """Combination D against the field that saw all frequencies: as the paper compares, and like with like."""
    everything, blind = figure7.jobs_of("wideband"), figure7.jobs_of("wideband", "no_frequency")
    mixed = (scores(results, table3.cross_frequency("")), scores(results, everything))
    alike = (scores(results, figure8.held_out(), UNSEEN), scores(results, everything, UNSEEN))
    pooled = (scores(results, table3.cross_frequency("no_frequency")), scores(results, blind))
    as_paper = "as the paper: D at trained transmitters, unseen frequencies; all at held-out transmitters"
    rows = [
        [as_paper, *drop_cells(*mixed, ZERO_SHOT_DROP)],
        ["like with like: both at held-out transmitters, frequencies that D has not seen", *drop_cells(*alike)],
        ["as the paper, with a field that is not told the frequency", *drop_cells(*pooled)],
    ]
    note = (
        "**Unseen frequencies**: half of the 21 frequencies of scene 1 in training (combination D) against all of them. Where a"
        " field that is not told the frequency does as well (last row, and table 3), spectra change so little with it, beyond"
        " what phases do, that a small change here says little about generalisation ([why](decisions.md))."
    )
    head = ["comparison", "trained on D", "trained on all", "change (paper)"]
    return note + "\n\n" + markdown(head, rows)


def drop_cells(partial: Scores | None, full: Scores | None, paper: float | None = None) -> list[str]:
    """Both averages and the relative change; `paper` is the paper's drop."""
    change = percent(gain(partial, full), None if paper is None else -paper)
    return [median_cell(partial), median_cell(full), change]
