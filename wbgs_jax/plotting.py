"""Plots, written as PNG files, atomically: spectra (rectangular and polar), training curves and SSIM by frequency of a run;
predicted spectra, and quantities along a line, over a frequency sweep or per query; maps of a quantity over a floor with walls
and receiver; maps of received power over a floor plan.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from wbgs_jax import metrics
from wbgs_jax._util.cli import point_words
from wbgs_jax._util.files import atomic_write
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.floor_plan import Walls
from wbgs_jax.data.rssi_folder import Readings
from wbgs_jax.inference.quantities import NETWORK, QUANTITIES, Quantity
from wbgs_jax.inference.queries import Queries, shown_rows
from wbgs_jax.power_map.model import PowerMap, received_power
from wbgs_jax.radio.channel import NO_PATH_DB

SHOWN = 6
"""Maximum number of spectra in a plot."""
LONGEST_ARROW = 0.1
"""Length of the longest arrow, relative to the scene's size."""
SIZES = ("gaussians",)
"""Counts of a field that change during training."""


def draw_all(
    folder: Path,
    dataset: Dataset,
    index: Int[np.ndarray, " n"],
    predicted: Float[np.ndarray, "n 90 360"],
    report: dict[str, Any],
    curves: list[dict[str, Any]],
) -> list[Path]:
    """Draws predicted spectra of some links, the report and the training curves into a folder; returns the files."""
    chosen = spread(dataset, index)
    truth, shown = np.asarray(dataset.pas(index[chosen])), predicted[chosen]
    titles = [_title(dataset, i) for i in index[chosen].tolist()]
    figures = {
        "spectra.png": draw_spectra(truth, shown, titles),
        "spectra_polar.png": draw_polar(truth, shown, titles),
        "ssim_by_frequency.png": draw_frequencies(report),
    }
    if curves:
        figures["curves.png"] = draw_curves(curves)
    return [_save(figure, folder / name) for name, figure in figures.items()]


def spread(dataset: Dataset, index: Int[np.ndarray, " n"], count: int = SHOWN) -> Int[np.ndarray, " count"]:
    """Returns positions in `index` that cover the range of frequencies, with different transmitters if there are enough."""
    frequencies = np.unique(dataset.frequencies_hz[index])
    rng = np.random.default_rng(0)
    chosen: list[int] = []
    for frequency in frequencies[np.linspace(0, len(frequencies) - 1, min(count, len(index))).round().astype(int)]:
        candidates = np.flatnonzero(dataset.frequencies_hz[index] == frequency)
        used = dataset.tx_index[index[np.array(chosen, int)]]
        fresh = candidates[~np.isin(dataset.tx_index[index[candidates]], used)]
        chosen.append(int(rng.choice(fresh if len(fresh) else candidates)))
    return np.array(chosen)


def _title(dataset: Dataset, index: int) -> str:
    x, y, z = dataset.tx_positions[index]
    return f"{dataset.frequencies_hz[index] / 1e9:g} GHz, TX ({x:.1f}, {y:.1f}, {z:.1f}) m"


def draw_spectra(truth: Float[np.ndarray, "k 90 360"], predicted: Float[np.ndarray, "k 90 360"], titles: list[str]) -> Figure:
    """Returns truth, prediction and absolute error over azimuth and zenith, one row per spectrum."""
    figure = Figure(figsize=(13, 1.75 * len(truth) + 0.6), layout="constrained")
    axes = figure.subplots(len(truth), 3, squeeze=False)
    ssim = metrics.ssim(predicted, truth)
    for row, (a, b, title, score) in enumerate(zip(truth, predicted, titles, ssim, strict=True)):
        images = (a, b, np.abs(a - b))
        labels = (f"truth: {title}", f"prediction: SSIM {score:.3f}", f"|error|: mean {images[2].mean():.3f}")
        for axis, image, label in zip(axes[row], images, labels, strict=True):
            shown = axis.imshow(image, vmin=0, vmax=1, cmap="viridis", extent=(-180, 180, 90, 0), aspect="auto")
            axis.set_title(label, fontsize=9)
            axis.set_xticks(range(-180, 181, 90))
            axis.set_yticks((0, 45, 90))
        axes[row, 0].set_ylabel("zenith [deg]")
    for axis in axes[-1]:
        axis.set_xlabel("azimuth [deg]")
    figure.colorbar(shown, ax=axes, shrink=0.5, label="normalised amplitude")
    return figure


def draw_polar(truth: Float[np.ndarray, "k 90 360"], predicted: Float[np.ndarray, "k 90 360"], titles: list[str]) -> Figure:
    """Returns the receiver's hemisphere seen from above: the zenith in the middle, the horizon at the rim."""
    figure = Figure(figsize=(2.6 * len(truth), 5.8), layout="constrained")
    axes = figure.subplots(2, len(truth), squeeze=False, subplot_kw={"projection": "polar"})
    azimuth, zenith = np.linspace(-np.pi, np.pi, 360), np.linspace(0, 90, 90)
    for row, (label, images) in enumerate((("truth", truth), ("prediction", predicted))):
        for axis, image, title in zip(axes[row], images, titles, strict=True):
            axis.grid(False)
            shown = axis.pcolormesh(azimuth, zenith, image, vmin=0, vmax=1, cmap="viridis", shading="nearest", rasterized=True)
            axis.set_title(f"{label}\n{title.replace(', TX', chr(10) + 'TX')}" if row == 0 else label, fontsize=8)
            axis.set_yticks([])
            axis.set_xticks(np.deg2rad((0, 90, 180, 270)))
            axis.tick_params(labelsize=7)
    figure.colorbar(shown, ax=axes, shrink=0.6, label="normalised amplitude")
    return figure


def draw_curves(entries: list[dict[str, Any]]) -> Figure:
    """Returns the loss, metrics of the batches and of held-out links, and counts that change, over the steps."""
    steps = [e for e in entries if "loss" in e]
    held_out = sorted({name for e in steps for name in e if name.startswith("held_out")})
    sizes = [name for name in SIZES if any(name in e for e in steps)]
    figure = Figure(figsize=(13 if sizes else 9, 3.6), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, 3 if sizes else 2))
    axes[0].plot([e["step"] for e in steps], [e["loss"] for e in steps], color="C0")
    axes[0].set(title="training loss", xlabel="step")
    batch = [(e["step"], e["batch_ssim"]) for e in steps if e.get("batch_ssim") is not None]
    if batch:
        axes[1].plot(*zip(*batch, strict=True), color="C0", alpha=0.6, label="training batches: mean SSIM (11x11)")
    for name in held_out:
        points = [(e["step"], e[name]) for e in steps if name in e]
        label = "held-out sample: median SSIM (7x7)" if name == "held_out_ssim" else name.replace("_", " ")
        axes[1].plot(*zip(*points, strict=True), "o-", color="C3", label=label)
    axes[1].set(title="quality", xlabel="step")
    if batch or held_out:
        axes[1].legend(fontsize=8)
    for name in sizes:
        axes[2].plot([e["step"] for e in steps], [e.get(name) for e in steps], color="C2")
        axes[2].set(title=name, xlabel="step", ylim=(0, None))
    for axis in axes:
        axis.grid(alpha=0.3)
    return figure


def draw_motion(folder: Path, corners: Float[np.ndarray, "f k 3"], shift: Float[np.ndarray, "f 3"]) -> Path:
    """Draws the displacement of a mesh's surfaces by the training, from above and from the side; returns the file."""
    figure = Figure(figsize=(10, 7), layout="constrained")
    axes, size = figure.subplots(2, 1), 1e3 * np.linalg.norm(shift, axis=-1)
    colours = colormaps["viridis"](size / max(size.max(), 1e-9))
    different, first, body = np.unique(shift, axis=0, return_index=True, return_inverse=True)  # equal shifts: one rigid body
    centre = np.array([corners[body.reshape(-1) == k].mean((0, 1)) for k in range(len(different))])
    longest = LONGEST_ARROW * np.ptp(corners.reshape(-1, 3), axis=0).max() / max(size.max() * 1e-3, 1e-9)
    for axis, (i, j), name in zip(axes, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        outlines = np.concatenate([corners, corners[:, :1]], 1)[..., [i, j]]
        axis.add_collection(LineCollection(list(outlines), colors=colours, linewidths=0.8))
        arrows = *centre[:, [i, j]].T, *(longest * different[:, [i, j]].T)
        axis.quiver(*arrows, color=colours[first], angles="xy", scale_units="xy", scale=1)
        axis.set(
            title=f"{name} (arrows magnified {longest:.0f} times)", xlabel="x [m]", ylabel=f"{'xyz'[j]} [m]", aspect="equal"
        )
        axis.autoscale_view()
    shown = ScalarMappable(Normalize(0, size.max()), "viridis")
    figure.colorbar(shown, ax=axes, label="displacement [mm]", shrink=0.8)
    return _save(figure, folder / "surfaces_moved.png")


def draw_frequencies(report: dict[str, Any]) -> Figure:
    """Returns the median SSIM of the field and of every baseline by frequency."""
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    axis = figure.subplots()
    series = {report["field"]: report} | {name.replace("_", " "): r for name, r in report["baselines"].items()}
    for i, (name, result) in enumerate(series.items()):
        rows = result["per_frequency"]
        style: dict[str, Any] = {"lw": 2.5, "marker": "o"} if i == 0 else {"lw": 1.2, "marker": ".", "ls": "--"}
        label = f"{name}: {result['median_ssim']:.3f}"
        axis.plot([r["frequency_ghz"] for r in rows], [r["median_ssim"] for r in rows], label=label, **style)
    ticks = [r["frequency_ghz"] for r in report["per_frequency"]]
    axis.set(
        xscale="log", xlabel="frequency [GHz]", ylabel="median SSIM", title=f"{report['scene']}: held-out spectra", ylim=(0, 1)
    )
    axis.set_xticks(ticks, [f"{t:g}" for t in ticks], fontsize=8, rotation=45)
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, title="overall median", title_fontsize=8)
    return figure


def _save(figure: Figure, path: Path) -> Path:
    with atomic_write(path) as stream:
        figure.savefig(stream, format="png", dpi=110)
    return path


COLORS = "viridis"


def draw_answers(
    pas: Float[np.ndarray, "n 90 360"], tx_positions: Float[np.ndarray, "n 3"], frequencies_hz: Float[np.ndarray, " n"]
) -> Figure:
    """Returns a figure of spectra over azimuth and zenith, two per row."""
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


def draw_sweeps(quantity: Quantity, values: Float[np.ndarray, " *shape"], queries: Queries) -> Figure:
    """Returns a figure of a quantity: over the frequency where there are more of these than transmitters, a curve each; else
    over the distance from the first transmitter along the way to the last; of single queries over their numbers."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    values = quantity.scale * values.reshape(*queries.shape, -1)[..., 0]
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
    axis.set_ylabel(quantity.label)
    axis.grid(alpha=0.3)
    return figure


SHOWN_MAPS = 6
"""Maximum number of frequencies in a plot."""


def draw_maps(
    what: str, answer: dict[str, np.ndarray], walls: Float[np.ndarray, "n 2 2"], stars: Float[np.ndarray, "k 3"]
) -> Figure:
    """Returns a figure of the first `SHOWN_MAPS` maps with the walls that the plane cuts, and stars: the receiver, or the
    transmitters of a quantity of several."""
    quantity, xs, ys = QUANTITIES[what], answer["xs"], answer["ys"]
    values = _drawn(quantity, answer)[:SHOWN_MAPS]
    half = [(np.ptp(places) / (len(places) - 1) if len(places) > 1 else 1.0) / 2 for places in (xs, ys)]
    extent = (xs[0] - half[0], xs[-1] + half[0], ys[0] - half[1], ys[-1] + half[1])
    wide = extent[1] - extent[0] > extent[3] - extent[2]
    rows, columns = (len(values), 1) if wide and len(values) < 4 else (-(-len(values) // 2), min(2, len(values)))
    ratio = (extent[3] - extent[2]) / (extent[1] - extent[0])
    figure = Figure(figsize=(1.5 + 6 * columns, 0.8 + rows * (0.5 + 6 * min(ratio, 2.0))), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    span = {"vmin": -180.0, "vmax": 180.0} if what == "best-beam" else _span(values)
    if what == "best-server":  # a colour of the map for each
        span = {"vmin": -0.5, "vmax": colormaps[quantity.colors].N - 0.5}
    for i, axis in enumerate(axes.flat):
        if i >= len(values):
            axis.axis("off")
            continue
        shown = axis.imshow(values[i], extent=extent, origin="lower", cmap=quantity.colors, aspect="equal", **span)
        axis.add_collection(LineCollection(list(walls), colors="black", linewidths=0.8))
        axis.plot(*stars[:, :2].T, "*", color="white", markeredgecolor="black", markersize=14)
        axis.set(xlim=extent[:2], ylim=extent[2:])
        axis.set_title(f"{answer['frequencies_hz'][i] / 1e9:g} GHz", fontsize=10)
    figure.supxlabel("x [m]", fontsize=9)
    figure.supylabel("y [m]", fontsize=9)
    ends = "receivers" if what in NETWORK else "transmitters"
    bar = figure.colorbar(shown, ax=axes, shrink=0.8, label=f"{quantity.label},\n{ends} {answer['height']:.3g} m high")
    if what == "best-server":
        bar.ax.set(ylim=(-0.5, len(stars) - 0.5), yticks=range(len(stars)))
    return figure


def draw_distribution(what: str, answer: dict[str, np.ndarray]) -> Figure:
    """Returns a figure of the cumulative distribution of a quantity over the positions of its maps at which antennas can be
    placed, one curve a frequency. Positions without any path count as lower than all others."""
    quantity = QUANTITIES[what]
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    for values, frequency in zip(_drawn(quantity, answer), answer["frequencies_hz"], strict=True):
        placed = np.sort(values[~answer["no_confidence"]])  # NaN last
        known = placed[np.isfinite(placed)]
        share = (len(placed) - len(known) + 1 + np.arange(len(known))) / max(len(placed), 1)
        axis.step(known, share, where="post", label=f"{frequency / 1e9:g} GHz")
    axis.set(xlabel=quantity.label, ylabel="share of the positions", ylim=(0, 1))
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    return figure


def _drawn(quantity: Quantity, answer: dict[str, np.ndarray]) -> Float[np.ndarray, "freq ny nx"]:
    values = answer[quantity.outputs[0]]
    if quantity.name == "best-beam":
        return answer["beam_azimuth_deg"][values]
    received = np.ones(values.shape, bool)
    if quantity.name == "power":
        received = values > NO_PATH_DB
    elif quantity.name in NETWORK:
        received = answer["received_dbm"].max(0) > NO_PATH_DB
    drawn = quantity.scale * np.where(received, values, np.nan)
    return drawn[..., 0] if drawn.ndim > 3 else drawn


def _span(values: Float[np.ndarray, "freq ny nx"]) -> dict[str, Any]:
    """Returns colour limits that exclude the lowest and the highest hundredth of the values."""
    low, high = np.nanquantile(values, [0.01, 0.99])
    return {"vmin": float(low), "vmax": float(high)}


SPACING, MARGIN = 0.1, 0.3
"""Pixel spacing and margin around the plan, metres."""
PIXELS = 40_000
"""Maximum number of pixels; the spacing grows for larger plans."""
AT_ONCE = 2048
SHOWN_RECEIVERS = 12
"""Maximum number of receivers in a plot."""
COLUMNS = 3


def draw_power_maps(learned: PowerMap, walls: Walls, cells: Readings) -> Figure:
    """Returns a figure with a map for every receiver at the median height of the measurements, with walls and cells."""
    height = float(np.median(cells.places[:, 2]))
    outline = np.concatenate([np.asarray(walls.ends).reshape(-1, 2), cells.places[:, :2], cells.receivers[:, :2]])
    low, high = outline.min(0) - MARGIN, outline.max(0) + MARGIN
    spacing = max(SPACING, float(np.sqrt(np.prod(high - low) / PIXELS)))
    x, y = (np.arange(low[k] + spacing / 2, high[k], spacing) for k in range(2))
    powers = _powers(learned, np.stack([*(a.ravel() for a in np.meshgrid(x, y)), np.full(len(x) * len(y), height)], -1))
    shown = min(SHOWN_RECEIVERS, len(cells.receivers))
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
