"""What the results come to: the gain over WRF-GS, and what unseen frequencies cost."""

from pathlib import Path

import numpy as np

from experiments import figure7, figure8, table1, table3
from experiments.cells import NAMES, NOT_RUN, Scores, cell, paired_cells, scores
from experiments.jobs import BUDGETS
from experiments.paper import COMBINATIONS, GAIN, GHZ_10, GHZ_21, SCENES, TABLE_1_AVERAGE, TABLE_1_OVERALL, ZERO_SHOT_DROP
from experiments.report import markdown
from experiments.results import Results
from experiments.statistics import typical

TITLE = "Headline"
COMPARISONS = {
    # variant of ours, of WRF-GS: in words
    ("", ""): "Equal samples: all models of WRF-GS together see as many spectra as ours",
    ("long", "long"): f"Equal samples, {BUDGETS['long']} times as many",
    ("", "longest"): f"WRF-GS sees {BUDGETS['longest']} times our samples: as many for every frequency as ours for all",
}
UNSEEN = [float(f) for f in GHZ_21 if f not in COMBINATIONS["D"]]


def render(results: Results, images: Path) -> str:
    """The two comparisons the paper draws its conclusions from."""
    return "\n\n".join([gain_over_wrfgs(results), zero_shot_drop(results)])


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
            ours = scores(results, table1.jobs_of(scene, "wideband", own), GHZ_10)
            theirs = scores(results, table1.jobs_of(scene, "wrfgs", other), GHZ_10)
            rows.append([scene, *gain_cells(ours, theirs, TABLE_1_AVERAGE[scene])])
            if ours is not None and theirs is not None:
                pairs.append((average(ours), average(theirs)))
        rows.append(average_row(pairs))
        names = [f"{NAMES[model]} (paper)".replace(" (ours)", "") for model in (("wideband", own), ("wrfgs", other))]
        head = ["scene", *names, "gain (paper)", "better at", "median difference", "p"]
        parts += [f"*{words}:*", markdown(head, rows)]
    return "\n\n".join(parts)


def average(values: Scores) -> float:
    """Median over seeds of the average over frequencies."""
    return float(np.median(typical(values)))


def percent(ratio: float, paper: float | None = None) -> str:
    """A relative gain, the paper's behind it."""
    own = f"{100 * ratio:+.1f} %"
    return own if paper is None else f"{own} ({100 * paper:+.1f} %)"


def gain_cells(ours: Scores | None, theirs: Scores | None, paper: dict[str, float]) -> list[str]:
    """Both averages, the gain, the paired test."""
    values = [None if v is None else average(v) for v in (ours, theirs)]
    shown = [cell(v, paper[name]) for v, name in zip(values, ("wideband", "wrfgs"), strict=True)]
    if ours is None or theirs is None:
        return [*shown, NOT_RUN, *paired_cells(ours, theirs)]
    gain = percent(average(ours) / average(theirs) - 1, paper["wideband"] / paper["wrfgs"] - 1)
    return [*shown, gain, *paired_cells(ours, theirs)]


def average_row(pairs: list[tuple[float, float]]) -> list[str]:
    """Over the scenes that both have run in."""
    if not pairs:
        missing = [cell(None, TABLE_1_OVERALL[name]) for name in ("wideband", "wrfgs")]
        return ["**average**", *missing, f"{NOT_RUN} ({100 * GAIN:+.1f} %)", "", "", ""]
    label = "average" if len(pairs) == len(SCENES) else f"average of {len(pairs)} scenes"
    ours, theirs = np.mean(pairs, 0).tolist()
    shown = [cell(ours, TABLE_1_OVERALL["wideband"]), cell(theirs, TABLE_1_OVERALL["wrfgs"])]
    return [f"**{label}**", *shown, f"**{percent(ours / theirs - 1, GAIN)}**", "", "", ""]


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
