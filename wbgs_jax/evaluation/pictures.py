"""Pictures of a run: spectra (rectangular and polar), curves, SSIM by frequency. Written as PNG files, atomically."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from wbgs_jax._util.files import atomic_write
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.evaluation import metrics

SHOWN = 6
"""Spectra in a picture."""
LONGEST_ARROW = 0.1
"""Of the scene's size."""
SIZES = ("gaussians",)
"""Sizes of a field that change during training."""


def draw_all(
    folder: Path,
    dataset: Dataset,
    index: Int[np.ndarray, " n"],
    predicted: Float[np.ndarray, "n 90 360"],
    report: dict[str, Any],
    curves: list[dict[str, Any]],
) -> list[Path]:
    """Draws predicted spectra of some links, the report and the curves of a training into a folder; returns the files."""
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
    """Returns places in `index` of a spread of frequencies, at different transmitters where there are enough."""
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
    """Returns truth, prediction and absolute error over azimuth and zenith, one row a spectrum."""
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
    """Returns loss, metrics of the batches and of held-out links, and the sizes that change, over the steps."""
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
    axes[1].set(title="how good it is", xlabel="step")
    if batch or held_out:
        axes[1].legend(fontsize=8)
    for name in sizes:
        axes[2].plot([e["step"] for e in steps], [e.get(name) for e in steps], color="C2")
        axes[2].set(title=name, xlabel="step", ylim=(0, None))
    for axis in axes:
        axis.grid(alpha=0.3)
    return figure


def draw_motion(folder: Path, corners: Float[np.ndarray, "f k 3"], shift: Float[np.ndarray, "f 3"]) -> Path:
    """Draws how far a training has moved the surfaces of a mesh, seen from above and from the side; returns the file."""
    figure = Figure(figsize=(10, 7), layout="constrained")
    axes, size = figure.subplots(2, 1), 1e3 * np.linalg.norm(shift, axis=-1)
    colours = colormaps["viridis"](size / max(size.max(), 1e-9))
    different, first, body = np.unique(shift, axis=0, return_index=True, return_inverse=True)  # what moves alike is one thing
    centre = np.array([corners[body.reshape(-1) == k].mean((0, 1)) for k in range(len(different))])
    longest = LONGEST_ARROW * np.ptp(corners.reshape(-1, 3), axis=0).max() / max(size.max() * 1e-3, 1e-9)
    for axis, (i, j), name in zip(axes, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        outlines = np.concatenate([corners, corners[:, :1]], 1)[..., [i, j]]
        axis.add_collection(LineCollection(list(outlines), colors=colours, linewidths=0.8))
        arrows = *centre[:, [i, j]].T, *(longest * different[:, [i, j]].T)
        axis.quiver(*arrows, color=colours[first], angles="xy", scale_units="xy", scale=1)
        axis.set(
            title=f"{name} (arrows {longest:.0f} times too long)", xlabel="x [m]", ylabel=f"{'xyz'[j]} [m]", aspect="equal"
        )
        axis.autoscale_view()
    shown = ScalarMappable(Normalize(0, size.max()), "viridis")
    figure.colorbar(shown, ax=axes, label="moved by [mm]", shrink=0.8)
    return _save(figure, folder / "surfaces_moved.png")


def draw_frequencies(report: dict[str, Any]) -> Figure:
    """Returns the median SSIM by frequency of the field and of every baseline."""
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
