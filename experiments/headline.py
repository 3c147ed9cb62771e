"""What the results come to: the gain over WRF-GS, and what unseen frequencies cost."""

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

from experiments import figure7, figure8, table1, table3
from experiments.baselines import NAMES_OF_REFERENCES, reference_average
from experiments.cells import NAMES, NOT_RUN, Scores, ceiling, cell, paired_cells, scores
from experiments.jobs import BUDGETS, REFERENCES, Job
from experiments.paper import COMBINATIONS, GAIN, GHZ_10, GHZ_21, SCENES, TABLE_1_AVERAGE, TABLE_1_OVERALL, ZERO_SHOT_DROP
from experiments.plots import STYLES, save
from experiments.report import markdown
from experiments.results import Results
from experiments.statistics import typical

TITLE = "Headline"
COMPARISONS = {
    # (ours, theirs), each a field and its variant: in words
    (("wideband", ""), ("wrfgs", "")): "Equal samples: all models of WRF-GS together see as many spectra as ours",
    (("wideband", "long"), ("wrfgs", "long")): f"Equal samples, {BUDGETS['long']} times as many",
    (("wideband", ""), ("wrfgs", "longest")): (
        f"WRF-GS sees {BUDGETS['longest']} times our samples: as many for every frequency as ours for all"
    ),
    (("wave", ""), ("wrfgs", "longest")): "The coherent field against the same",
}
UNSEEN = [float(f) for f in GHZ_21 if f not in COMBINATIONS["D"]]


def render(results: Results, images: Path) -> str:
    """The two comparisons the paper draws its conclusions from, and a picture of the first."""
    parts = [gain_over_wrfgs(results), zero_shot_drop(results)]
    bars = {m: [scores(results, table1.jobs_of(scene, *m), GHZ_10) for scene in SCENES] for m in table1.MODELS}
    if any(v is not None for values in bars.values() for v in values):
        parts.insert(0, save(draw(bars, best_of_nothing(results)), images, "headline", "average SSIM by scene and model"))
    return "\n\n".join(parts)


def best_of_nothing(results: Results) -> list[float | None]:
    """Scene by scene, the best predictor that learns nothing."""
    found = [[reference_average(results, Job(scene, REFERENCES), name) for name in NAMES_OF_REFERENCES] for scene in SCENES]
    return [max((v for v in values if v is not None), default=None) for values in found]


def draw(bars: dict[tuple[str, str], list[Scores | None]], nothing: list[float | None]) -> plt.Figure:
    """A group a scene, a bar a model; lines for the ceiling and for what learns nothing."""
    figure, axis = plt.subplots(figsize=(8.5, 4), layout="constrained")
    width = 0.8 / len(bars)
    for i, (model, values) in enumerate(bars.items()):
        places = [scene + (i - (len(bars) - 1) / 2) * width for scene, v in enumerate(values) if v is not None]
        heights = [average(v) for v in values if v is not None]
        style = {"hatch": "//", "alpha": 0.5} if STYLES[model].get("ls") else {"alpha": 0.5 if model[1] == "longest" else 1}
        axis.bar(places, heights, 0.9 * width, color=STYLES[model]["color"], label=NAMES[model], **style)
    best = [ceiling(scene, GHZ_10) for scene in SCENES]
    for levels, line, label in ((best, "-", "phase-blind ceiling"), (nothing, ":", "best that learns nothing")):
        known = [(scene, level) for scene, level in enumerate(levels) if level is not None]
        left, right = ([scene + side for scene, _ in known] for side in (-0.43, 0.43))
        axis.hlines([level for _, level in known], left, right, color="k", lw=1.2, ls=line, label=label)
    axis.set(xticks=range(len(SCENES)), xticklabels=[f"scene {scene}" for scene in SCENES], ylabel="SSIM", ylim=(0, 1))
    axis.grid(axis="y", alpha=0.3)
    axis.legend(fontsize=7.5, ncols=4, loc="lower center", framealpha=0.95)
    return figure


def gain_over_wrfgs(results: Results) -> str:
    """Scene by scene and budget by budget, with a paired test; the averages below."""
    parts = [
        "**Gain over WRF-GS**: averages over ten frequencies of the median SSIM (in parentheses the paper's), the relative"
        " gain, and a paired test over held-out transmitters: at how many of them ours is better (mean over frequencies and"
        " seeds), and the p-value of Wilcoxon's signed-rank test."
    ]
    for (own, other), words in COMPARISONS.items():
        rows, pairs = [], []
        for scene in SCENES:
            ours = scores(results, table1.jobs_of(scene, *own), GHZ_10)
            theirs = scores(results, table1.jobs_of(scene, *other), GHZ_10)
            papers = [TABLE_1_AVERAGE[scene].get(field) for field, _ in (own, other)]
            rows.append([scene, *gain_cells(ours, theirs, papers)])
            if ours is not None and theirs is not None:
                pairs.append((average(ours), average(theirs)))
        rows.append(average_row(pairs, [TABLE_1_OVERALL.get(field) for field, _ in (own, other)]))
        names = [NAMES[model].replace(" (ours)", "") + " (paper)" * (model[0] in TABLE_1_OVERALL) for model in (own, other)]
        head = ["scene", *names, "gain" + " (paper)" * (own[0] in TABLE_1_OVERALL), "better at", "median difference", "p"]
        parts += [f"*{words}:*", markdown(head, rows)]
    return "\n\n".join(parts)


def average(values: Scores) -> float:
    """Median over seeds of the average over frequencies."""
    return float(np.median(typical(values)))


def percent(ratio: float, paper: float | None = None) -> str:
    """A relative gain, the paper's behind it."""
    own = f"{100 * ratio:+.1f} %"
    return own if paper is None else f"{own} ({100 * paper:+.1f} %)"


def gain_cells(ours: Scores | None, theirs: Scores | None, papers: list[float | None]) -> list[str]:
    """Both averages, the gain, the paired test."""
    values = [None if v is None else average(v) for v in (ours, theirs)]
    shown = [cell(v, paper) for v, paper in zip(values, papers, strict=True)]
    if ours is None or theirs is None:
        return [*shown, NOT_RUN, *paired_cells(ours, theirs)]
    own, other = papers
    gain = percent(average(ours) / average(theirs) - 1, own / other - 1 if own and other else None)
    return [*shown, gain, *paired_cells(ours, theirs)]


def average_row(pairs: list[tuple[float, float]], papers: list[float | None]) -> list[str]:
    """Over the scenes that both have run in."""
    gain = GAIN if all(papers) else None
    if not pairs:
        missing = [cell(None, paper) for paper in papers]
        return ["**average**", *missing, NOT_RUN if gain is None else f"{NOT_RUN} ({100 * gain:+.1f} %)", "", "", ""]
    label = "average" if len(pairs) == len(SCENES) else f"average of {len(pairs)} scenes"
    means = np.mean(pairs, 0).tolist()
    shown = [cell(value, paper) for value, paper in zip(means, papers, strict=True)]
    return [f"**{label}**", *shown, f"**{percent(means[0] / means[1] - 1, gain)}**", "", "", ""]


def zero_shot_drop(results: Results) -> str:
    """Combination D against the field that saw all frequencies: as the paper compares, and like with like."""
    everything = figure7.jobs_of("wideband")
    mixed = (scores(results, table3.cross_frequency("")), scores(results, everything))
    alike = (scores(results, figure8.held_out(), UNSEEN), scores(results, everything, UNSEEN))
    rows = [
        [
            "as the paper: D at trained transmitters, unseen frequencies; all at held-out transmitters",
            *drop_cells(*mixed, True),
        ],
        ["like with like: both at held-out transmitters, frequencies that D has not seen", *drop_cells(*alike, False)],
    ]
    note = "**Unseen frequencies**: half of the 21 frequencies of scene 1 in training (combination D) against all of them."
    head = ["comparison", "trained on D", "trained on all", "drop (paper)"]
    return note + "\n\n" + markdown(head, rows)


def drop_cells(partial: Scores | None, full: Scores | None, as_paper: bool) -> list[str]:
    """Both averages and the relative drop."""
    shown = [cell(None if v is None else average(v)) for v in (partial, full)]
    if partial is None or full is None:
        return [*shown, NOT_RUN]
    drop = 1 - average(partial) / average(full)
    return [*shown, f"{100 * drop:.1f} %" + (f" ({100 * ZERO_SHOT_DROP:.1f} %)" if as_paper else "")]
