"""Optimisers and learning rates of every trained model, with the same care. On validation."""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all
from experiments.variants import OPTIMIZERS

TITLE = "Optimisers and learning rates"
BOTH = ("adam_4e-3", "muon_1e-2")
SERIES = (
    Series("Wideband", "wideband", tuple(OPTIMIZERS), "rates", scenes=("4",)),
    Series("WRF-GS, a model a frequency", "wrfgs", BOTH, "rates", scenes=("4",)),
    Series("NeRF2", "nerf2", BOTH, "rates", scenes=("4",)),
)


def jobs() -> list[Job]:
    """Returns a job a model and optimiser."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table a model."""
    return render_all(SERIES, results)
