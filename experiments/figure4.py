"""Figure 4: predicted spectra beside the truth, at eight frequencies and as many held-out transmitters."""

from experiments import table1
from experiments.jobs import PICTURED_SCENES, Job

TITLE = "Figure 4: predicted spectra"


def jobs() -> list[Job]:
    """Jobs of table 1 that keep pictures."""
    return [job for job in table1.jobs() if job.scene in PICTURED_SCENES and job.pictured]
