"""Figures, written as PNG, SVG or PDF files, atomically: spectra (rectangular and polar), training curves and SSIM by frequency
of a run; every quantity that `wbgs-jax predict` provides; maps of a quantity over a floor with walls and receiver; maps of
received power over a floor plan.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from wbgs_jax import metrics
from wbgs_jax._util.cli import point_words
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write
from wbgs_jax._util.pytree import map_blocks
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.floor_plan import Walls
from wbgs_jax.data.rssi_folder import Readings
from wbgs_jax.inference.quantities import NETWORK, QUANTITIES, Quantity
from wbgs_jax.inference.queries import Queries, shown_rows
from wbgs_jax.panels import clipped, make_panels, name_axes, name_curves, name_frequencies
from wbgs_jax.power_map.model import PowerMap, received_power
from wbgs_jax.radio.channel import NO_PATH_DB


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
    for figure in figures.values():
        figure.suptitle(origin_words(report), fontsize=9)
    return [save(figure, folder / name) for name, figure in figures.items()]


def spread(dataset: Dataset, index: Int[np.ndarray, " n"], count: int = 6) -> Int[np.ndarray, " count"]:
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
    return f"{dataset.frequencies_hz[index] / 1e9:g} GHz, TX ({x:.2f}, {y:.2f}, {z:.2f}) m"


def draw_spectra(truth: Float[np.ndarray, "k 90 360"], predicted: Float[np.ndarray, "k 90 360"], titles: list[str]) -> Figure:
    """Returns truth, prediction and absolute error, on a scale of its own, over azimuth and zenith, one row per spectrum."""
    figure = Figure(figsize=(13, 1.75 * len(truth) + 0.6), layout="constrained")
    axes = figure.subplots(len(truth), 3, squeeze=False)
    tops = (1.0, 1.0, max(float(np.abs(truth - predicted).max()), np.finfo(np.float32).eps))
    ssim = metrics.ssim(predicted, truth)
    for row, (a, b, title, score) in enumerate(zip(truth, predicted, titles, ssim, strict=True)):
        images = (a, b, np.abs(a - b))
        labels = (f"truth: {title}", f"prediction: SSIM {score:.3f}", f"|error|: mean {images[2].mean():.3f}")
        colors = (COLORS, COLORS, "magma")
        for axis, image, label, top, cmap in zip(axes[row], images, labels, tops, colors, strict=True):
            shown = axis.imshow(image, vmin=0, vmax=top, cmap=cmap, extent=(-180, 180, 90, 0), aspect="auto")
            axis.set_title(label, fontsize=9)
            axis.set_xticks(range(-180, 181, 90))
            axis.set_yticks((0, 45, 90))
        axes[row, 0].set_ylabel("zenith [deg]")
    for axis in axes[-1]:
        axis.set_xlabel("azimuth [deg]")
    figure.colorbar(axes[0, 0].images[0], ax=axes[:, :2], shrink=0.5, label="normalised amplitude")
    figure.colorbar(shown, ax=axes[:, 2], shrink=0.5, label="error of the amplitude")
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
    counts = ("gaussians",)  # counts of a field that change during training
    sizes = [name for name in counts if any(name in e for e in steps)]
    figure = Figure(figsize=(13 if sizes else 9, 3.6), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, 3 if sizes else 2))
    axes[0].plot([e["step"] for e in steps], [e["loss"] for e in steps], color="C0")
    axes[0].set(title="training loss", xlabel="step", ylabel="loss")
    batch = [(e["step"], e["batch_ssim"]) for e in steps if e.get("batch_ssim") is not None]
    if batch:
        axes[1].plot(*zip(*batch, strict=True), color="C0", alpha=0.6, label="training batches: mean SSIM (11x11)")
    for name in held_out:
        points = [(e["step"], e[name]) for e in steps if name in e]
        label = "held-out sample: median SSIM (7x7)" if name == "held_out_ssim" else name.replace("_", " ")
        axes[1].plot(*zip(*points, strict=True), "o-", color="C3", label=label)
    axes[1].set(title="quality", xlabel="step", ylabel="SSIM")
    if batch or held_out:
        axes[1].legend(fontsize=8)
    for name in sizes:
        axes[2].plot([e["step"] for e in steps], [e.get(name) for e in steps], color="C2")
        axes[2].set(title=name, xlabel="step", ylabel="number", ylim=(0, None))
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
    longest_arrow = 0.1  # length of the longest arrow, relative to the scene's size
    longest = longest_arrow * np.ptp(corners.reshape(-1, 3), axis=0).max() / max(size.max() * 1e-3, 1e-9)
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
    return save(figure, folder / "surfaces_moved.png")


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
    axis.set(xscale="log", xlabel="frequency [GHz]", ylabel="median SSIM", title="held-out spectra", ylim=(0, 1))
    axis.set_xticks(ticks, [f"{t:g}" for t in ticks], fontsize=8, rotation=45)
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, title="overall median", title_fontsize=8)
    return figure


def save(figure: Figure, path: Path) -> Path:
    """Writes a figure in the format that the suffix of the file names; returns the file."""
    dots = 110  # pixels per inch
    with atomic_write(path) as stream:
        figure.savefig(stream, format=path.suffix[1:], dpi=dots)
    return path


COLORS = "viridis"
FADED_DB = 40.0
"""Paths and taps of impulse responses are drawn that are less than this below the strongest one."""
STAR: dict[str, Any] = {
    "marker": "*",
    "color": "white",
    "markeredgecolor": "black",
    "markersize": 14,
    "linestyle": "none",
    "label": "receiver",
}


def draw_prediction(
    what: str, found: Mapping[str, np.ndarray], queries: Queries, source: Mapping[str, Any], walls: Float[np.ndarray, "n 2 2"]
) -> Figure:
    """Returns a figure of a quantity of `wbgs-jax predict`, named by scene, field and receiver.

    Args:
        what: name of the quantity (`quantities.QUANTITIES`).
        found: its arrays; the leading axis of those that are not common to all queries is the queries, or a table's rows.
        queries: the queries, paired unless the quantity is a number.
        source: provenance (`LoadedField.source`).
        walls: ends of the walls of the floor plan, metres; only paths need them.
    """
    quantity, places = QUANTITIES[what], source["receiver"]["position"]
    if quantity.form == "scalar":
        figure = draw_sweeps(quantity, found, queries, source.get("power_interval_level"))
    elif what == "spectra":
        figure = draw_answers(found, queries)
    elif what == "paths":
        figure = draw_paths(found, queries, walls, np.asarray(places))
    elif what == "frequency-response":
        figure = draw_responses(found, queries)
    elif what == "mimo":
        figure = draw_matrices(found["mimo"], queries)
    else:
        figure = draw_snapshots(found["snapshots"], queries)
    figure.suptitle(f"{origin_words(source)}, receiver {point_words(np.asarray(places))}", fontsize=9)
    return figure


def origin_words(source: Mapping[str, Any]) -> str:
    """Returns scene and field of a figure."""
    return f"{source['scene']}, {source['field']} field"


def _link_titles(queries: Queries) -> list[str]:
    positions, frequencies = queries.flat()
    return [f"{hertz / 1e9:.4g} GHz, TX {point_words(place)}" for place, hertz in zip(positions, frequencies, strict=True)]


def _amplitude_db(amplitude: Any) -> Float[np.ndarray, "*shape"]:
    """Returns powers of complex amplitudes in dB; NaN where nothing arrives."""
    power = np.abs(np.asarray(amplitude, np.complex128)) ** 2
    received = power > 10 ** (NO_PATH_DB / 10)
    return np.where(received, 10 * np.log10(np.where(received, power, 1.0)), np.nan)


def draw_answers(found: Mapping[str, np.ndarray], queries: Queries) -> Figure:
    """Returns a figure of spectra over azimuth and zenith with their expected SSIM, two per row."""
    titles = _link_titles(queries)
    for i, (ssim, low, high) in enumerate(found.get("expected", ())):
        titles[i] += "" if np.isnan(ssim) else f"\nexpected SSIM {ssim:.2f} ({low:.2f} to {high:.2f})"
    figure, axes = make_panels(titles, 2, (5.4, 2.1), sharex=True, sharey=True)
    for axis, pas in zip(axes, found["pas"], strict=True):
        shown = axis.imshow(pas, vmin=0, vmax=1, cmap=COLORS, extent=(-180, 180, 90, 0), aspect="auto")
        axis.set(xticks=range(-180, 181, 90), yticks=(0, 45, 90))
    name_axes(axes, "azimuth [deg]", "zenith [deg]")
    figure.colorbar(shown, ax=axes, shrink=0.8, label="normalised amplitude")
    return figure


def draw_paths(
    found: Mapping[str, np.ndarray], queries: Queries, walls: Float[np.ndarray, "n 2 2"], rx: Float[np.ndarray, "3"]
) -> Figure:
    """Returns a figure of the strongest paths of links from above, coloured by power, on the floor plan.

    Raises:
        UserError: the field does not predict where paths bend.
    """
    if "points_m" not in found:
        raise UserError("the paths of this field have no points to draw; give --out paths.csv, and no --picture")
    positions, frequencies = queries.flat()
    figure, axes = make_panels(_link_titles(queries), 2, (4.6, 3.9), sharex=True, sharey=True)
    figure.set_layout_engine("compressed")  # panels keep their aspect
    shown = ScalarMappable(Normalize(-FADED_DB, 0), "plasma")
    link = np.stack([found[name] for name in ("x", "y", "z", "frequency_ghz")], -1)
    disc: dict[str, Any] = {
        "marker": "o",
        "color": "white",
        "markeredgecolor": "black",
        "markersize": 7,
        "linestyle": "none",
        "label": "transmitter",
    }
    for axis, place, hertz in zip(axes, positions, frequencies, strict=True):
        own = np.flatnonzero((link == [*place, hertz / 1e9]).all(-1))
        own = own[found["tx"][own] == found["tx"][own[:1]]]  # a link may be queried twice
        top = found["power_db"][own].max(initial=NO_PATH_DB)
        power = found["power_db"][own] - top
        strong = np.argsort(power)[(np.sort(power) > -FADED_DB)]  # the strongest on top
        axis.add_collection(LineCollection(list(walls), colors="grey", linewidths=0.8))
        lines = list(found["points_m"][own[strong]][..., :2])
        axis.add_collection(LineCollection(lines, colors=shown.to_rgba(power[strong]), linewidths=1.0))
        axis.plot(*rx[:2], **STAR)
        axis.plot(*place[:2], **disc)
        axis.set_aspect("equal")
        words = f"{len(strong)} of {len(own)} paths, the strongest {top:.1f} dB of the transmitted" if len(own) else "no paths"
        axis.set_title(f"{axis.get_title()}\n{words}", fontsize=8)
    axes[0].legend(fontsize=8, loc="upper right")
    name_axes(axes, "x [m]", "y [m]")
    figure.colorbar(shown, ax=axes, shrink=0.8, label="power of a path [dB of the strongest]")
    return figure


def draw_responses(found: Mapping[str, np.ndarray], queries: Queries) -> Figure:
    """Returns a figure of frequency and impulse responses of the first element, a curve for every link."""
    figure = Figure(figsize=(8, 7), layout="constrained")
    above, below = figure.subplots(2, 1)
    names = ("frequency_response", "impulse_response")
    response, impulses = (_amplitude_db(found[name][..., 0]) for name in names)
    for share, title, one, other in zip(_shares(len(queries)), _link_titles(queries), response, impulses, strict=True):
        style: dict[str, Any] = {"lw": 1.2, "color": colormaps[COLORS](share), "label": title, "marker": ".", "ms": 3}
        above.plot(found["offsets_hz"] / 1e6, one, **style)
        below.plot(found["delays_s"] * 1e9, other, **style)
    unit = f"first of {found['frequency_response'].shape[-1]} elements [dB of the transmitted]"
    above.set(xlabel="frequency relative to the carrier [MHz]", ylabel=f"frequency response,\n{unit}")
    below.set(xlabel="delay, modulo the longest one shown [ns]", ylabel=f"impulse response,\n{unit}")
    if np.isfinite(impulses).any():
        below.set_ylim(np.nanmax(impulses) - FADED_DB, np.nanmax(impulses) + 3)
    name_curves(above)
    for axis in (above, below):
        axis.grid(alpha=0.3)
    return figure


def draw_matrices(matrices: Complex[np.ndarray, "n elements m"], queries: Queries) -> Figure:
    """Returns a figure of MIMO matrices, powers in dB."""
    figure, axes = make_panels(_link_titles(queries), 3, (3.4, 3.6), sharex=True, sharey=True)
    values = _amplitude_db(matrices)
    span: Any = {"vmin": float(np.nanmin(values)), "vmax": float(np.nanmax(values))} if np.isfinite(values).any() else {}
    elements, columns = matrices.shape[1:]
    for axis, value in zip(axes, values, strict=True):
        shown = axis.imshow(value, cmap=COLORS, aspect="auto", extent=(0.5, columns + 0.5, elements + 0.5, 0.5), **span)
        axis.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    name_axes(axes, "number of the transmitter's element", "number of the receiver's element")
    figure.colorbar(shown, ax=axes, shrink=0.8, label="power of the channel [dB of the transmitted]")
    return figure


def draw_snapshots(snapshots: Complex[np.ndarray, "n elements"], queries: Queries) -> Figure:
    """Returns a figure of snapshots: power and phase at every element, in a colour for every link."""
    figure = Figure(figsize=(8, 6), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    numbers = np.arange(1, snapshots.shape[-1] + 1)
    for share, title, values in zip(_shares(len(queries)), _link_titles(queries), snapshots, strict=True):
        style: dict[str, Any] = {"linestyle": "none", "marker": "o", "ms": 5, "color": colormaps[COLORS](share), "label": title}
        axes[0].plot(numbers, _amplitude_db(values), **style)
        axes[1].plot(numbers, np.degrees(np.angle(values)), **style)
    axes[0].set_ylabel("power [dB of the transmitted]")
    axes[1].set(xlabel="number of the receiver's element", ylabel="phase [deg]", ylim=(-185, 185), yticks=range(-180, 181, 90))
    name_curves(axes[0])
    for axis in axes:
        axis.grid(alpha=0.3)
    return figure


def _shares(count: int) -> Float[np.ndarray, " n"]:
    """Returns where the colours of curves lie in the colour map, whose bright end is hard to see."""
    return np.linspace(0, 0.9, count)


def draw_sweeps(quantity: Quantity, found: Mapping[str, np.ndarray], queries: Queries, level: float | None) -> Figure:
    """Returns a figure of a quantity: over the frequency where there are more of these than transmitters, a curve each; else
    over the distance from the first transmitter along the way to the last; of single queries over their numbers.

    Args:
        quantity: the quantity; of two columns the second one is dashed.
        found: its arrays, with a leading axis of all queries.
        queries: the queries.
        level: probability of the intervals of powers, if there are any.
    """
    figure = Figure(figsize=(8, 4.6), layout="constrained")
    axis = figure.subplots()
    values = quantity.scale * found[quantity.outputs[0]].reshape(*queries.shape, -1)
    if quantity.name == "power":
        values = np.where(values > NO_PATH_DB, values, np.nan)
    within = found["within_db"].reshape(queries.shape) if "within_db" in found else np.full(queries.shape, np.nan)
    places, legend = _places(axis, queries)
    if queries.paired:
        curves, bounds = values[None], within[None]
    elif len(queries.frequencies_hz) > len(queries.tx_positions):
        curves, bounds = values, within
    else:
        curves, bounds = np.moveaxis(values, 1, 0), within.T
    order = np.argsort(places, kind="stable")  # frequencies may be given in any order
    places, curves, bounds = places[order], curves[:, order], bounds[:, order]
    chosen, label = shown_rows(len(curves)), quantity.label
    joined = "none" if queries.paired or len(places) == 1 else "-"  # a line between single points would mean nothing
    style: dict[str, Any] = {"marker": "o" if joined == "none" else ".", "ms": 5 if joined == "none" else 3, "lw": 1.2}
    for share, number in zip(_shares(len(chosen)), chosen, strict=True):
        curve, color = curves[number], colormaps[COLORS](share)
        axis.plot(places, curve[:, 0], linestyle=joined, label=legend[number], color=color, **style)
        if curve.shape[-1] > 1:
            axis.plot(places, curve[:, 1], linestyle="none" if joined == "none" else "--", color=color, mfc="white", **style)
        if level is None or not np.isfinite(bounds[number]).any():
            continue
        ends = curve[:, 0] - bounds[number], curve[:, 0] + bounds[number]
        if joined == "none":
            axis.errorbar(places, curve[:, 0], bounds[number], fmt="none", ecolor=color, capsize=3)
        else:
            axis.fill_between(places, *ends, color=color, alpha=0.15, lw=0)
        label = f"{quantity.label}\nand its {100 * level:.0f} % interval"
    if values.shape[-1] > 1:
        label = label.replace("the azimuth", "azimuth (filled) and\nzenith (open, dashed)")
    if legend != [""]:
        name_curves(axis, "" if len(chosen) == len(curves) else f"{len(chosen)} of {len(curves)}")
    axis.set_ylabel(label)
    axis.grid(alpha=0.3)
    return figure


def _places(axis: Axes, queries: Queries) -> tuple[Float[np.ndarray, " n"], list[str]]:
    """Names the axis over which a quantity is drawn; returns the places on it, and the words for every curve."""
    if queries.paired:
        axis.set_xlabel("number of the query")
        axis.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        return np.arange(1, len(queries) + 1.0), [""]
    if len(queries.frequencies_hz) > len(queries.tx_positions):
        name_frequencies(axis, queries.frequencies_hz / 1e9)
        return queries.frequencies_hz / 1e9, [f"TX {point_words(tx)}" for tx in queries.tx_positions]
    steps = np.linalg.norm(np.diff(queries.tx_positions, axis=0), axis=-1)
    first, last = (point_words(queries.tx_positions[i]) for i in (0, -1))
    if len(steps):
        axis.set_xlabel(f"distance along the transmitters from {first.removesuffix(' m')} to {last.removesuffix(' m')} [m]")
    else:
        axis.set_xticks([0.0], [f"TX {first}"])
    return np.concatenate([[0.0], np.cumsum(steps)]), [f"{frequency / 1e9:.4g} GHz" for frequency in queries.frequencies_hz]


def draw_channel(found: Mapping[str, np.ndarray], source: Mapping[str, Any], frequency_hz: float) -> Figure:
    """Returns a figure of a channel over time (`applications.movement.channel_over_time`, with `time_s`): its power, and its
    Doppler spectrogram from the strongest part down to `FADED_DB` below it."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(found["time_s"], _amplitude_db(found["response"]), linewidth=1)
    above.set(ylabel="power [dB of the transmitted]")
    doppler = found["doppler_db"]
    bars = {"vmin": float(doppler.max()) - FADED_DB, "vmax": float(doppler.max())}
    shown = below.pcolormesh(found["doppler_time_s"], found["doppler_hz"], doppler, cmap=COLORS, shading="nearest", **bars)
    below.set(xlabel="time [s]", ylabel="Doppler shift [Hz]")
    figure.colorbar(shown, ax=below, label="power [dB of the transmitted]", extend=clipped(doppler, **bars))
    figure.suptitle(f"{origin_words(source)}, {frequency_hz / 1e9:g} GHz", fontsize=9)
    return figure


def draw_maps(what: str, answer: dict[str, np.ndarray], walls: Float[np.ndarray, "n 2 2"], source: Mapping[str, Any]) -> Figure:
    """Returns a figure of the first six maps with the walls that the plane cuts. Stars are the receiver
    or, for quantities of several transmitters, these. `source` is the provenance (`LoadedField.source`)."""
    quantity, xs, ys = QUANTITIES[what], answer["xs"], answer["ys"]
    network = what in NETWORK
    stars = answer["tx_positions"] if network else np.array([source["receiver"]["position"]])
    values = _drawn(quantity, answer)[:6]
    extent = _extent(xs, ys)
    wide = extent[1] - extent[0] > extent[3] - extent[2]
    rows, columns = (len(values), 1) if wide and len(values) < 4 else (-(-len(values) // 2), min(2, len(values)))
    ratio = (extent[3] - extent[2]) / (extent[1] - extent[0])
    lowest = 4.0  # inches, for the label of the colour bar
    height = max(0.8 + rows * (0.5 + 6 * min(ratio, 2.0)), lowest)
    figure = Figure(figsize=(1.5 + 6 * columns, height), layout="compressed")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    span = {"vmin": -180.0, "vmax": 180.0} if what == "best-beam" else _span(values)
    colors: Any = quantity.colors
    if what == "best-server":  # a colour of the map for each
        colors = colormaps[quantity.colors]
        colors = colors if len(stars) <= colors.N else colormaps["turbo"].resampled(len(stars))
        span = {"vmin": -0.5, "vmax": colors.N - 0.5}
    for i, axis in enumerate(axes.flat):
        if i >= len(values):
            axis.axis("off")
            continue
        finite = np.minimum(values[i], span["vmax"])  # infinite K-factors of single paths have the colour of the largest
        shown = axis.imshow(finite, extent=extent, origin="lower", cmap=colors, aspect="equal", **span)
        axis.add_collection(LineCollection(list(walls), colors="black", linewidths=0.8))
        axis.plot(*stars[:, :2].T, **STAR | {"label": "transmitters" if network else "receiver"})
        axis.set(xlim=extent[:2], ylim=extent[2:])
        axis.set_title(f"{answer['frequencies_hz'][i] / 1e9:g} GHz", fontsize=10)
    axes[0, 0].legend(fontsize=8, loc="upper right")
    name_axes(axes.flat, "x [m]", "y [m]")
    ends = "receivers" if network else "transmitters"
    figure.suptitle(f"{origin_words(source)}, {ends} {answer['height']:.3g} m high", fontsize=9)
    bar = figure.colorbar(shown, ax=axes, shrink=0.8, label=quantity.label, extend=clipped(values, **span))
    if what == "best-server":
        bar.ax.set(ylim=(-0.5, len(stars) - 0.5), yticks=range(len(stars)))
    return figure


def _extent(xs: Float[np.ndarray, " nx"], ys: Float[np.ndarray, " ny"]) -> tuple[float, float, float, float]:
    """Returns the ends of a map whose squares have these centres; along an axis with one centre they are as wide as along the
    other one."""
    steps = [float(np.ptp(places)) / (len(places) - 1) if len(places) > 1 else 0.0 for places in (xs, ys)]
    x, y = (0.5 * (step or max(steps) or 1.0) for step in steps)
    return float(xs[0] - x), float(xs[-1] + x), float(ys[0] - y), float(ys[-1] + y)


def draw_distribution(what: str, answer: dict[str, np.ndarray], source: Mapping[str, Any]) -> Figure:
    """Returns a figure of the cumulative distribution of a quantity over the positions of its maps at which antennas can be
    placed, one curve a frequency. Positions without any path count as lower than all others. `source` is the provenance
    (`LoadedField.source`)."""
    quantity = QUANTITIES[what]
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    for values, frequency in zip(_drawn(quantity, answer), answer["frequencies_hz"], strict=True):
        placed = np.sort(values[~answer["no_confidence"]])  # infinite ones behind all finite ones, NaN last
        known, lower = placed[np.isfinite(placed)], np.isnan(placed).sum()
        share = (lower + 1 + np.arange(len(known))) / max(len(placed), 1)
        alone = "o" if len(known) == 1 else ""  # no line can be seen
        axis.step(known, share, where="post", marker=alone, label=f"{frequency / 1e9:g} GHz")
    axis.set(xlabel=quantity.label, ylabel="share of the positions", ylim=(0, 1))
    axis.set_title(origin_words(source), fontsize=9)
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
        relative = answer["received_dbm"] - answer["tx_power_dbm"][:, None, None, None]
        received = relative.max(0) > NO_PATH_DB
    drawn = quantity.scale * np.where(received, values, np.nan)
    return drawn[..., 0] if drawn.ndim > 3 else drawn


def _span(values: Float[np.ndarray, "freq ny nx"]) -> dict[str, Any]:
    """Returns colour limits that exclude the lowest and the highest hundredth of the values."""
    finite = values[np.isfinite(values)]
    low, high = np.quantile(finite, [0.01, 0.99]) if finite.size else (0.0, 1.0)
    return {"vmin": float(low), "vmax": float(high)}


def draw_power_maps(learned: PowerMap, walls: Walls, cells: Readings) -> Figure:
    """Returns a figure with a map for every receiver at the median height of the measurements, with walls and the cells of that
    storey."""
    height = float(np.quantile(cells.places[:, 2], 0.5, method="nearest"))
    storey = 1.0  # metres above or below the map of cells that are shown
    places = cells.places[np.abs(cells.places[:, 2] - height) < storey]
    outline = np.concatenate([np.asarray(walls.ends).reshape(-1, 2), places[:, :2], cells.receivers[:, :2]])
    finest, margin = 0.1, 0.3  # pixel spacing and margin around the plan, metres
    most_pixels, most_receivers = 40_000, 12  # the spacing grows for larger plans
    low, high = outline.min(0) - margin, outline.max(0) + margin
    spacing = max(finest, float(np.sqrt(np.prod(high - low) / most_pixels)))
    x, y = (np.arange(low[k] + spacing / 2, high[k], spacing) for k in range(2))
    pixels = np.stack([*(a.ravel() for a in np.meshgrid(x, y)), np.full(len(x) * len(y), height)], -1)
    powers = map_blocks(lambda block: received_power(learned, jnp.asarray(block, jnp.float32))[0], pixels, 2048)
    titles = cells.titles[:most_receivers]
    width, depth = 4.1 * (high - low) / max(high - low)
    figure, axes = make_panels(titles, 3, (width, depth), sharex=True, sharey=True)
    norm = Normalize(*np.quantile(powers[:, : len(axes)], (0, 1)))
    extent = (low[0], low[0] + spacing * len(x), low[1], low[1] + spacing * len(y))
    for r, axis in enumerate(axes):
        image = axis.imshow(powers[:, r].reshape(len(y), len(x)), extent=extent, origin="lower", cmap=COLORS, norm=norm)
        for wall in np.asarray(walls.ends):
            axis.plot(wall[:, 0], wall[:, 1], color="black", linewidth=1.2)
        axis.plot(places[:, 0], places[:, 1], ".", color="black", markersize=1, alpha=0.5)
        axis.plot(*cells.receivers[r, :2], **STAR)
    axes[0].legend(fontsize=8, loc="upper right")
    name_axes(axes, "x [m]", "y [m]")
    figure.colorbar(image, ax=axes, shrink=0.8, label=f"mean received power [dBm]\nat z = {height:.2g} m")
    return figure
