"""Curves of the robustness suite: how scores fall as one thing gets worse (docs/wave.md shows them)."""

import statistics
from typing import Any

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.results import Results
from experiments.series import robustness

PANELS = {
    "mesh position error (mm)": {"0": "", "1": "mesh_1mm", "3": "mesh_3mm", "10": "mesh_1cm", "30": "mesh_3cm"},
    "small pieces missing from the mesh (%)": {"0": "", "10": "missing_10", "30": "missing_30"},
    "small pieces only in the mesh (%)": {"0": "", "10": "added_10", "30": "added_30"},
    "snapshot SNR (dB)": {"no noise": "", "30": "snr_30", "20": "snr_20", "10": "snr_10"},
    "training transmitters": {"all": "", "100": "tx_100", "20": "tx_20"},
}
"""Quantity of every panel, which gets worse from left to right, and the variants."""
COLOURS = {"1": "C0", "2": "C1", "4": "C2"}
"""Colours of the scenes."""
LINES = {"hybrid": "-", "coherent, no corrections": ":", "wideband alone": "--"}


def draw(results: Results) -> Figure:
    """Returns the figure: a panel for each thing that can get worse, a colour for each scene, a kind of line for each field."""
    figure, axes = plt.subplots(1, len(PANELS), figsize=(15, 3.8), sharey=True, layout="constrained")
    for axis, (title, variants) in zip(axes, PANELS.items(), strict=True):
        for scene, colour in COLOURS.items():
            for field, known in _known(results, scene, list(variants.values())).items():
                _line(axis, known, color=colour, ls=LINES[field])
        axis.set_xticks(range(len(variants)), list(variants))
        axis.set_xlabel(title)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("SSIM (average over frequencies)")
    scenes = [Line2D([], [], color=colour, label=f"scene {scene}") for scene, colour in COLOURS.items()]
    fields = [Line2D([], [], color="0.3", ls=style, label=field) for field, style in LINES.items()]
    axes[2].legend(handles=scenes + fields, fontsize=8, loc="lower left")  # where no curve runs
    return figure


def _known(results: Results, scene: str, variants: list[str]) -> dict[str, list[robustness.BySeed]]:
    """Returns the scores of every field: of every variant those of the seeds that were run."""
    found = [robustness.scores(results, scene, variant) for variant in variants]
    return {
        "hybrid": [hybrid for hybrid, *_ in found],
        "coherent, no corrections": [robustness.uncorrected_scores(results, scene, variant) for variant in variants],
        "wideband alone": [wideband for _, wideband, *_ in found],
    }


def _line(axis: Axes, known: list[robustness.BySeed], **style: Any) -> None:
    """Draws medians over seeds; what was not run is a gap."""
    medians = [statistics.median(one.values()) if one else float("nan") for one in known]
    axis.plot(range(len(medians)), medians, marker="o", ms=3.5, lw=1.5, **style)
