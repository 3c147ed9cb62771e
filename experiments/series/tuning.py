"""Learning rates and inputs of the wideband field and the trained baselines: one changed at a time, tuned alike.

All models have the effort of the profile `quick` and are scored at the held-out transmitters that the slowest one is scored at.
docs/baselines.md quotes the tables.
"""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all

TITLE = "Tuning of the trained baselines"
RATES = ("lr_1e-3", "lr_2e-3", "", "lr_8e-3", "lr_1.6e-2", "lr_3.2e-2")
"""None: the presets' 4e-3."""
SERIES = (
    Series("Learning rates", "wideband", RATES, "tuning"),
    Series("Learning rates, density control", "wrfgs", (*RATES, "no_density_control"), "tuning"),
    Series("Learning rates, loss, directions, inputs", "nerf2", (*RATES, "l2", "directions_384", "paper_inputs"), "tuning"),
)


def jobs() -> list[Job]:
    """Returns a job a field and change."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table a field."""
    return render_all(SERIES, results)
