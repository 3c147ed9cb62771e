"""Value of neighbours beside a trained field: `python -m experiments.studies.neighbours_account RUN [RUN ...]`.

Every run folder is one of `wbgs-jax train` on data of one receiver. Its field is scored on the test alone and with its
neighbours, beside the nearest transmitter. Writes experiments/results/neighbours.json; docs/inference.md quotes it.
"""

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.results import FOLDER
from wbgs_jax import load_trained
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.files import write_json
from wbgs_jax.evaluation.report import environment
from wbgs_jax.evaluation.score import evaluate

KEPT = ("n", "median_ssim", "mean_ssim", "p10_ssim")


@dataclass(frozen=True)
class Command:
    """Score trained fields with and without their neighbours."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders."""
    out: Path = FOLDER


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.studies.neighbours_account")
    report: dict[str, Any] = {}
    for run in command.runs:
        trained = load_trained(run)
        dataset = trained.dataset()
        corrected, _ = evaluate(trained, dataset)
        alone, _ = evaluate(dataclasses.replace(trained, correction=None), dataset)
        scores = {"alone": alone, "asked": corrected, "nearest_tx": corrected["baselines"]["nearest_tx"]}
        report[dataset.name] = {name: {key: values[key] for key in KEPT} for name, values in scores.items()}
        report[dataset.name]["neighbours"] = 0 if trained.correction is None else len(trained.correction.images)
        print(dataset.name, report[dataset.name], file=sys.stderr)
    write_json(command.out / "neighbours.json", report | environment())


if __name__ == "__main__":
    run_command(main)
