"""Repeatability of the tracer: spectra with the released number of rays compared with those of three times as many.

Scores of models above it are not meaningful. The result is written beside the released scenes, for evaluations and tables.

python -m data_gen.repeatability --scenes 1 2
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from data_gen.ceilings import scaled_images
from data_gen.convergence import settings, some_tx, traced
from data_gen.llvm import ensure_backend
from data_gen.scenes import get_scene
from data_gen.settings import ArraySettings
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_json, write_json
from wbgs_jax.data.load import RELEASED
from wbgs_jax.evaluation.score import FILE
from wbgs_jax.metrics import ssim

if TYPE_CHECKING:
    from data_gen.scenes import SceneSpec

TX_SEED = 1


@dataclass(frozen=True)
class Options:
    """Trace some transmitters of scenes twice, with the usual number of rays and with more, and compare their spectra."""

    scenes: tuple[int, ...] = (1, 2, 3, 4, 5, 6)
    """Numbers of scenes."""
    tx: int = 40
    """Number of transmitters, drawn at random with a fixed seed."""
    effort: float = 3.0
    """Factor on all numbers of rays in the second run."""
    out: Path = RELEASED / FILE
    """File to update; other scenes in it are kept."""


def repeatability(spec: "SceneSpec", tx_count: int, effort: float) -> dict[str, Any]:
    """Returns the median and the 10th percentile of the SSIM of a scene's spectra by frequency (GHz)."""
    from data_gen.solve import Simulator

    tx = some_tx(spec, tx_count, TX_SEED)
    elements = ArraySettings().element_positions()
    once, again = (traced(Simulator(spec, settings(much)), tx, spec.frequencies_hz) for much in (1.0, effort))
    scores = {
        f"{hz / 1e9:g}": ssim(scaled_images(few, elements), scaled_images(many, elements))
        for hz, few, many in zip(spec.frequencies_hz, once, again, strict=True)
    }
    return {
        "effort": effort,
        "n_tx": len(tx),
        "median_ssim": {ghz: round(float(np.median(values)), 4) for ghz, values in scores.items()},
        "p10_ssim": {ghz: round(float(np.percentile(values, 10)), 4) for ghz, values in scores.items()},
    }


def main() -> None:
    """Runs the command line."""
    options = tyro.cli(Options)
    if options.tx < 1 or options.effort <= 0:
        raise UserError("--tx and --effort must be positive")
    ensure_backend()
    for number in options.scenes:
        spec = get_scene(number)
        recorded = read_json(options.out) if options.out.exists() else {}
        write_json(options.out, recorded | {f"scene{number}": repeatability(spec, options.tx, options.effort)})
        print(f"scene {number}: {options.out}")


if __name__ == "__main__":
    run_command(main)
