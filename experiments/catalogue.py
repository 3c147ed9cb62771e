"""Every experiment by its name: what the runner runs, what pages and tables show."""

from collections.abc import Sequence
from types import ModuleType

from experiments.jobs import Job
from experiments.series import comparisons, fixed_array, outside, robustness
from experiments.series.series import Experiment
from experiments.tables import baselines, figure4, figure6, figure7, figure8, headline, table1, table2, table3

TABLES: dict[str, ModuleType] = {
    # In the order of importance, for the runner.
    "table1": table1,
    "headline": headline,
    "figure4": figure4,
    "figure6": figure6,
    "figure7": figure7,
    "table3": table3,
    "figure8": figure8,
    "table2": table2,
    "baselines": baselines,
}
SERIES: dict[str, Experiment] = {
    "choices": comparisons.CHOICES,
    "tuning": comparisons.TUNING,
    "rates": comparisons.RATES,
    "curve": comparisons.CURVE,
    "rooms": comparisons.ROOMS,
    "robustness": robustness.EXPERIMENT,
    "outside": outside.EXPERIMENT,
    "schedules": comparisons.SCHEDULES,
    "frequency": comparisons.FREQUENCY,
    "fixed_array": fixed_array.EXPERIMENT,
    "paper_form": comparisons.PAPER_FORM,
    "wave_choices": comparisons.WAVE_CHOICES,
}
EXPERIMENTS: dict[str, ModuleType | Experiment] = {**TABLES, **SERIES}


def unique_jobs(names: Sequence[str] = ()) -> list[Job]:
    """Returns the jobs of some experiments (by default of all tables and figures), each once."""
    return list(dict.fromkeys(job for name in names or TABLES for job in EXPERIMENTS[name].jobs()))
