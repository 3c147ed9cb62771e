"""Table 2: unseen frequencies in six scenes, with all transmitters in training as in the paper, and with held-out ones."""

from pathlib import Path

from experiments.jobs import BASELINES, SCORED_TRAINED, Job
from experiments.markdown import markdown
from experiments.paper import SCENES, TABLE_2
from experiments.results import Results
from experiments.tables.baselines import baseline_average
from experiments.tables.cells import NAMES, ceiling, cell, median_cell, scores, summary_cells

TITLE = "Table 2: unseen frequencies, combinations C1-C4 of table 5"
COMBINATIONS = ("C1", "C2", "C3", "C4")
FIELDS = ("wideband", "wave", BASELINES)


def jobs() -> list[Job]:
    """Every field in every scene, the harder version first."""
    return [
        Job(scene, field, combination, all_tx)
        for field in FIELDS
        for all_tx in (False, True)
        for scene in SCENES
        for combination in COMBINATIONS
    ]


def render(results: Results, images: Path) -> str:
    """The paper's table, and the harder one."""
    notes = {
        True: "**All transmitters train**, as in the paper (its values in parentheses, where the text at hand is legible);"
        f" {SCORED_TRAINED} of them are scored at the unseen frequencies. The predictor that needs no training is then the"
        " spectrum of the same transmitter at the nearest trained frequency.",
        False: "**Held-out transmitters**: place and frequency are both new.",
    }
    seeds = "One seed; in table 1 seeds differ by up to 0.02, so that neighbouring cells can hardly be distinguished."
    return "\n\n".join([seeds, *(f"{note}\n\n{table(results, all_tx)}" for all_tx, note in notes.items())])


def table(results: Results, all_tx: bool) -> str:
    """Rows of a scene: ours with its interval, the coherent field, what learns nothing, the ceiling at these frequencies."""
    simple, label = ("nearest_tx", "same TX, nearest frequency") if all_tx else ("inverse_distance", "inverse distance")
    rows = []
    for scene in SCENES:
        of = {field: [Job(scene, field, name, all_tx) for name in COMBINATIONS] for field in FIELDS}
        papers = [TABLE_2[scene][name] if all_tx else None for name in COMBINATIONS]
        ours = [summary_cells(scores(results, [job]), p) for job, p in zip(of["wideband"], papers, strict=True)]
        rows += [
            [f"**{scene}** {NAMES['wideband', '']}", *(cells[0] for cells in ours)],
            ["95 %", *(cells[1] for cells in ours)],
            [NAMES["wave", ""], *(median_cell(scores(results, [job])) for job in of["wave"])],
            [label, *(cell(baseline_average(results, job, simple)) for job in of[BASELINES])],
            ["phase-blind ceiling", *(cell(ceiling(scene, job.test_ghz)) for job in of["wideband"])],
        ]
    return markdown(["scene, model", *COMBINATIONS], rows)
