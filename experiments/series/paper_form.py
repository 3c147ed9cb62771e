"""The paper's own form (preset `paper`), as whole as an hour on one core allows."""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all

TITLE = "The paper's form"
SERIES = (Series("As many Gaussians and steps as an hour allows", "wideband", ("",), "paper_form"),)


def jobs() -> list[Job]:
    """Returns a job a scene and form."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table a series."""
    return render_all(SERIES, results)
