"""Draws sample spectra of a scene file: some transmitters, near and far, at some frequencies.

python -m data_gen.samples data_gen/released/scene2.npz --out docs/images/scene2_samples.png
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
from matplotlib.axes import Axes

from wbgs_jax.array import snapshot_to_pas
from wbgs_jax.data.schema import SceneFile, load_scene
from wbgs_jax.errors import run_command
from wbgs_jax.files import atomic_write
from wbgs_jax.geometry import to_local

TX_SHOWN, FREQUENCIES_SHOWN = 4, 4
DPI = 100


@dataclass(frozen=True)
class Options:
    """Draw sample spectra of a scene file."""

    file: Annotated[Path, tyro.conf.Positional]
    """Scene file (.npz)."""
    out: Path
    """Picture to write (.png)."""


def draw(scene: SceneFile, out: Path) -> None:
    """Write the picture: one row a transmitter, one column a frequency; a cross is the transmitter's own direction."""
    transmitters, frequencies = _near_to_far(scene), _spread(len(scene.frequencies_hz), FREQUENCIES_SHOWN)
    size = (3.6 * len(frequencies), 1.55 * len(transmitters) + 0.6)
    figure, axes = plt.subplots(len(transmitters), len(frequencies), figsize=size, layout="constrained", squeeze=False)
    for axis, frequency in zip(axes[0], scene.frequencies_hz[frequencies], strict=True):
        axis.set_title(f"{frequency / 1e9:g} GHz")
    for row, tx in zip(axes, transmitters, strict=True):
        snapshots = jnp.asarray(scene.snapshots[tx, frequencies])
        images = np.asarray(snapshot_to_pas(snapshots, jnp.asarray(scene.element_positions)))
        for axis, image in zip(row, images, strict=True):
            axis.imshow(image, vmin=0, vmax=1, cmap="viridis", extent=(-180, 180, 90, 0), aspect="auto")
            _mark(axis, scene, tx)
            axis.set(xticks=range(-180, 181, 90), yticks=(0, 45, 90))
        x, y, z = scene.tx_positions[tx]
        distance = np.linalg.norm(scene.tx_positions[tx] - scene.rx_position)
        row[0].set_ylabel(f"TX ({x:.1f}, {y:.1f}, {z:.1f})\n{distance:.1f} m away\nzenith (deg)", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("azimuth (deg)", fontsize=8)
    figure.suptitle(f"{scene.name}: {scene.meta.get('description', '')}", fontsize=10)
    with atomic_write(out) as stream:
        figure.savefig(stream, dpi=DPI, format="png")
    plt.close(figure)


def _near_to_far(scene: SceneFile) -> Int[np.ndarray, "k"]:
    distance = np.linalg.norm(scene.tx_positions - scene.rx_position, axis=-1)
    return np.argsort(distance)[_spread(len(distance), TX_SHOWN + 2)[1:-1]]


def _spread(length: int, count: int) -> Int[np.ndarray, "k"]:
    return np.unique(np.linspace(0, length - 1, count).round().astype(int))


def _mark(axis: Axes, scene: SceneFile, tx: int) -> None:
    azimuth, zenith = _direction(scene, tx)
    axis.plot(azimuth, min(zenith, 89.0), "+", color="white", markersize=9, markeredgewidth=1.5)


def _direction(scene: SceneFile, tx: int) -> Float[np.ndarray, "2"]:
    """Azimuth and zenith (degrees, receiver's frame) of a transmitter."""
    offset = jnp.asarray(scene.tx_positions[tx] - scene.rx_position)
    x, y, z = np.asarray(to_local(offset, jnp.asarray(scene.rx_orientation)))
    return np.degrees([np.arctan2(y, x), np.arctan2(np.hypot(x, y), z)])


def main() -> None:
    """Command line."""
    options = tyro.cli(Options)
    draw(load_scene(options.file), options.out)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    run_command(main)
