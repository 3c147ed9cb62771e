"""How fast the wideband field learns, and for how long: learning rates, warm-up, what is left at the end. On validation."""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all

TITLE = "Schedules"
RATES = ("", "lr_8e-3", "lr_1.6e-2", "warm_8e-3", "warm_1.6e-2", "warm_2.4e-2")
SERIES = (
    Series("The `cpu` preset of today", "wideband", ("",), "main", ("1", "2", "4")),
    Series("Behind walls, beside the former 6,000 steps", "wideband", ("", "warm_8e-3", "steps_6000"), "schedules", ("2", "4")),
    Series("Learning rates", "wideband", RATES, "schedules"),
)


def jobs() -> list[Job]:
    """Returns a job a change and scene."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table a series."""
    return render_all(SERIES, results)
