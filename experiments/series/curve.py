"""Models against the number of spectra seen, by today's presets: one, five and ten times 8,000, on the held-out transmitters.

WRF-GS as the paper has it, a model a frequency which shares that number with the others, and pooled: one model for all
frequencies. The tables have the same of six scenes by the presets of before.
"""

from experiments.jobs import SEEDS, Job
from experiments.results import Results
from experiments.series.series import Series, jobs_of_all, render_all

TITLE = "Spectra seen"
BUDGETS = ("", "long", "longest")
POOLED = ("pooled", "pooled_long", "pooled_longest")
SERIES = (
    Series("Wideband", "wideband", BUDGETS, "curve", ("4",), seeds=SEEDS),
    Series("WRF-GS, pooled", "wideband", POOLED, "curve", ("4",), seeds=SEEDS),
    Series("WRF-GS, a model a frequency", "wrfgs", BUDGETS, "curve", ("4",), seeds=SEEDS),
    Series("NeRF2", "nerf2", BUDGETS, "curve", ("4",), seeds=SEEDS),
)


def jobs() -> list[Job]:
    """Returns a job a model, number of spectra and seed."""
    return jobs_of_all(SERIES)


def render(results: Results) -> str:
    """Returns a table a model."""
    return render_all(SERIES, results)
