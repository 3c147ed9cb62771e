"""Draws sample spectra of a scene file: several transmitters, near and far, at several frequencies.

python -m data_gen.samples wbgs_jax/data/released/scene2.npz --out docs/images/scene2_samples.png
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import matplotlib

matplotlib.use("Agg")

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro
from jaxtyping import Float, Int

from wbgs_jax._util.cli import run_command
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write
from wbgs_jax.data.load import scene_dataset
from wbgs_jax.data.scene_file import SceneFile, load_scene
from wbgs_jax.radio.geometry import direction_to_angles, to_local
from wbgs_jax.types import Receiver

TX_SHOWN, FREQUENCIES_SHOWN = 4, 4
DPI = 100


@dataclass(frozen=True)
class Options:
    """Draw sample spectra of a scene file."""

    file: Annotated[Path, tyro.conf.Positional]
    """Scene file (.npz)."""
    out: Path
    """Picture to write (.png)."""
    receiver: int = 0
    """Index of the receiver."""


def draw(scene: SceneFile, out: Path, receiver: int = 0) -> None:
    """Writes a figure with one row per transmitter and one column per frequency; a cross marks the transmitter's direction.

    Raises:
        UserError: there is no such receiver, or the scene has no spectra.
    """
    dataset = scene_dataset(scene)
    if not dataset.has_spectra:
        raise UserError(
            f"scene {scene.name} holds {dataset.observed.words}, no spectra to draw; give a scene of snapshots or spectra"
        )
    rx = dataset.receiver(receiver)
    distance = np.linalg.norm(scene.tx_positions - scene.rx_position[receiver], axis=-1)
    transmitters, frequencies = _near_to_far(distance), _spread(len(scene.frequencies_hz), FREQUENCIES_SHOWN)
    links = np.arange(len(dataset)).reshape(scene.shape)[:, receiver]
    size = (3.6 * len(frequencies), 1.55 * len(transmitters) + 0.6)
    figure, axes = plt.subplots(len(transmitters), len(frequencies), figsize=size, layout="constrained", squeeze=False)
    for axis, frequency in zip(axes[0], scene.frequencies_hz[frequencies], strict=True):
        axis.set_title(f"{frequency / 1e9:g} GHz")
    for row, tx in zip(axes, transmitters, strict=True):
        azimuth, zenith = _direction(rx, scene.tx_positions[tx])
        for axis, image in zip(row, np.asarray(dataset.pas(links[tx, frequencies])), strict=True):
            axis.imshow(image, vmin=0, vmax=1, cmap="viridis", extent=(-180, 180, 90, 0), aspect="auto")
            axis.plot(azimuth, min(zenith, 89.0), "+", color="white", markersize=9, markeredgewidth=1.5)
            axis.set(xticks=range(-180, 181, 90), yticks=(0, 45, 90))
        x, y, z = scene.tx_positions[tx]
        row[0].set_ylabel(f"TX ({x:.1f}, {y:.1f}, {z:.1f})\n{distance[tx]:.1f} m away\nzenith (deg)", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("azimuth (deg)", fontsize=8)
    figure.suptitle(f"{scene.name}: {scene.meta.get('description', '')}", fontsize=10)
    with atomic_write(out) as stream:
        figure.savefig(stream, dpi=DPI, format="png")
    plt.close(figure)


def _near_to_far(distance: Float[np.ndarray, " tx"]) -> Int[np.ndarray, " k"]:
    return np.argsort(distance)[_spread(len(distance), TX_SHOWN + 2)[1:-1]]


def _spread(length: int, count: int) -> Int[np.ndarray, " k"]:
    return np.unique(np.linspace(0, length - 1, count).round().astype(int))


def _direction(receiver: Receiver, tx_position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2"]:
    """Returns azimuth and zenith (degrees, receiver's frame) of a transmitter."""
    offset = jnp.asarray(tx_position - np.asarray(receiver.position), jnp.float32)
    return np.degrees(direction_to_angles(to_local(offset, receiver.orientation)))


def main() -> None:
    """Runs the command line."""
    options = tyro.cli(Options)
    draw(load_scene(options.file), options.out, options.receiver)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    run_command(main)
