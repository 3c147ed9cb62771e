"""Compares two ground truths of one room by frequency: the effect of another solver, other surfaces or other rays.

python -m data_gen.compare wbgs_jax/data/released/scene2.npz wbgs_jax/data/released/scene2_simulator.npz
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Int

from data_gen.ceilings import scaled, scaled_images
from data_gen.report import table
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.errors import UserError
from wbgs_jax.data.scene_file import SceneFile, load_scene
from wbgs_jax.metrics import ssim
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.radio.channel import correlation

HEADING = ("GHz", "TX", "median correlation", "10th percentile", "median SSIM", "10th percentile", "power (dB)")


@dataclass(frozen=True)
class Options:
    """Compare snapshots and spectra of the transmitters common to two scene files."""

    first: Annotated[Path, tyro.conf.Positional]
    """Scene file (.npz)."""
    second: Annotated[Path, tyro.conf.Positional]
    """Scene file of the same receiver; powers are relative to those of the first."""


def compare(first: SceneFile, second: SceneFile) -> str:
    """Returns a table with a row for every common frequency. Power is the median ratio of the second to the first.

    Raises:
        UserError: there is no common transmitter or frequency, or the arrays differ.
    """
    if first.element_unit != second.element_unit or not np.array_equal(first.element_positions, second.element_positions):
        raise UserError(f"{first.name} and {second.name} have different arrays; their snapshots cannot be compared")
    tx = _common(first.tx_positions, second.tx_positions)
    frequencies = _common(first.frequencies_hz[:, None], second.frequencies_hz[:, None])
    if not len(tx) or not len(frequencies):
        raise UserError(f"{first.name} and {second.name} have no transmitter or no frequency in common")
    return table(list(HEADING), [_row(first, second, tx, int(i), int(k)) for i, k in frequencies])


def _common(first: np.ndarray, second: np.ndarray) -> Int[np.ndarray, "n 2"]:
    """Returns the indices of equal rows in both arrays."""
    where = {tuple(row): i for i, row in enumerate(second.tolist())}
    found = [(i, where[tuple(row)]) for i, row in enumerate(first.tolist()) if tuple(row) in where]
    return np.array(found, int).reshape(-1, 2)


def _row(first: SceneFile, second: SceneFile, tx: Int[np.ndarray, "n 2"], i: int, k: int) -> list[str]:
    """Returns the cells of frequency `i` of the first file and `k` of the second, for the first receiver."""
    hz = first.frequencies_hz[i]
    y, other = (
        s.observations["snapshots"][t, 0, f].astype(np.complex128) for s, t, f in ((first, tx[:, 0], i), (second, tx[:, 1], k))
    )
    elements = first.element_positions[0] * (hz / SPEED_OF_LIGHT if first.element_unit == "metres" else 1)
    scores = np.asarray(correlation(scaled(y), scaled(other))), ssim(scaled_images(other, elements), scaled_images(y, elements))
    power = 10 * np.log10(np.median((np.abs(other) ** 2).sum(-1) / (np.abs(y) ** 2).sum(-1)))
    cells = [f"{value:.3f}" for score in scores for value in (np.median(score), np.percentile(score, 10))]
    return [f"{hz / 1e9:g}", str(len(tx)), *cells, f"{power:+.2f}"]


def main() -> None:
    """Runs the command line."""
    options = tyro.cli(Options)
    print(compare(load_scene(options.first), load_scene(options.second)))


if __name__ == "__main__":
    run_command(main)
