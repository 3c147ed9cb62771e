"""Table 3: what the two frequency embeddings are worth, at all 21 frequencies and at those of combination D that are unseen."""

from experiments.jobs import SEEDS, Job
from experiments.paper import DENSE_SCENE

TITLE = "Table 3: the two frequency embeddings, scene 1 at 21 frequencies"
VARIANTS = {(True, True): "", (False, True): "no_attenuation", (True, False): "no_radiance", (False, False): "no_frequency"}
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
