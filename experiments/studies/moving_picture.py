"""A moving picture of a trained field: a transmitter walks through the room, and frequencies sweep; truth beside prediction.

python -m experiments.studies.moving_picture --run runs/scene4-hybrid-cpu-seed0 [--out docs/images/walk_scene4.gif]

Only transmitters that the field has not seen in training are shown, so that there is a truth at every step.
"""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # read with JAX; see wbgs_jax/_util/quiet.py

# isort: split

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, Int
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.inference.predictor import observe
from wbgs_jax.inference.radio_map import cut_at
from wbgs_jax.metrics import ssim
from wbgs_jax.training.run_folder import load_trained
from wbgs_jax.viewer.session import stops_of_walk

COLORS = 256
"""In the file."""


@dataclass(frozen=True)
class Command:
    """Draw a walk through a scene as an animated GIF."""

    run: Path
    """Run folder."""
    out: Path = Path("docs/images/walk_scene4.gif")
    """The file."""
    transmitters: int = 10
    """Stops of the walk."""
    per_stop: int = 3
    """Frequencies at each, in turn."""
    frame_ms: int = 600
    """Duration of a frame."""


def links_of_walk(dataset: Dataset, count: int, per_stop: int) -> Int[np.ndarray, " frames"]:
    """Returns test links at some transmitters in the order of a walk, their frequencies in turn."""
    test = dataset.test
    way = stops_of_walk(dataset.tx_positions[test], count)
    ghz, chosen, turn = np.unique(dataset.frequencies_hz[test]), [], 0
    for place in way:
        here = test[np.linalg.norm(dataset.tx_positions[test] - place, axis=1) < 1e-6]
        for _ in range(per_stop):
            known = here[np.isclose(dataset.frequencies_hz[here], ghz[turn % len(ghz)])]
            chosen += known[:1].tolist()
            turn += 1
    return np.array(chosen)


def draw_frame(
    dataset: Dataset,
    link: int,
    way: Float[np.ndarray, "n 3"],
    truth: Float[np.ndarray, "90 360"],
    predicted: Float[np.ndarray, "90 360"],
) -> Figure:
    """Returns one frame: the floor plan on the left, truth and prediction on the right."""
    place = dataset.tx_positions[link]
    figure = Figure(figsize=(9.6, 3.3), layout="constrained")
    axes = figure.subplot_mosaic([["map", "truth"], ["map", "predicted"]], width_ratios=(1.25, 1))
    left, above, below = axes["map"], axes["truth"], axes["predicted"]
    left.add_collection(LineCollection(list(cut_at(dataset, float(place[2]))), colors="0.35", linewidths=0.8))
    left.plot(*way[:, :2].T, "-", color="0.75", lw=0.8)
    rx = np.asarray(dataset.receiver().position)
    left.plot(*rx[:2], "*", color="#0072b2", ms=15, label="receiver")
    left.plot(*place[:2], "o", color="#d55e00", ms=9, label="transmitter")
    left.set(aspect="equal", title=f"{dataset.frequencies_hz[link] / 1e9:g} GHz", xlabel="x [m]", ylabel="y [m]")
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=2, frameon=False, fontsize=9)
    score = float(ssim(predicted[None], truth[None])[0])
    for axis, image, title in ((above, truth, "truth"), (below, predicted, f"prediction, SSIM {score:.2f}")):
        axis.imshow(image, vmin=0, vmax=1, cmap="viridis", extent=(-180, 180, 90, 0), aspect="auto")
        axis.set_title(title, fontsize=10)
        axis.set_yticks((0, 45, 90))
        axis.set_xticks(range(-180, 181, 90))
        axis.set_ylabel("zenith [deg]", fontsize=8)
    above.set_xticks([])
    below.set_xlabel("azimuth [deg]", fontsize=8)
    return figure


def as_image(figure: Figure) -> Image.Image:
    """Returns a figure as a picture of few colours."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=80)
    stream.seek(0)
    return Image.open(stream).convert("RGB").quantize(COLORS)


def main() -> None:
    """Entry point."""
    use_compilation_cache()
    command = tyro.cli(Command, prog="python -m experiments.studies.moving_picture")
    if command.out.suffix != ".gif":
        raise UserError(f"--out {command.out} does not end in .gif; rename it")
    trained = load_trained(command.run)
    dataset = trained.dataset()
    links = links_of_walk(dataset, command.transmitters, command.per_stop)
    predicted, truth = np.asarray(observe(trained, dataset, links).pas), np.asarray(dataset.pas(links))
    way = dataset.tx_positions[links]
    frames = [as_image(draw_frame(dataset, int(link), way, t, s)) for link, t, s in zip(links, truth, predicted, strict=True)]
    with atomic_write(command.out) as stream:
        frames[0].save(
            stream, format="gif", save_all=True, append_images=frames[1:], duration=command.frame_ms, loop=0, optimize=True
        )
    say(f"picture: {command.out} ({len(frames)} frames, {command.out.stat().st_size / 1e6:.1f} MB)")


if __name__ == "__main__":
    run_command(main)
