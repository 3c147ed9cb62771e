"""Figure 7: scene 1 at 21 frequencies, one field for all of them against a WRF-GS model for each."""

from experiments.jobs import REFERENCES, SEEDS, Job
from experiments.paper import DENSE_SCENE

TITLE = "Figure 7: scene 1 at 21 frequencies"
MODELS = (("wideband", ""), ("wrfgs", ""), ("wrfgs", "long"), ("wave", ""))


def jobs() -> list[Job]:
    """Ours, the two budgets of WRF-GS, the coherent field and what learns nothing."""
    return [job for model in MODELS for job in jobs_of(*model)] + [Job(DENSE_SCENE, REFERENCES)]


def jobs_of(field: str, variant: str = "") -> list[Job]:
    """One curve: a job a seed; the costly ones have one."""
    seeds = SEEDS if (field, variant) in MODELS[:2] else SEEDS[:1]
    return [Job(DENSE_SCENE, field, variant=variant, seed=seed) for seed in seeds]
