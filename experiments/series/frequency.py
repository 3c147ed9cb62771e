"""What the frequency is to the networks of the wideband field, where it matters: behind walls. On validation.

All but the first see it; `variants.FREQUENCY` says how.
"""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all

TITLE = "Frequency"
FORMS = ("f_off", "f_input", "f_degree_4", "f_heads_2", "f_heads_4", "f_both")
SERIES = (Series("1,000 steps of Adam", "wideband", FORMS, "frequency", scenes=("2",)),)


def jobs() -> list[Job]:
    """Returns a job a form and scene."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table."""
    return render_all(SERIES, results)
