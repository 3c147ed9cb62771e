"""Optimisers of the networks. On validation."""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all

TITLE = "Optimisers"
BOTH = ("adam_4e-3", "muon_1e-2")
SERIES = (Series("Wideband", "wideband", BOTH, "rates", scenes=("4",)),)


def jobs() -> list[Job]:
    """Returns a job an optimiser."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table."""
    return render_all(SERIES, results)
