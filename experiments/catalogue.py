"""Every experiment by its name: what the runner runs, what pages and tables show."""

from collections.abc import Sequence
from types import ModuleType

from experiments.jobs import Job
from experiments.series import (
    choices,
    curve,
    fixed_array,
    frequency,
    outside,
    paper_form,
    rates,
    robustness,
    rooms,
    schedules,
    tuning,
    wave_choices,
)
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
SERIES: dict[str, ModuleType] = {
    "choices": choices,
    "tuning": tuning,
    "rates": rates,
    "curve": curve,
    "rooms": rooms,
    "robustness": robustness,
    "outside": outside,
    "schedules": schedules,
    "frequency": frequency,
    "fixed_array": fixed_array,
    "paper_form": paper_form,
    "wave_choices": wave_choices,
}
EXPERIMENTS = TABLES | SERIES


def unique_jobs(names: Sequence[str] = ()) -> list[Job]:
    """Returns the jobs of some experiments (by default of all tables and figures), each once."""
    return list(dict.fromkeys(job for name in names or TABLES for job in EXPERIMENTS[name].jobs()))
