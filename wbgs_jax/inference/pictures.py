"""Pictures of answers: spectra side by side, and quantities along a line, over a sweep, or query by query."""

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.figure import Figure

from wbgs_jax.inference.bounds import point_words
from wbgs_jax.inference.queries import Queries, shown_rows

COLORS = "viridis"
LABELS = {
    "power_db": "received power [dB of the transmitted]",
    "beamforming_gain_db": "beamforming gain [dB]",
    "k_factor_db": "K-factor [dB]",
    "angular_spread_deg": "spread of the azimuth of arrival [deg]",
    "delay_spread_s": "r.m.s. delay spread [ns]",
}
NANO = 1e9


def draw_spectra(
    pas: Float[np.ndarray, "n 90 360"], tx_positions: Float[np.ndarray, "n 3"], frequencies_hz: Float[np.ndarray, " n"]
) -> Figure:
    """Returns a figure of spectra over azimuth and zenith, two in a row."""
    columns = min(2, len(pas))
    rows = -(-len(pas) // columns)
    figure = Figure(figsize=(5.5 * columns, 1.9 * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for i, axis in enumerate(axes.flat):
        if i >= len(pas):
            axis.axis("off")
            continue
        shown = axis.imshow(pas[i], vmin=0, vmax=1, cmap=COLORS, extent=(-180, 180, 90, 0), aspect="auto")
        axis.set_title(f"{frequencies_hz[i] / 1e9:.4g} GHz, TX {point_words(tx_positions[i])}", fontsize=9)
        axis.set(xticks=range(-180, 181, 90), yticks=(0, 45, 90))
    figure.supxlabel("azimuth [deg]", fontsize=9)
    figure.supylabel("zenith [deg]", fontsize=9)
    figure.colorbar(shown, ax=axes, shrink=0.8, label="normalised amplitude")
    return figure


def draw_curves(name: str, values: Float[np.ndarray, " *shape"], queries: Queries) -> Figure:
    """Returns a figure of a quantity: over the frequency where there are more of these than transmitters, a curve each; else
    over the distance from the first transmitter along the way to the last; of single queries over their numbers."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    values = values * NANO if name == "delay_spread_s" else values
    values = values.reshape(*queries.shape, -1)[..., 0]
    if queries.paired:
        curves, places, legend = values[None], np.arange(1, len(queries) + 1.0), [""]
        axis.set_xlabel("query")
    elif len(queries.frequencies_hz) > len(queries.tx_positions):
        curves, places = values, queries.frequencies_hz / 1e9
        legend = [f"TX {point_words(tx)}" for tx in queries.tx_positions]
        axis.set(xlabel="frequency [GHz]", xscale="log")
    else:
        steps = np.linalg.norm(np.diff(queries.tx_positions, axis=0), axis=-1)
        curves, places = values.T, np.concatenate([[0.0], np.cumsum(steps)])
        legend = [f"{frequency / 1e9:.4g} GHz" for frequency in queries.frequencies_hz]
        axis.set_xlabel("distance along the transmitters [m]")
    chosen = shown_rows(len(curves))
    for share, number in zip(np.linspace(0, 0.9, len(chosen)), chosen, strict=True):
        axis.plot(places, curves[number], ".-", ms=3, lw=1, label=legend[number], color=colormaps[COLORS](share))
    if legend != [""]:
        axis.legend(fontsize=8)
    axis.set_ylabel(LABELS.get(name, name))
    axis.grid(alpha=0.3)
    return figure
