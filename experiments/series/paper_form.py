"""The paper's own form (preset `paper`): as whole as an hour on one core allows, and change by change on the way to ours."""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all
from experiments.variants import PRECISIONS, TO_OURS

TITLE = "The paper's form"
SERIES = (
    Series("As many Gaussians and steps as an hour allows", "wideband", ("",), "paper_form"),
    Series(
        "From the paper's form to ours, every row with all changes above it: equally many spectra, scores of validation",
        "wideband",
        ("", *TO_OURS),
        "to_ours",
        scenes=("4",),
    ),
    Series(
        "What the networks multiply, by 2,000 spectra, scores of validation",
        "wideband",
        PRECISIONS,
        "precision",
        seeds=(0, 1),
    ),
)


def jobs() -> list[Job]:
    """Returns a job a scene and form."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table a series."""
    return render_all(SERIES, results)
