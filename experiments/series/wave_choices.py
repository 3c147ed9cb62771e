"""What the parts of the coherent field are worth: one taken away at a time (docs/history.md)."""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all
from experiments.variants import COHERENT

TITLE = "Parts of the coherent field"
SERIES = (Series("All of it, and without a part", "wave", ("", *COHERENT), "choices", scenes=("4",)),)


def jobs() -> list[Job]:
    """Returns a job a change."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns one table."""
    return render_all(SERIES, results)
