"""Figure 6: training loss in six scenes."""

from experiments import table1
from experiments.jobs import Job
from experiments.paper import SCENES

TITLE = "Figure 6: training loss"


def jobs() -> list[Job]:
    """Jobs of table 1, first seed."""
    return [table1.jobs_of(scene, "wideband")[0] for scene in SCENES]
