"""Evaluate a trained field: `python -m wbgs_jax.eval --run RUN [--data ...] [--json]`.

Scores the held-out spectra (scikit-image SSIM, data range 1, default window; PSNR; MAE) beside the reference predictors,
draws pictures into the run folder and writes the report to `eval.json` there.
"""

import json
import platform
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Complex
from rich.console import Console
from rich.table import Table

import wbgs_jax
from wbgs_jax import channel, metrics, pictures
from wbgs_jax.compilation import use_compilation_cache
from wbgs_jax.config import to_dict
from wbgs_jax.data import load_dataset
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.errors import UserError, run_command
from wbgs_jax.files import write_json
from wbgs_jax.inference import BLOCK, make_predictor, observations
from wbgs_jax.references import references
from wbgs_jax.runs import TrainedField, load_trained


@dataclass(frozen=True)
class Command:
    """Evaluate a trained field on held-out spectra."""

    run: Path
    """Run folder."""
    data: str | None = None
    """Other data than the run was trained on: a scene, a scene file or a folder."""
    json: bool = False
    """Print the report as one JSON object on stdout, and nothing else there."""
    pictures: bool = True
    """Draw pictures into the run folder."""
    results: Path | None = None
    """Also write quality_<dataset>_<field>_<preset>_<device>.json with provenance into this folder."""


def evaluate(trained: TrainedField, dataset: Dataset) -> tuple[dict[str, Any], np.ndarray]:
    """The report of a field on a dataset's test spectra, and the predicted spectra (n, 90, 360)."""
    test = dataset.test
    if not len(test):
        raise UserError(f"{dataset.name} has no test spectra; choose another split")
    seen = list(observations(trained.field, trained.params, dataset, test))
    predicted = np.concatenate([np.asarray(one.pas) for one in seen])
    truth = np.asarray(dataset.pas(test))
    frequencies = dataset.frequencies_hz[test]
    report = {"scene": dataset.name, "field": trained.config.field} | metrics.score(predicted, truth, frequencies)
    if seen[0].snapshots is not None and dataset.snapshots is not None:
        snapshots = jnp.concatenate([one.snapshots for one in seen if one.snapshots is not None])
        report |= score_snapshots(snapshots, jnp.asarray(dataset.snapshots[test]))
    report |= time_queries(trained, dataset)
    report["references"] = {
        name: metrics.score(np.asarray(predictor(test)), truth, frequencies) for name, predictor in references(dataset).items()
    }
    return report, predicted


def score_snapshots(predicted: Complex[Array, "n elements"], truth: Complex[Array, "n elements"]) -> dict[str, float]:
    """Medians of the correlation |y^H y_hat| / (|y| |y_hat|) and of the power error (dB)."""
    error = jnp.abs(channel.received_power_db(predicted) - channel.received_power_db(truth))
    return {
        "snapshot_correlation": float(jnp.median(channel.correlation(truth, predicted))),
        "power_error_db": float(jnp.median(error)),
    }


def time_queries(trained: TrainedField, dataset: Dataset, repeats: int = 7) -> dict[str, float]:
    """Milliseconds a PAS, for single queries and in blocks: medians over repeats after compilation."""
    predictor = make_predictor(trained.field, trained.params, dataset.receiver)
    result = {}
    for name, size in (("ms_per_pas", BLOCK), ("ms_per_pas_single", 1)):
        query = dataset.query(np.resize(dataset.test, size))
        jax.block_until_ready(predictor(query))
        seconds = []
        for _ in range(repeats):
            begin = time.perf_counter()
            jax.block_until_ready(predictor(query))
            seconds.append(time.perf_counter() - begin)
        result[name] = round(1e3 * float(np.median(seconds)) / size, 3)
    return result


def environment() -> dict[str, Any]:
    """Code version and device of this process."""
    describe = ["git", "describe", "--always", "--dirty"]
    git = subprocess.run(describe, capture_output=True, text=True, cwd=Path(__file__).parent, check=False)
    device = jax.devices()[0]
    return {
        "version": wbgs_jax.__version__,
        "commit": git.stdout.strip() or None,
        "device": device.device_kind if device.platform != "cpu" else f"cpu {platform.machine()}",
        "jax": jax.__version__,
    }


def provenance(trained: TrainedField) -> dict[str, Any]:
    """Where a figure comes from."""
    return environment() | {
        "command": " ".join(["python -m wbgs_jax.train", *_training_arguments(trained)]),
        "preset": trained.config.preset,
        "seed": trained.config.seed,
        "steps": trained.step,
        "training_seconds": round(trained.seconds, 1),
        **trained.field.sizes(trained.params),
        **_alive(trained.params),
        "settings": to_dict(trained.config.settings),
    }


def _alive(params: Any) -> dict[str, int]:
    """Living Gaussians, where there are any: fewer than there is room for."""
    return {"gaussians": int(np.asarray(params.gaussians.alive).sum())} if hasattr(params, "gaussians") else {}


def _training_arguments(trained: TrainedField) -> list[str]:
    config = trained.config
    source = Path(config.source)
    data = ["--data", source.name] if source.is_dir() else ["--scene", source.name]
    if config.frequency_ghz is not None:
        data += ["--frequency-ghz", f"{config.frequency_ghz:g}"]
    if config.train_ghz:
        data += ["--train-ghz", *(f"{f:g}" for f in config.train_ghz)]
    if config.train_tx:
        data += ["--train-tx", str(config.train_tx)]
    return [*data, "--field", config.field, "--preset", config.preset, "--seed", str(config.seed)]


def device_name() -> str:
    """Short name of the device for file names: cpu, or the GPU's kind."""
    device = jax.devices()[0]
    return "cpu" if device.platform == "cpu" else device.device_kind.lower().replace("nvidia", "").strip().replace(" ", "-")


def result_path(folder: Path, report: dict[str, Any], preset: str) -> Path:
    """quality_<dataset>_<field>_<preset>_<device>.json."""
    return folder / f"quality_{report['scene']}_{report['field']}_{preset}_{device_name()}.json"


def table(report: dict[str, Any]) -> Table:
    """The report as a table: one row a frequency, the references beside the field."""
    names = list(report["references"])
    result = Table(title=f"{report['scene']}, {report['field']}: held-out SSIM (median / mean) of {report['n']} spectra")
    for column in ("GHz", report["field"], *(name.replace("_", " ") for name in names), "PSNR dB", "MAE"):
        result.add_column(column, justify="right")

    def row(label: str, own: dict[str, Any], others: list[dict[str, Any]]) -> None:
        pair = [f"{r['median_ssim']:.3f} / {r['mean_ssim']:.3f}" for r in (own, *others)]
        result.add_row(label, *pair, f"{own['psnr_db']:.1f}", f"{own['mae']:.3f}")

    for i, own in enumerate(report["per_frequency"]):
        row(f"{own['frequency_ghz']:g}", own, [report["references"][name]["per_frequency"][i] for name in names])
    result.add_section()
    row("all", report, [report["references"][name] for name in names])
    return result


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m wbgs_jax.eval")
    use_compilation_cache()
    trained = load_trained(command.run)
    dataset = trained.config.dataset() if command.data is None else load_dataset(command.data, seed=trained.config.seed)
    console = Console(file=sys.stderr, markup=False, soft_wrap=True)
    console.print(f"evaluating {command.run} (step {trained.step}) on {len(dataset.test)} spectra of {dataset.name} ...")
    report, predicted = evaluate(trained, dataset)
    write_json(command.run / "eval.json", report)
    if command.results:
        path = result_path(command.results, report, trained.config.preset)
        write_json(path, report | {"provenance": provenance(trained)})
        console.print(f"results: {path}")
    if command.pictures:
        for path in pictures.draw_all(command.run, dataset, predicted, report):
            console.print(f"picture: {path}")
    if command.json:
        print(json.dumps(report, allow_nan=False))
    else:
        Console(width=None if sys.stdout.isatty() else 140).print(table(report))
        if "snapshot_correlation" in report:
            alike, error = report["snapshot_correlation"], report["power_error_db"]
            print(f"snapshots: correlation {alike:.3f}, power error {error:.2f} dB (medians)")
        print(
            f"{report['ms_per_pas']:.2f} ms a PAS in blocks of {BLOCK}, {report['ms_per_pas_single']:.2f} ms for a single query"
        )


if __name__ == "__main__":
    run_command(main)
