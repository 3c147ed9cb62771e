"""Pictures of maps: a quantity over a floor, with the walls that the plane cuts and the receiver."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from wbgs_jax.radio.channel import NOT_HEARD_DB

SHOWN = 6
"""Frequencies in a picture."""


class Look(NamedTuple):
    """How a quantity is drawn."""

    name: str
    """In the answer."""
    label: str
    scale: float = 1.0
    """Drawn units in one of the answer's."""
    colors: str = "viridis"


LOOKS: dict[str, Look] = {
    "power": Look("power_db", "received power [dB of the transmitted]"),
    "best-beam": Look("best_beam", "azimuth of the best beam [deg]", colors="twilight"),
    "k-factor": Look("k_factor_db", "K-factor [dB]"),
    "delay-spread": Look("delay_spread_s", "r.m.s. delay spread [ns]", 1e9),
    "angular-spread": Look("angular_spread_deg", "spread of the azimuth of arrival [deg]"),
}


def draw_maps(
    what: str, answer: dict[str, np.ndarray], walls: Float[np.ndarray, "n 2 2"], rx: Float[np.ndarray, "3"]
) -> Figure:
    """Returns a figure of the first `SHOWN` maps with the walls that the plane cuts, and the receiver as a star."""
    look, xs, ys = LOOKS[what], answer["xs"], answer["ys"]
    values = _drawn(look, answer)[:SHOWN]
    half = [(np.ptp(places) / (len(places) - 1) if len(places) > 1 else 1.0) / 2 for places in (xs, ys)]
    extent = (xs[0] - half[0], xs[-1] + half[0], ys[0] - half[1], ys[-1] + half[1])
    wide = extent[1] - extent[0] > extent[3] - extent[2]
    rows, columns = (len(values), 1) if wide and len(values) < 4 else (-(-len(values) // 2), min(2, len(values)))
    ratio = (extent[3] - extent[2]) / (extent[1] - extent[0])
    figure = Figure(figsize=(1.5 + 6 * columns, 0.8 + rows * (0.5 + 6 * min(ratio, 2.0))), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    span = {"vmin": -180.0, "vmax": 180.0} if what == "best-beam" else _span(values)
    for i, axis in enumerate(axes.flat):
        if i >= len(values):
            axis.axis("off")
            continue
        shown = axis.imshow(values[i], extent=extent, origin="lower", cmap=look.colors, aspect="equal", **span)
        axis.add_collection(LineCollection(list(walls), colors="black", linewidths=0.8))
        axis.plot(*rx[:2], "*", color="white", markeredgecolor="black", markersize=14)
        axis.set(xlim=extent[:2], ylim=extent[2:])
        axis.set_title(f"{answer['frequencies_hz'][i] / 1e9:g} GHz", fontsize=10)
    figure.supxlabel("x [m]", fontsize=9)
    figure.supylabel("y [m]", fontsize=9)
    figure.colorbar(shown, ax=axes, shrink=0.8, label=f"{look.label}, transmitters {answer['height']:.3g} m high")
    return figure


def _drawn(look: Look, answer: dict[str, np.ndarray]) -> Float[np.ndarray, "freq ny nx"]:
    values = answer[look.name]
    if look.name == "best_beam":
        return answer["beam_azimuth_deg"][values]
    heard = values > NOT_HEARD_DB if look.name == "power_db" else np.ones(values.shape, bool)
    drawn = look.scale * np.where(heard, values, np.nan)
    return drawn[..., 0] if drawn.ndim > 3 else drawn


def _span(values: Float[np.ndarray, "freq ny nx"]) -> dict[str, Any]:
    """Returns limits of the colours that leave out the extreme hundredths."""
    low, high = np.nanquantile(values, [0.01, 0.99])
    return {"vmin": float(low), "vmax": float(high)}
