"""Figure 8: trained at some of 21 frequencies, asked at the others."""

from experiments.jobs import SEEDS, Job
from experiments.paper import DENSE_SCENE

TITLE = "Figure 8: unseen frequencies, combinations A-K of table 6 (scene 1)"
LETTERS = "ABCDEFGHIJK"


def jobs() -> list[Job]:
    """All combinations with all transmitters; D, quoted in the headline, with held-out ones too; two of the coherent field."""
    letters = [job for letter in LETTERS for job in jobs_of(letter)]
    return letters + held_out() + [wave(letter, all_tx) for letter in "DG" for all_tx in (True, False)]


def jobs_of(letter: str) -> list[Job]:
    """One bar of the figure; D has several seeds."""
    seeds = SEEDS if letter == "D" else SEEDS[:1]
    return [Job(DENSE_SCENE, "wideband", letter, all_tx=True, seed=seed) for seed in seeds]


def held_out() -> list[Job]:
    """Combination D asked for transmitters that are new as well."""
    return [Job(DENSE_SCENE, "wideband", "D", seed=seed) for seed in SEEDS]


def wave(letter: str, all_tx: bool) -> Job:
    """The coherent field in the same place."""
    return Job(DENSE_SCENE, "wave", letter, all_tx=all_tx)
