"""Received power of the default field, by frequency."""

from pathlib import Path
from typing import Any

from experiments.markdown import markdown
from experiments.paper import GHZ_10, SCENES
from experiments.results import Results
from experiments.tables.cells import NOT_RUN
from experiments.tables.default_field import report

TITLE = "Received power of the default field"
NOTE = "Mean absolute error (dB) by frequency (GHz); below, the power of the nearest training transmitter:"


def render(results: Results, images: Path) -> str:
    """Two rows a scene."""
    rows = [row for scene in SCENES for row in _rows(f"scene {scene}", report(results.folder, f"scene{scene}"))]
    return f"{NOTE}\n\n" + markdown(["data", *(f"{f:g}" for f in GHZ_10)], rows)


def _rows(name: str, found: dict[str, Any] | None) -> list[list[str]]:
    if found is None or "power" not in found:
        return [[name, NOT_RUN, *[""] * (len(GHZ_10) - 1)]]
    power = found["power"]
    nearest = power["baselines"]["nearest_tx"]
    return [
        [label, *(f"{row['power_mae_db']:.2f}" for row in figures["per_frequency"])]
        for label, figures in ((name, power), ("nearest TX", nearest))
    ]
