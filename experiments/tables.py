"""All tables and figures: `python -m experiments.tables`."""

from types import ModuleType

from experiments import figure4, figure6, figure7, figure8, table1, table2, table3

EXPERIMENTS: dict[str, ModuleType] = {
    # In the order of importance, for the runner.
    "table1": table1,
    "figure4": figure4,
    "figure6": figure6,
    "figure7": figure7,
    "table3": table3,
    "figure8": figure8,
    "table2": table2,
}
