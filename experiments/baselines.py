"""Table 1's scenes beside what learns nothing, and beside a NeRF2-style volume."""

from pathlib import Path

import numpy as np

from experiments import table1
from experiments.cells import NAMES, ceiling, cell, median_cell, paired_cells, scores
from experiments.jobs import REFERENCES, SCORED_SLOW, Job
from experiments.paper import GHZ_10, SCENES
from experiments.report import markdown
from experiments.results import Results

TITLE = "Baselines"
NAMES_OF_REFERENCES = ("mean_image", "nearest_tx", "inverse_distance", "line_of_sight")


def jobs() -> list[Job]:
    """The volume in every scene, and the references."""
    return [Job(scene, "nerf2") for scene in SCENES] + [Job(scene, REFERENCES) for scene in SCENES]


def best_reference(results: Results, scene: str) -> float | None:
    """The average of the best predictor that learns nothing."""
    found = [reference_average(results, Job(scene, REFERENCES), name) for name in NAMES_OF_REFERENCES]
    return max((value for value in found if value is not None), default=None)


def reference_average(results: Results, job: Job, name: str) -> float | None:
    """A reference's average over frequencies of the median SSIM."""
    result = results.get(job)
    return None if result is None else float(np.mean(list(result.values["references"][name].values())))


def render(results: Results, images: Path) -> str:
    """Two tables: without learning, and the volume on the transmitters it was asked for."""
    return "\n\n".join([without_learning(results), volume(results)])


def without_learning(results: Results) -> str:
    """Averages over ten frequencies."""
    rows = []
    for scene in SCENES:
        fields = [median_cell(scores(results, table1.jobs_of(scene, field), GHZ_10)) for field in ("wideband", "wave")]
        others = [cell(reference_average(results, Job(scene, REFERENCES), name)) for name in NAMES_OF_REFERENCES]
        rows.append([scene, *fields, *others, cell(ceiling(scene, GHZ_10))])
    note = (
        "Predictors that learn nothing, on all held-out transmitters: the mean of all training spectra, that of the nearest"
        " training transmitter, their average weighted by 1/d², and the array's answer to the straight line. The phase-blind"
        " ceiling is that of the true paths with random phases. Averages over ten frequencies of the median SSIM."
    )
    names = [name.replace("_", " ").replace("tx", "TX") for name in NAMES_OF_REFERENCES]
    return note + "\n\n" + markdown(["scene", "wideband", "coherent", *names, "ceiling"], rows)


def volume(results: Results) -> str:
    """All models on the few transmitters that the slowest one was scored at, with a paired test of ours against it."""
    fields = ("wideband", "wrfgs", "wave", "nerf2")
    rows = []
    for scene in SCENES:
        slow = results.get(Job(scene, "nerf2"))
        asked = slow.tx.tolist() if slow else []
        values = {name: scores(results, [Job(scene, name)], GHZ_10, asked) if slow else None for name in fields}
        better, _, p = paired_cells(values["wideband"], values["nerf2"])
        rows.append([scene, *(median_cell(v) for v in values.values()), better, p])
    note = (
        f"A NeRF2-style volume marches rays and is slow to ask: it is scored on {SCORED_SLOW} of the held-out transmitters, and"
        " here so are the others, all with their first seed. It has the frequency as an input and sees as many spectra as ours,"
        " but few pixels of each, and with an L1 loss alone: SSIM, which is scored, needs whole images."
    )
    head = ["scene", *(NAMES[name, ""] for name in fields), "ours better at", "p"]
    return note + "\n\n" + markdown(head, rows)
