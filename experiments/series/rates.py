"""Optimisers and learning rates of every trained model, with equal numbers of spectra. On validation."""

from experiments.jobs import Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all

TITLE = "Optimisers"
RATES = ("adam_4e-3", "adam_1.6e-2", "muon_5e-3", "muon_1e-2", "muon_2e-2")
MATERIALS = ("materials_lr_5e-3", "", "materials_lr_2e-2")
SERIES = (
    Series("Wideband", "wideband", RATES, "rates", scenes=("4",)),
    Series("WRF-GS, a model a frequency", "wrfgs", RATES, "rates", scenes=("4",)),
    Series("NeRF2", "nerf2", RATES, "rates", scenes=("4",)),
    Series("The coherent field, rates of its materials (the preset has 1e-2)", "wave", MATERIALS, "rates", scenes=("4",)),
)


def jobs() -> list[Job]:
    """Returns a job a model and optimiser."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table a model."""
    return render_all(SERIES, results)
