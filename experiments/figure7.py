"""Figure 7: scene 1 at 21 frequencies, one field for all of them against a WRF-GS model for each."""

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

from experiments.cells import NAMES, NOT_RUN, Scores, ceiling, cell, median_cell, paired_cells, scores, summary_cells
from experiments.jobs import REFERENCES, SEEDS, Job
from experiments.paper import DENSE_SCENE, FIGURE_7_AVERAGE, FIGURE_7_GAIN, FIGURE_7_POINTS, GHZ_21
from experiments.plots import STYLES, save
from experiments.report import markdown
from experiments.results import Results
from experiments.statistics import typical

TITLE = "Figure 7: scene 1 at 21 frequencies"
MODELS = (("wideband", ""), ("wideband", "long"), ("wrfgs", ""), ("wrfgs", "long"), ("wave", ""))


def jobs() -> list[Job]:
    """Ours and WRF-GS with two budgets, the coherent field and what learns nothing."""
    return [job for model in MODELS for job in jobs_of(*model)] + [Job(DENSE_SCENE, REFERENCES)]


def jobs_of(field: str, variant: str = "") -> list[Job]:
    """One curve: a job a seed; the costly ones have one."""
    seeds = SEEDS[:1] if variant or field == "wave" else SEEDS
    return [Job(DENSE_SCENE, field, variant=variant, seed=seed) for seed in seeds]


def render(results: Results, images: Path) -> str:
    """Curves, and the numbers below."""
    values = {model: scores(results, jobs_of(*model), GHZ_21) for model in MODELS}
    summary = [
        [NAMES[m], *summary_cells(v, FIGURE_7_AVERAGE.get(m[0])), *gain_cells(values.get(("wideband", m[1])), v, m)]
        for m, v in values.items()
    ]
    summary.append(["phase-blind ceiling", cell(ceiling(DENSE_SCENE, GHZ_21)), "", "", "", "", ""])
    head = ["model", "average (paper)", "95 %", "seeds", "ours above it (paper)", "better at", "p"]
    parts = [markdown(head, summary), by_frequency(values)]
    if any(v is not None for v in values.values()):
        parts.insert(0, save(draw(values), images, "figure7", "median SSIM of scene 1 at 21 frequencies"))
    return "\n\n".join(parts)


def gain_cells(ours: Scores | None, theirs: Scores | None, model: tuple[str, str]) -> list[str]:
    """The wideband field's relative gain over a WRF-GS row of the same budget, with a paired test over transmitters."""
    if model[0] != "wrfgs":
        return ["", "", ""]
    paper = f"({100 * FIGURE_7_GAIN:+.1f} %)"
    better, _, p = paired_cells(ours, theirs)
    if ours is None or theirs is None:
        return [f"{NOT_RUN} {paper}", better, p]
    gain = np.median(typical(ours)) / np.median(typical(theirs)) - 1
    return [f"{100 * gain:+.1f} % {paper}", better, p]


def by_frequency(values: dict[tuple[str, str], Scores | None]) -> str:
    """A row a frequency."""
    rows = []
    for i, ghz in enumerate(GHZ_21):
        paper = FIGURE_7_POINTS.get(ghz, {})
        cells = [median_cell(None if v is None else v[..., i : i + 1], paper.get(m[0])) for m, v in values.items()]
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
