"""Table 3: what the two frequency embeddings are worth, at all 21 frequencies and at those of combination D that are unseen."""

from pathlib import Path

from experiments.jobs import SEEDS, Job
from experiments.markdown import markdown
from experiments.paper import DENSE_SCENE, TABLE_3
from experiments.results import Results
from experiments.tables.cells import ceiling, cell, scores, summary_cells

TITLE = "Table 3: the two frequency embeddings, scene 1 at 21 frequencies"
VARIANTS = {(True, True): "", (False, True): "no_attenuation", (True, False): "no_radiance", (False, False): "pooled"}
"""(attenuation embedding, radiance embedding): variant."""


def jobs() -> list[Job]:
    """Every combination of the two, trained at all frequencies and at those of D."""
    return [job for seed in SEEDS for v in VARIANTS.values() for job in (all_frequencies(v)[seed], cross_frequency(v)[seed])]


def all_frequencies(variant: str) -> list[Job]:
    """Held-out transmitters at trained frequencies."""
    return [Job(DENSE_SCENE, "wideband", variant=variant, seed=seed) for seed in SEEDS]


def cross_frequency(variant: str) -> list[Job]:
    """Trained transmitters at unseen frequencies."""
    return [Job(DENSE_SCENE, "wideband", "D", all_tx=True, variant=variant, seed=seed) for seed in SEEDS]


def render(results: Results, images: Path) -> str:
    """A row a combination of the two embeddings."""
    rows = []
    for (attenuation, radiance), variant in VARIANTS.items():
        everywhere, unseen = TABLE_3[attenuation, radiance]
        cells = summary_cells(scores(results, all_frequencies(variant)), everywhere)
        cells += summary_cells(scores(results, cross_frequency(variant)), unseen)
        rows.append(["yes" if attenuation else "no", "yes" if radiance else "no", *cells])
    best = [cell(ceiling(DENSE_SCENE, job.test_ghz)) for job in (all_frequencies("")[0], cross_frequency("")[0])]
    rows.append(["phase-blind ceiling", "", best[0], "", "", best[1], "", ""])
    note = (
        "All frequencies: trained at 21, held-out transmitters. Cross frequency: trained at the 11 of combination D with all"
        " transmitters, scored at the other 10. Without either embedding the field gives every frequency the same answer: it is"
        " one model for pooled spectra. Where it is as good, what changes with the frequency is mostly interference, which no"
        " field without phases can follow ([decisions](decisions.md))."
    )
    head = ["attenuation", "radiance", "all freq. (paper)", "95 %", "seeds", "cross freq. (paper)", "95 %", "seeds"]
    return note + "\n\n" + markdown(head, rows)
