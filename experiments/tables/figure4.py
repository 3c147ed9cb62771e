"""Figure 4: predicted spectra beside the truth, at eight frequencies and as many held-out transmitters."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import pyplot as plt

from experiments.execute import pictured
from experiments.jobs import PICTURED_GHZ, PICTURED_SCENES, Job
from experiments.results import Results
from experiments.tables import table1
from experiments.tables.cells import NAMES, NOT_RUN
from experiments.tables.plots import save
from wbgs_jax import metrics

TITLE = "Figure 4: predicted spectra"


def jobs() -> list[Job]:
    """Jobs of table 1 that keep pictures."""
    return [job for job in table1.jobs() if job.pictured]


def render(results: Results, images: Path) -> str:
    """Returns a picture per scene: a row per model, a column per frequency and held-out transmitter."""
    note = (
        "Every column is another held-out transmitter, drawn without a look at the results; in a picture zenith runs down from"
        " 0 to 90 degrees, azimuth to the right, and colours go from 0 (dark) to 1. Above each prediction stands its SSIM."
    )
    return "\n\n".join([note, *(scene_picture(results, images, scene) for scene in PICTURED_SCENES)])


def scene_picture(results: Results, images: Path, scene: str) -> str:
    """The picture of a scene, with a mark where a model was not run."""
    own = [job for job in jobs() if job.scene == scene]
    missing = [NAMES[job.field, job.variant] for job in own if results.pictures(job) is None]
    mark = f"{NOT_RUN}: {', '.join(missing)}" if missing else ""
    if len(missing) == len(own):
        return f"**Scene {scene}**: {mark}"
    shown = {NAMES[job.field, job.variant]: results.pictures(job) for job in own}
    picture = draw(truth_of(own[0]), {name: p / 255 for name, p in shown.items() if p is not None})
    alt = f"scene {scene}: truth and predictions at eight frequencies"
    return f"**Scene {scene}**" + f" ({mark})" * bool(mark) + "\n\n" + save(picture, images, f"figure4_scene{scene}", alt)


def truth_of(job: Job) -> Float[np.ndarray, "k 90 360"]:
    """Returns the truth of a scene's pictures."""
    dataset = job.dataset()
    return np.asarray(dataset.pas(dataset.test[pictured(dataset)]))


def draw(truth: Float[np.ndarray, "k 90 360"], predicted: dict[str, Float[np.ndarray, "k 90 360"]]) -> plt.Figure:
    """One row the truth, one a model."""
    rows = {"truth": truth} | predicted
    figure, axes = plt.subplots(
        len(rows), len(truth), figsize=(15, 1.05 * len(rows) + 0.3), layout="constrained", squeeze=False
    )
    for line, (name, spectra) in zip(axes, rows.items(), strict=True):
        ssim = metrics.ssim(spectra, truth)
        for axis, image, score, ghz in zip(line, spectra, ssim, PICTURED_GHZ, strict=True):
            axis.imshow(image, vmin=0, vmax=1, cmap="viridis", aspect="auto")
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_title(f"{ghz:g} GHz" if name == "truth" else f"{score:.2f}", fontsize=8, pad=2)
        line[0].set_ylabel(name.replace(", ", ",\n").replace(" (", "\n("), fontsize=8, rotation=0, ha="right", va="center")
    return figure
