"""Figure 7: scene 1 at 21 frequencies, one field for all of them against a WRF-GS model for each."""

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

from experiments.jobs import BASELINES, SEEDS, Job
from experiments.markdown import markdown
from experiments.paper import DENSE_SCENE, FIGURE_7_AVERAGE, FIGURE_7_GAIN, FIGURE_7_POINTS, GHZ_21
from experiments.results import Results
from experiments.statistics import gain
from experiments.tables.baselines import baseline_average
from experiments.tables.cells import NAMES, Scores, ceiling, cell, median_cell, paired_cells, percent, scores, summary_cells
from experiments.tables.plots import STYLES, save
from experiments.variants import VARIANTS

TITLE = "Figure 7: scene 1 at 21 frequencies"
MODELS = (("wideband", ""), ("wideband", "long"), ("wideband", "pooled"), ("wrfgs", ""), ("wrfgs", "long"), ("wave", ""))


def jobs() -> list[Job]:
    """Ours and WRF-GS with two budgets, the coherent field and what learns nothing."""
    return [job for model in MODELS for job in jobs_of(*model)] + [Job(DENSE_SCENE, BASELINES)]


def jobs_of(field: str, variant: str = "") -> list[Job]:
    """One curve: a job a seed; the costly ones have one."""
    seeds = SEEDS[:1] if VARIANTS[variant].budget > 1 or field == "wave" else SEEDS
    return [Job(DENSE_SCENE, field, variant=variant, seed=seed) for seed in seeds]


def render(results: Results, images: Path) -> str:
    """Curves, and the numbers below."""
    values = {model: scores(results, jobs_of(*model), GHZ_21) for model in MODELS}
    summary = [
        [NAMES[m], *summary_cells(v, None if m[1] else FIGURE_7_AVERAGE.get(m[0])), *gain_cells(values, m)]
        for m, v in values.items()
    ]
    nothing = Job(DENSE_SCENE, BASELINES)
    simple = {
        "line of sight": baseline_average(results, nothing, "line_of_sight"),
        "inverse distance": baseline_average(results, nothing, "inverse_distance"),
        "phase-blind ceiling": ceiling(DENSE_SCENE, GHZ_21),
    }
    summary += [[name, cell(value), "", "", "", "", ""] for name, value in simple.items()]
    note = (
        "Each WRF-GS model gets one 21st of the steps, in the profile `quick` 50 of 8 spectra: it does not even see every"
        " training spectrum once. With 5x samples the comparison is meaningful."
    )
    head = ["model", "average (paper)", "95 %", "seeds", "ours above it (paper)", "better at", "p"]
    parts = [note, markdown(head, summary), by_frequency(values)]
    if any(v is not None for v in values.values()):
        parts.insert(0, save(draw(values), images, "figure7", "median SSIM of scene 1 at 21 frequencies"))
    return "\n\n".join(parts)


def gain_cells(values: dict[tuple[str, str], Scores | None], model: tuple[str, str]) -> list[str]:
    """The wideband field's relative gain over a WRF-GS row of the same budget, with a paired test over transmitters."""
    field, variant = model
    if field != "wrfgs":
        return ["", "", ""]
    ours, theirs = values["wideband", variant], values[model]
    better, _, p = paired_cells(ours, theirs)
    return [percent(gain(ours, theirs), None if variant else FIGURE_7_GAIN), better, p]


def by_frequency(values: dict[tuple[str, str], Scores | None]) -> str:
    """Returns a table with one row per frequency."""
    rows = []
    for i, ghz in enumerate(GHZ_21):
        paper = FIGURE_7_POINTS.get(ghz, {})
        at = {m: None if v is None else v[..., i : i + 1] for m, v in values.items()}
        cells = [median_cell(v, None if m[1] else paper.get(m[0])) for m, v in at.items()]
        rows.append([f"{ghz:g}", *cells, cell(ceiling(DENSE_SCENE, [ghz]))])
    return markdown(["GHz", *(NAMES[m] for m in values), "ceiling"], rows)


def draw(values: dict[tuple[str, str], Scores | None]) -> plt.Figure:
    """Median SSIM over frequency, the band between the seeds, the paper's averages and the ceiling."""
    figure, axis = plt.subplots(figsize=(8.5, 4.2), layout="constrained")
    for model, v in values.items():
        if v is not None:
            seeds = np.median(v, 1)
            axis.plot(GHZ_21, np.median(seeds, 0), label=NAMES[model], **STYLES[model])
            axis.fill_between(GHZ_21, seeds.min(0), seeds.max(0), color=STYLES[model]["color"], alpha=0.2, lw=0)
    best = [value for f in GHZ_21 if (value := ceiling(DENSE_SCENE, [f])) is not None]
    if best:
        axis.plot(GHZ_21, best, color="0.4", lw=1, ls=":", label="phase-blind ceiling")
    for name, label in (("wideband", "wideband, paper"), ("wrfgs", "WRF-GS, paper")):
        axis.axhline(FIGURE_7_AVERAGE[name], color=STYLES[name, ""]["color"], lw=0.8, alpha=0.6, label=label)
    axis.set(xlabel="frequency [GHz]", ylabel="median SSIM", xlim=(0, 101), ylim=(0.4, 1))
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, ncols=4, loc="lower center")
    return figure
