"""Table 2: unseen frequencies in six scenes, with all transmitters in training as in the paper, and with held-out ones."""

from experiments.jobs import REFERENCES, Job
from experiments.paper import SCENES

TITLE = "Table 2: unseen frequencies, combinations C1-C4 of table 5"
COMBINATIONS = ("C1", "C2", "C3", "C4")
FIELDS = ("wideband", "wave", REFERENCES)


def jobs() -> list[Job]:
    """Every field in every scene, first as the paper does it."""
    return [
        Job(scene, field, combination, all_tx)
        for field in FIELDS
        for all_tx in (True, False)
        for scene in SCENES
        for combination in COMBINATIONS
    ]
