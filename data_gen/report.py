"""Tables of the dataset card from the meta of scene files, as markdown.

python -m data_gen.report wbgs_jax/data/released/*.npz
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from wbgs_jax._util.cli import run_command
from wbgs_jax.data.scene_file import SceneFile, load_scene

CEILINGS = {
    "order<=0": "order <= 0", "order<=1": "<= 1", "order<=2": "<= 2", "order<=3": "<= 3", "phase_blind": "phase-blind",
    "inverse_distance": "1/d² weighting", "nearest_tx": "nearest TX", "line_of_sight": "LOS geometry",
    "mean_image": "mean image",
}  # fmt: skip
"""Columns: key in the meta and heading."""
CHANNEL = {
    "line_of_sight_share": "in sight", "median_paths": "paths", "median_delay_spread_ns": "delay spread (ns)",
    "gain_db_p05": "gain 5 % (dB)", "gain_db_p50": "50 %", "gain_db_p95": "95 %",
}  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Print the tables of the dataset card."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Scene files (.npz)."""


def report(files: tuple[Path, ...]) -> str:
    """Returns all tables: one row per file, then for every file one row per frequency."""
    scenes = {file: load_scene(file) for file in files}
    parts = [
        "### Files",
        table(["file", "TX", "frequencies", "spectra", "triangles", "kB", "sha256"], map(_row, scenes.items())),
    ]
    parts += ["### Median over frequencies", table(["file", *CEILINGS.values()], (_medians(*item) for item in scenes.items()))]
    for file, scene in scenes.items():
        parts += [f"### {file.stem}: median SSIM", _by_frequency(scene.meta["ceilings"], CEILINGS, 3)]
        parts += [f"### {file.stem}: channel", _by_frequency(scene.meta["channel"], CHANNEL, 2)]
    return "\n\n".join(parts)


def _row(item: tuple[Path, SceneFile]) -> list[str]:
    file, scene = item
    n_tx, n_rx, n_freq = scene.shape
    content = file.read_bytes()
    counts = (n_tx, n_freq, n_tx * n_rx * n_freq, len(scene.faces), round(len(content) / 1000))
    return [file.name, *(f"{count:,}" for count in counts), f"`{hashlib.sha256(content).hexdigest()[:16]}`"]


def _medians(file: Path, scene: SceneFile) -> list[str]:
    rows = scene.meta["ceilings"]
    return [file.stem, *(f"{np.median([row[key] for row in rows]):.3f}" if key in rows[0] else "" for key in CEILINGS)]


def _by_frequency(rows: list[dict[str, Any]], columns: dict[str, str], digits: int) -> str:
    lines = [
        [f"{row['frequency_ghz']:g}", *(f"{row[key]:.{digits}f}" if key in row else "" for key in columns)] for row in rows
    ]
    return table(["GHz", *columns.values()], lines)


def table(heading: list[str], rows: Any) -> str:
    """Returns a Markdown table; its first column is left-aligned."""
    lines = [heading, ["---"] + ["---:"] * (len(heading) - 1), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    """Runs the command line."""
    print(report(tyro.cli(Options).files))


if __name__ == "__main__":
    run_command(main)
