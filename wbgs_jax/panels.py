"""Panels of figures: their axes, legends and colour bars, named and marked the same way everywhere."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter


def make_panels(titles: list[str], columns: int, size: tuple[float, float], **options: Any) -> tuple[Figure, list[Axes]]:
    """Returns a figure with a panel for each title; `size` is that of a panel in inches."""
    columns = min(columns, len(titles))
    rows = -(-len(titles) // columns)
    figure = Figure(figsize=(size[0] * columns + 0.8, size[1] * rows + 0.8), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False, **options).flat)
    for axis in axes[len(titles) :]:
        axis.axis("off")
    for axis, title in zip(axes, titles, strict=False):
        axis.set_title(title, fontsize=9)
    return figure, axes[: len(titles)]


def name_axes(axes: Iterable[Axes], x: str, y: str) -> None:
    """Names the axes of panels that share them, at the left and where no panel is below."""
    panels = [axis for axis in axes if axis.axison]
    columns = panels[0].get_subplotspec().get_gridspec().ncols  # type: ignore[union-attr]
    for number, axis in enumerate(panels):
        if number + columns >= len(panels):
            axis.set_xlabel(x, fontsize=9)
            axis.tick_params(labelbottom=True)
        if number % columns == 0:
            axis.set_ylabel(y, fontsize=9)


def name_curves(axis: Axes, title: str = "") -> None:
    """Adds a legend, beside the axes if it is so long that it would hide curves."""
    most_within = 5  # curves
    beside: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.01, 1), "borderaxespad": 0}
    axis.legend(fontsize=8, title=title, **beside if len(axis.get_legend_handles_labels()[1]) > most_within else {})


def name_frequencies(axis: Axes, ghz: Float[np.ndarray, " n"]) -> None:
    """Names an axis of frequencies, logarithmic if they span more than a factor of three."""
    axis.set_xlabel("frequency [GHz]")
    if ghz.max() > 3 * ghz.min():
        axis.set_xscale("log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())


def clipped(values: Float[np.ndarray, "*shape"], vmin: float, vmax: float) -> Any:
    """Returns at which ends a colour bar needs an arrow, because values lie beyond it."""
    below, above = bool((values < vmin).any()), bool((values > vmax).any())
    return {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[below, above]
