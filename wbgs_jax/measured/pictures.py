"""Pictures of maps of received power over a floor plan."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wbgs_jax.measured.floor_plan import Walls
from wbgs_jax.measured.power_map import PowerMap, received_power
from wbgs_jax.measured.readings import Readings

SPACING, MARGIN = 0.1, 0.3
"""Metres: of the pixels, and around all that is drawn."""
PIXELS = 40_000
"""At most; spacings grow with larger plans."""
AT_ONCE = 2048
SHOWN = 12
"""Receivers in a picture."""
COLUMNS = 3


def draw(learned: PowerMap, walls: Walls, cells: Readings) -> Figure:
    """Returns a figure with the map of every receiver at the median height of what was measured, walls, and the cells."""
    height = float(np.median(cells.places[:, 2]))
    outline = np.concatenate([np.asarray(walls.ends).reshape(-1, 2), cells.places[:, :2], cells.receivers[:, :2]])
    low, high = outline.min(0) - MARGIN, outline.max(0) + MARGIN
    spacing = max(SPACING, float(np.sqrt(np.prod(high - low) / PIXELS)))
    x, y = (np.arange(low[k] + spacing / 2, high[k], spacing) for k in range(2))
    powers = _powers(learned, np.stack([*(a.ravel() for a in np.meshgrid(x, y)), np.full(len(x) * len(y), height)], -1))
    shown = min(SHOWN, len(cells.receivers))
    columns, rows = min(COLUMNS, shown), -(-shown // COLUMNS)
    size = (high - low) / max(high - low)
    figure = Figure(figsize=(1 + 4 * columns * size[0], 0.8 + 4.2 * rows * size[1]), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    span = {"vmin": float(powers[:, :shown].min()), "vmax": float(powers[:, :shown].max())}
    for r, axis in enumerate(axes.flat):
        if r >= shown:
            axis.axis("off")
            continue
        extent = (low[0], low[0] + spacing * len(x), low[1], low[1] + spacing * len(y))
        image = axis.imshow(powers[:, r].reshape(len(y), len(x)), extent=extent, origin="lower", cmap="viridis", **span)
        _plan(axis, walls, cells.places)
        axis.plot(*cells.receivers[r, :2], "*", color="white", markeredgecolor="black", markersize=14)
        axis.set_title(f"receiver {r + 1}", fontsize=10)
    figure.supxlabel("x [m]", fontsize=9)
    figure.supylabel("y [m]", fontsize=9)
    figure.colorbar(image, ax=axes, shrink=0.8, label=f"mean received power {height:.2g} m above the floor [dBm]")
    return figure


def _plan(axis: Axes, walls: Walls, places: Float[np.ndarray, "n 3"]) -> None:
    for wall in np.asarray(walls.ends):
        axis.plot(wall[:, 0], wall[:, 1], color="black", linewidth=1.2)
    axis.plot(places[:, 0], places[:, 1], ".", color="black", markersize=1, alpha=0.5)


def _powers(learned: PowerMap, places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n r"]:
    blocks = np.array_split(places, -(-len(places) // AT_ONCE))
    return np.concatenate([np.asarray(received_power(learned, jnp.asarray(block, jnp.float32))[0]) for block in blocks])
