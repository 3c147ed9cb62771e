"""Table 1: six scenes at ten frequencies, one field for all of them against a WRF-GS model for each."""

from pathlib import Path

from experiments.jobs import BASELINES, SEEDS, Job
from experiments.markdown import markdown
from experiments.paper import GHZ_10, SCENES, TABLE_1, TABLE_1_AVERAGE
from experiments.results import Results
from experiments.series.comparisons import SCENE_OF_CURVE
from experiments.tables.cells import NAMES, SUMMARY, ceiling, cell, median_cell, scores, summary_cells, truth_repeats

TITLE = "Table 1: six scenes, ten frequencies, held-out transmitters"
MODELS = (
    ("wideband", ""),
    ("wideband", "pooled"),
    ("wrfgs", ""),
    ("wave", ""),
)
CONTROLS = (("wideband", "pooled"),)
"""Models that have several seeds in this scene alone, that of the curve (`comparisons.CURVE`)."""


def jobs() -> list[Job]:
    """Ours and WRF-GS by frequency and pooled, the coherent field and what learns nothing."""
    trained = [job for scene in SCENES for model in MODELS for job in jobs_of(scene, *model)]
    return trained + [Job(scene, BASELINES) for scene in SCENES]


def jobs_of(scene: str, field: str, variant: str = "") -> list[Job]:
    """One row of the table: a job a seed; models that are there for comparison have several in one scene alone."""
    seeds = SEEDS[:1] if (field, variant) in CONTROLS and scene != SCENE_OF_CURVE else SEEDS
    return [Job(scene, field, variant=variant, seed=seed) for seed in seeds]


def render(results: Results, images: Path) -> str:
    """A table a scene."""
    note = (
        "Median SSIM by frequency (GHz); in parentheses the paper's. 95 %: bootstrap interval of the average over the scene's"
        " held-out transmitters and the seeds; seeds: how many, and the range of their averages."
    )
    parts = [note, *(scene_table(results, scene) for scene in SCENES)]
    return "\n\n".join(parts + longer_training(Results("paper", results.folder)) * (results.profile == "quick"))


def longer_training(results: Results) -> list[str]:
    """The coherent field's averages with the effort of the profile `paper`, where they have been run."""
    jobs = {scene: Job(scene, "wave") for scene in SCENES}
    rows = [[s, *summary_cells(found)[:2]] for s, job in jobs.items() if (found := scores(results, [job], GHZ_10)) is not None]
    note = "**The coherent field with the profile `paper`** (4,000 steps), one seed:"
    return [note, markdown(["scene", "average", "95 %"], rows)] if rows else []


def scene_table(results: Results, scene: str) -> str:
    """One scene: a row a model, the ceiling below, and how well the truth repeats itself."""
    rows = []
    for field, variant in MODELS:
        jobs, paper = jobs_of(scene, field, variant), None if variant else TABLE_1[scene].get(field)
        values = scores(results, jobs, GHZ_10)
        by_frequency = [None if values is None else values[..., i : i + 1] for i in range(len(GHZ_10))]
        each = [median_cell(v, paper[i] if paper else None) for i, v in enumerate(by_frequency)]
        average = summary_cells(values, TABLE_1_AVERAGE[scene][field] if paper else None)
        rows.append([NAMES[field, variant], *each, *average])
    best = [cell(ceiling(scene, [f])) for f in GHZ_10] + [cell(ceiling(scene, GHZ_10)), "", ""]
    rows.append(["phase-blind ceiling", *best])
    truth = [cell(truth_repeats(scene, [f])) for f in GHZ_10] + [cell(truth_repeats(scene, GHZ_10)), "", ""]
    rows.append(["truth against itself", *truth])
    return f"**Scene {scene}**\n\n" + markdown(["model", *(f"{f:g}" for f in GHZ_10), *SUMMARY], rows)
