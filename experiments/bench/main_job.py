"""Cost of a step of `make train SCENE=1`, today and with the presets before Muon: `python -m experiments.bench.main_job`.

Both are trained in turn, an epoch each, in one process on the same data; processor time, medians and spread (half of the
interquartile range). Writes experiments/results/main_job.json; docs/performance.md quotes it.
"""

import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments.profiles import BY_ADAM, STEPS_BY_ADAM
from experiments.results import FOLDER
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.files import write_json
from wbgs_jax.config import Settings, changed
from wbgs_jax.data import load_dataset
from wbgs_jax.data.dataset import hold_out_validation
from wbgs_jax.evaluation.report import environment
from wbgs_jax.fields import get_field
from wbgs_jax.training.loop import Run


@dataclass(frozen=True)
class Command:
    """Time a training step of today and of before, in turn."""

    scene: str = "1"
    """Released scene or scene file."""
    epochs: int = 6
    """Number of epochs of 50 steps, after the first, which compiles."""
    out: Path = FOLDER


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.bench.main_job")
    today = get_field("wideband").presets["cpu"]
    versions = {"today": today, "by_adam": changed(today, {"field": BY_ADAM, "optim": {"steps": STEPS_BY_ADAM}})}
    dataset = hold_out_validation(load_dataset(command.scene))
    with tempfile.TemporaryDirectory() as folder:
        report = measure(dataset, versions, command.epochs, Path(folder))
    write_json(command.out / "main_job.json", {"scene": dataset.name, "epochs": command.epochs} | report | environment())
    print(report, file=sys.stderr)


def measure(dataset: Any, versions: dict[str, Settings], epochs: int, folder: Path) -> dict[str, Any]:
    """Returns the figures of every version, and the share of the first's whole training in the second's."""
    runs: dict[str, Run] = {}
    first: dict[str, float] = {}
    times: dict[str, list[float]] = {name: [] for name in versions}
    for name, settings in versions.items():
        begin = time.perf_counter()
        runs[name] = Run(dataset, "wideband", settings, 0, folder / name)
        runs[name].epoch()
        first[name] = time.perf_counter() - begin
    for _ in range(epochs):
        for name, run in runs.items():
            begin = time.process_time()
            run.epoch()
            times[name].append(1e3 * (time.process_time() - begin) / run.settings.loop.epoch_steps)
    report: dict[str, Any] = {name: figures(values, versions[name].optim.steps, first[name]) for name, values in times.items()}
    whole = [float(np.median(values)) * versions[name].optim.steps for name, values in times.items()]
    return report | {"share_of_training": round(whole[0] / whole[1], 3)}


def figures(milliseconds: list[float], steps: int, first: float) -> dict[str, float]:
    """Returns what a version costs; `first_epoch_s` is wall time from nothing to the end of the first epoch, compilation
    included (of the version that comes first, also what both share)."""
    low, median, high = np.percentile(milliseconds, [25, 50, 75])
    return {
        "step_cpu_ms": round(float(median), 2),
        "spread_ms": round(float(high - low) / 2, 2),
        "steps": steps,
        "training_cpu_s": round(float(median) * steps / 1e3, 1),
        "first_epoch_s": round(first, 1),
    }


if __name__ == "__main__":
    run_command(main)
