"""Figure 6: training loss in six scenes."""

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

from experiments.jobs import Job
from experiments.paper import SCENES
from experiments.results import Results
from experiments.tables import table1
from experiments.tables.cells import NOT_RUN
from experiments.tables.plots import save

TITLE = "Figure 6: training loss"
WINDOW = 0.1
"""Width of the moving average, as a share of the training (the paper's: 7,500 spectra)."""


def jobs() -> list[Job]:
    """Jobs of table 1, first seed."""
    return [table1.jobs_of(scene, "wideband")[0] for scene in SCENES]


def render(results: Results, images: Path) -> str:
    """Six small curves, each with its moving average."""
    found = {job.scene: results.get(job) for job in jobs()}
    missing = [scene for scene, result in found.items() if result is None]
    mark = f"Scenes {', '.join(missing)}: {NOT_RUN}." if missing else ""
    if len(missing) == len(found):
        return mark
    curves = {scene: result.values["curve"] for scene, result in found.items() if result}
    note = "The wideband field's loss, first seed: means of blocks of steps (pale), and their mean over a tenth of all steps."
    return "\n\n".join(filter(None, [note, mark, save(draw(curves), images, "figure6", "training loss by scene")]))


def draw(curves: dict[str, dict[str, list[float]]]) -> plt.Figure:
    """A panel a scene; an empty one where there is no run."""
    figure, axes = plt.subplots(2, 3, figsize=(11, 5), layout="constrained", sharex=True, sharey=True)
    for axis, scene in zip(axes.flat, SCENES, strict=True):
        axis.set_title(f"scene {scene}", fontsize=10)
        axis.grid(alpha=0.3)
        if scene in curves:
            steps, loss = np.array(curves[scene]["step"]), np.array(curves[scene]["loss"])
            width = max(1, round(WINDOW * len(loss)))
            axis.plot(steps, loss, color="C0", alpha=0.4, lw=1)
            axis.plot(steps[width - 1 :], np.convolve(loss, np.ones(width) / width, "valid"), color="C0", lw=2)
        else:
            axis.text(0.5, 0.5, NOT_RUN, transform=axis.transAxes, ha="center")
    for axis in axes[-1]:
        axis.set_xlabel("step")
    for axis in axes[:, 0]:
        axis.set_ylabel("(1 - λ) L1 + λ (1 - SSIM)")
    return figure
