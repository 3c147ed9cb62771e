"""Pictures of a run: spectra (rectangular and polar), curves, SSIM by frequency. Written as PNG files, atomically."""

import json
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float, Int
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from wbgs_jax import metrics
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.files import atomic_write

matplotlib.use("Agg")

SHOWN = 6
"""Spectra in a picture."""


def draw_all(run: Path, dataset: Dataset, predicted: Float[np.ndarray, "n 90 360"], report: dict[str, Any]) -> list[Path]:
    """Draw everything into `run/pictures`; returns the files."""
    chosen = spread(dataset)
    truth, shown = np.asarray(dataset.pas(dataset.test[chosen])), predicted[chosen]
    titles = [_title(dataset, i) for i in dataset.test[chosen].tolist()]
    figures = {
        "spectra.png": draw_spectra(truth, shown, titles),
        "spectra_polar.png": draw_polar(truth, shown, titles),
        "ssim_by_frequency.png": draw_frequencies(report),
    }
    if (run / "metrics.jsonl").exists():
        figures["curves.png"] = draw_curves([json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()])
    return [_save(figure, run / "pictures" / name) for name, figure in figures.items()]


def spread(dataset: Dataset, count: int = SHOWN) -> Int[np.ndarray, "count"]:
    """Positions in `dataset.test` of a spread of frequencies, at different transmitters where there are enough."""
    test = dataset.test
    frequencies = np.unique(dataset.frequencies_hz[test])
    rng = np.random.default_rng(0)
    chosen: list[int] = []
    for frequency in frequencies[np.linspace(0, len(frequencies) - 1, min(count, len(test))).round().astype(int)]:
        candidates = np.flatnonzero(dataset.frequencies_hz[test] == frequency)
        used = dataset.tx_index[test[np.array(chosen, int)]]
        fresh = candidates[~np.isin(dataset.tx_index[test[candidates]], used)]
        chosen.append(int(rng.choice(fresh if len(fresh) else candidates)))
    return np.array(chosen)


def _title(dataset: Dataset, index: int) -> str:
    x, y, z = dataset.tx_positions[index]
    return f"{dataset.frequencies_hz[index] / 1e9:g} GHz, TX ({x:.1f}, {y:.1f}, {z:.1f}) m"


def draw_spectra(truth: Float[np.ndarray, "k 90 360"], predicted: Float[np.ndarray, "k 90 360"], titles: list[str]) -> Figure:
    """Truth, prediction and absolute error over azimuth and zenith, one row a spectrum."""
    figure, axes = plt.subplots(len(truth), 3, figsize=(13, 1.75 * len(truth) + 0.6), layout="constrained", squeeze=False)
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
    """The receiver's hemisphere seen from above: the zenith in the middle, the horizon at the rim."""
    figure, axes = plt.subplots(
        2, len(truth), figsize=(2.6 * len(truth), 5.8), layout="constrained", squeeze=False, subplot_kw={"projection": "polar"}
    )
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
    """Loss, SSIM of the batches and of held-out spectra, and the number of Gaussians over the steps."""
    steps = [e for e in entries if "loss" in e]
    held_out = [e for e in steps if "held_out_ssim" in e]
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.6), layout="constrained")
    axes[0].plot([e["step"] for e in steps], [e["loss"] for e in steps], color="C0")
    axes[0].set(title="training loss", xlabel="step", ylabel="(1 - λ) L1 + λ (1 - SSIM)")
    axes[1].plot(
        [e["step"] for e in steps],
        [e["batch_ssim"] for e in steps],
        color="C0",
        alpha=0.6,
        label="training batches, mean (11x11)",
    )
    axes[1].plot(
        [e["step"] for e in held_out],
        [e["held_out_ssim"] for e in held_out],
        "o-",
        color="C3",
        label="held-out sample, median (7x7)",
    )
    axes[1].set(title="SSIM", xlabel="step")
    axes[1].legend(fontsize=8)
    axes[2].plot([e["step"] for e in steps], [e["gaussians"] for e in steps], color="C2")
    axes[2].set(title="living Gaussians", xlabel="step", ylim=(0, None))
    for axis in axes:
        axis.grid(alpha=0.3)
    return figure


def draw_frequencies(report: dict[str, Any]) -> Figure:
    """Median SSIM by frequency of the field and of every reference."""
    figure, axis = plt.subplots(figsize=(8, 4.2), layout="constrained")
    series = {report["field"]: report} | {name.replace("_", " "): r for name, r in report["references"].items()}
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
    plt.close(figure)
    return path
