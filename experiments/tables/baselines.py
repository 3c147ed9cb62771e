"""Table 1's scenes beside what learns nothing, and beside a NeRF2-style volume."""

from pathlib import Path

import numpy as np

from experiments.jobs import BASELINES, Job
from experiments.markdown import markdown
from experiments.paper import GHZ_10, SCENES
from experiments.results import Results
from experiments.series.comparisons import SCENE_OF_CURVE
from experiments.tables import table1
from experiments.tables.cells import NAMES, ceiling, cell, median_cell, paired_cells, scores, truth_repeats

TITLE = "Baselines"
NAMES_OF_BASELINES = ("mean_image", "nearest_tx", "inverse_distance", "line_of_sight")


def jobs() -> list[Job]:
    """Returns the volume in one scene, and the predictors that learn nothing."""
    return [Job(SCENE_OF_CURVE, "nerf2"), *(Job(scene, BASELINES) for scene in SCENES)]


def best_baseline(results: Results, scene: str) -> float | None:
    """Returns the average of the best predictor that learns nothing."""
    found = [baseline_average(results, Job(scene, BASELINES), name) for name in NAMES_OF_BASELINES]
    return max((value for value in found if value is not None), default=None)


def baseline_average(results: Results, job: Job, name: str) -> float | None:
    """Returns a baseline's average over frequencies of the median SSIM."""
    result = results.get(job)
    return None if result is None else float(np.mean(list(result.values["baselines"][name].values())))


def render(results: Results, images: Path) -> str:
    """Returns two tables: without learning, and the volume on the transmitters it was scored on."""
    return "\n\n".join([without_learning(results), volume(results)])


def without_learning(results: Results) -> str:
    """Averages over ten frequencies."""
    rows = []
    for scene in SCENES:
        fields = [median_cell(scores(results, table1.jobs_of(scene, field), GHZ_10)) for field in ("wideband", "wave")]
        others = [cell(baseline_average(results, Job(scene, BASELINES), name)) for name in NAMES_OF_BASELINES]
        rows.append([scene, *fields, *others, cell(ceiling(scene, GHZ_10)), cell(truth_repeats(scene, GHZ_10))])
    note = (
        "Untrained predictors, on all held-out transmitters: the mean of all training spectra, that of the nearest"
        " training transmitter, their average weighted by 1/d², and the array's answer to the straight line. The phase-blind"
        " ceiling is that of the true paths with random phases. Averages over ten frequencies of the median SSIM."
    )
    names = [name.replace("_", " ").replace("tx", "TX") for name in NAMES_OF_BASELINES]
    return note + "\n\n" + markdown(["scene", "wideband", "coherent", *names, "ceiling", "truth against itself"], rows)


def volume(results: Results) -> str:
    """All models with their first seed, and a paired test of ours against the volume."""
    fields, scene = ("wideband", "wrfgs", "wave", "nerf2"), SCENE_OF_CURVE
    values = {name: scores(results, [Job(scene, name)], GHZ_10) for name in fields}
    better, _, p = paired_cells(values["wideband"], values["nerf2"])
    row = [scene, *(median_cell(v) for v in values.values()), better, p]
    note = (
        "A NeRF2-style volume marches rays. It has the frequency as an input and sees as many spectra as ours, but few pixels"
        " of each, and with an L1 loss alone: SSIM, which is scored, needs whole images. First seed of all models."
    )
    head = ["scene", *(NAMES[name, ""] for name in fields), "ours better at", "p"]
    return note + "\n\n" + markdown(head, [row])
