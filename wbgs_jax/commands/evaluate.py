"""Evaluate a trained field: `wbgs-jax eval --run RUN [--data ...] [--json]`.

Scores the field on held-out spectra (SSIM of scikit-image with data range 1 and the default window; PSNR; MAE), compares it
with baselines, writes figures and the report `eval.json` (for other data, `--data`: `eval-NAME.json`) into the run folder.
"""

import wbgs_jax._util.quiet  # noqa: F401, before JAX is loaded

# isort: split

import json
import shlex
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console

from wbgs_jax import plotting
from wbgs_jax._util.cli import counted, run_command
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import check_writable, write_json
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.evaluation.report import closing_lines, provenance, result_path, table, with_part
from wbgs_jax.evaluation.score import Part, evaluate, held_out
from wbgs_jax.fields.base import outputs_of
from wbgs_jax.inference.kriging import FILE as NEIGHBOURS
from wbgs_jax.inference.kriging import Beside, Mixture, field_share
from wbgs_jax.inference.predictor import BLOCK
from wbgs_jax.inference.trained_field import TrainedField, at_receivers
from wbgs_jax.training import curves
from wbgs_jax.training.run_folder import MANIFEST, open_run, write_manifest


@dataclass(frozen=True)
class Command:
    """Evaluate a trained field on held-out spectra."""

    run: Path
    """Run folder."""
    data: str | None = None
    """Other data than those of the training: a scene, a scene file or a folder."""
    part: Part = "test"
    """Transmitters to score: those of the test, or those held out for validation (`wbgs-jax train --validation 0.1`)."""
    json: bool = False
    """Print only the report on stdout, as one JSON object."""
    pictures: bool = True
    """Write figures into the run folder."""
    timing: bool = False
    """Also measure the time of a query, in blocks and alone; compiling for it takes a while."""
    results: Path | None = None
    """Also write quality_<dataset>_<field>_<preset>_<device>.json with provenance and times into this folder."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    use_compilation_cache()
    command = tyro.cli(Command, args=arguments, prog="wbgs-jax eval")
    trained = open_run(command.run)
    check_writable(command.run / "eval.json")
    dataset = trained.dataset() if command.data is None else trained.config.other_data(command.data)
    if command.data is not None:
        trained = for_receivers(trained, dataset)
    console = Console(file=sys.stderr, markup=False, soft_wrap=True)
    index = held_out(dataset, command.part)
    console.print(f"evaluating {command.run} (step {trained.step}) on {len(index)} spectra of {dataset.name} ...")
    timed = command.timing or command.results is not None
    report, predicted = evaluate(trained, dataset, command.part, shown=True, timed=timed)
    beside = "" if command.data is None else f"-{dataset.name}"  # scores on other data never replace the run's own
    write_json(command.run / f"{with_part('eval', command.part)}{beside}.json", report)
    if command.data is None and (command.run / MANIFEST).exists():
        write_manifest(command.run, trained, report)
    if command.results:
        path = result_path(command.results, report, trained.config.preset)
        write_json(path, report | {"provenance": provenance(trained)})
        console.print(f"results: {path}")
    if command.pictures and dataset.has_spectra:
        console.print("pictures ...")
        entries = curves.read(command.run / "metrics.jsonl")
        folder = command.run / f"{with_part('pictures', command.part)}{beside}"
        for path in plotting.draw_all(folder, dataset, index, predicted, report, entries):
            console.print(f"picture: {path}")
        if (displaced := trained.field.inspect(trained.params).displaced_surfaces) is not None:
            console.print(f"picture: {plotting.draw_motion(folder, *displaced)}")
    if command.json:
        print(json.dumps(report, allow_nan=False))
        return
    Console(width=None if sys.stdout.isatty() else 140).print(table(report))
    print("\n".join([*correction_lines(trained.correction), *closing_lines(report, BLOCK)]))
    for line in next_lines(trained, dataset, command.run):
        console.print(line)


def for_receivers(trained: TrainedField, dataset: Dataset) -> TrainedField:
    """Returns the field for the receivers of other data; if no part of it is valid there, the field itself, with a warning."""
    try:
        return at_receivers(trained, dataset)
    except UserError as error:
        warnings.warn(f"scored as if {dataset.name} had the receivers of the training: {error}", stacklevel=2)
        return trained


def correction_lines(correction: Beside) -> list[str]:
    """Returns a line on how measured spectra contribute to the scored predictions; none if the field predicts alone."""
    if correction is None:
        return []
    count = counted(len(correction.images), "measured spectrum", "measured spectra")
    if not isinstance(correction, Mixture):
        return [f"predictions are corrected by the nearest of {count} ({NEIGHBOURS})"]
    low, high = np.sort(np.asarray(field_share(correction, jnp.exp(correction.log_distance[2:]))))  # nearest, farthest
    weight = f"{low:.2f}" if high - low < 0.005 else f"{low:.2f} to {high:.2f}"
    return [f"predictions mix the field (weight {weight}) with simple methods on {count} ({NEIGHBOURS})"]


def next_lines(trained: TrainedField, dataset: Dataset, run: Path) -> list[str]:
    """Returns suggestions for the next commands."""
    folder = shlex.quote(str(run))
    place = ",".join(f"{x:.3g}" for x in dataset.tx_positions[dataset.test[0] if len(dataset.test) else 0])
    ghz = f"{dataset.frequencies_hz.max() / 1e9:g}"
    lines = []
    if dataset.has_spectra:
        lines.append(f"next: wbgs-jax predict --run {folder} --tx {place} --ghz {ghz} --out pas.npz --picture pas.png")
    if "power" in outputs_of(trained.field) and dataset.has_scale:
        lines.append(f"      wbgs-jax map --run {folder} --ghz {ghz} --picture map.png")
    return [*lines, f"      wbgs-jax view --run {folder}"]


if __name__ == "__main__":
    run_command(main)
