"""A whole room as the test, of which nothing has been trained, by today's presets."""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all

TITLE = "A room held out"
SCENES = ("2", "3", "4", "5")
SERIES = (
    Series("Wideband", "wideband", ("room",), "rooms", scenes=SCENES),
    Series("WRF-GS, pooled", "wideband", ("room_pooled",), "rooms", scenes=SCENES),
    Series("The coherent field", "wave", ("room",), "rooms", scenes=SCENES),
)


def jobs() -> list[Job]:
    """Returns a job a model and scene."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table a model."""
    return render_all(SERIES, results)
