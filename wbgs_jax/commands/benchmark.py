"""The benchmark of the released scenes, for any program:

wbgs-jax benchmark --queries FOLDER                                # scene1.csv, ...: the test links, to be predicted
wbgs-jax benchmark --predictions FOLDER --out entry.json           # scores scene1.npz, ...

A file of predictions contains `pas` (n, 90, 360), `snapshots` (n, elements) or `power_db` (n,), in the order of the queries.
"""

import wbgs_jax._util.quiet  # noqa: F401, before JAX is loaded

# isort: split

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro
from jaxtyping import Float, Int

from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import check_writable, read_arrays, write_csv, write_json
from wbgs_jax.commands.options import check_suffixes
from wbgs_jax.inference.queries import COLUMNS

if TYPE_CHECKING:
    from wbgs_jax.data.dataset import Dataset

# Modules that load JAX are imported where they are used, so that `--help` and errors of the command line appear at once.

SCENES = ("1", "2", "3", "4", "5", "6")
"""Released scenes of the benchmark; `python -m wbgs_jax` reads them as data sets of these names."""


@dataclass(frozen=True)
class Command:
    """Score any program's predictions for the test links of the released scenes."""

    queries: Path | None = None
    """Write the test links of each scene to this folder, as CSV files with columns x,y,z,ghz."""
    predictions: Path | None = None
    """Folder with predictions: scene1.npz, ... in the order of the queries (docs/benchmark.md)."""
    scenes: tuple[str, ...] = ()
    """Scenes 1 to 6; by default all, or those with predictions."""
    name: str = ""
    """Name of the entry, by default that of the folder."""
    out: Path | None = None
    """Write the scores to this .json file."""


def check(command: Command) -> None:
    """Raises a `UserError` for an invalid or incomplete command line."""
    check_suffixes(command, {"out": (".json",)})
    if command.queries is None and command.predictions is None:
        raise UserError("nothing to do; give --queries FOLDER to get the test links, or --predictions FOLDER to score them")
    if wrong := [scene for scene in command.scenes if scene not in SCENES]:
        raise UserError(f"--scenes {wrong[0]} is not of the benchmark; choose among {', '.join(SCENES)}")
    if command.out and command.predictions is None:
        raise UserError("--out is for scores; give --predictions FOLDER")


def scenes_of(command: Command) -> list[str]:
    """Returns the scenes with predictions; none, or a missing one that was requested, is a `UserError`."""
    assert command.predictions is not None, "checked"
    there = [scene for scene in command.scenes or SCENES if (command.predictions / f"scene{scene}.npz").exists()]
    missing = [scene for scene in command.scenes if scene not in there]
    if missing or not there:
        wanted = f"scene{missing[0]}.npz" if missing else "scene1.npz"
        raise UserError(f"{command.predictions} has no predictions {wanted}; give them in the order of --queries FOLDER")
    return there


def write_queries(folder: Path, scenes: tuple[str, ...]) -> None:
    """Writes the test links of scenes as tables of queries (`inference.queries`)."""
    from wbgs_jax.data import load_dataset

    folder.mkdir(parents=True, exist_ok=True)
    for scene in scenes:
        dataset = load_dataset(scene)
        links = np.column_stack([dataset.tx_positions, dataset.frequencies_hz / 1e9])[dataset.test]
        write_csv(folder / f"scene{scene}.csv", [COLUMNS, *([f"{value:.9g}" for value in row] for row in links)])
        say(f"queries: {folder / f'scene{scene}.csv'} ({len(links)} test links)")


def score_scene(path: Path, dataset: "Dataset") -> dict[str, Any]:
    """Returns the report of a file of predictions for the test links of a scene, as `wbgs-jax eval` reports a run."""
    from wbgs_jax.data.dataset import with_validation_trained
    from wbgs_jax.evaluation.score import lending_baselines, power_figures, score_snapshots, score_spectra, true_spectra

    index, reference = dataset.test, with_validation_trained(dataset)
    arrays = read_predictions(path, dataset)
    report: dict[str, Any] = {"scene": dataset.name, "part": "test"}
    if "snapshots" in arrays:
        report |= score_snapshots(arrays["snapshots"], dataset.observations["snapshots"][index])
    pas = arrays["pas"] if "pas" in arrays else spectra(arrays["snapshots"], dataset, index) if "snapshots" in arrays else None
    if pas is not None:
        truth = true_spectra(dataset, index)
        report |= score_spectra(pas, truth, dataset, index)[0]
        lent = lending_baselines(reference, index)
        report["baselines"] = {name: truth.score(np.asarray(predict(index))) for name, predict in lent.items()}
    if "power_db" in arrays and (power := power_figures(arrays["power_db"], reference, index)):
        report |= {"power": power}
    return report


def read_predictions(path: Path, dataset: "Dataset") -> dict[str, np.ndarray]:
    """Returns the arrays of a file of predictions; other shapes or values than those of the test links are a `UserError`."""
    n, elements = len(dataset.test), dataset.receiver().element_positions.shape[0]
    shapes = {"pas": (n, 90, 360), "snapshots": (n, elements), "power_db": (n,)}
    arrays = read_arrays(path, "file of predictions", "write it with numpy.savez", shapes)
    if not arrays:
        raise UserError(f"{path} has none of the arrays {', '.join(shapes)}; write one of them, one row per test link")
    for name, values in arrays.items():
        if values.shape != shapes[name]:
            raise UserError(f"{name} of {path} has shape {values.shape}; the {n} test links need {shapes[name]}")
        kinds, numbers = ("fiuc", "complex") if name == "snapshots" else ("fiu", "real")
        if values.dtype.kind not in kinds:
            raise UserError(f"{name} of {path} has the type {values.dtype}; give {numbers} numbers")
        if not np.isfinite(values).all():
            raise UserError(f"{name} of {path} contains NaN or infinity; predict every test link")
    pas = arrays.get("pas")
    overshoot = 0.1  # of learned spectra, which are clipped; decibels, powers and 8-bit images are further off
    if pas is not None and not (pas.min() >= -overshoot and pas.max() <= 1 + overshoot):
        raise UserError(
            f"pas of {path} lies within {pas.min():.5g} to {pas.max():.5g}; give amplitudes from 0 to 1, divided by the "
            "maximum of each spectrum"
        )
    return arrays | ({} if pas is None else {"pas": np.clip(pas, 0, 1).astype(np.float32)})


def spectra(snapshots: np.ndarray, dataset: "Dataset", index: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 90 360"]:
    """Returns the spectra of predicted snapshots, computed like those of the data."""
    observed = np.array(dataset.observations["snapshots"])
    observed[index] = snapshots
    predicted = replace(dataset, observations=dataset.observations | {"snapshots": observed})
    return np.asarray(predicted.pas(index))


def show(reports: dict[str, dict[str, Any]], name: str) -> None:
    """Prints a table with a row per scene and the baselines beside the entry."""
    from rich.console import Console
    from rich.table import Table

    shown = Table(title=f"{name}: SSIM of the test links (medians)")
    scored = {scene: report for scene, report in reports.items() if "median_ssim" in report}
    rivals = list(next(iter(scored.values()))["baselines"]) if scored else []
    for column in (
        "scene",
        "links",
        name,
        "mean",
        "10th percentile",
        *(rival.replace("_", " ") for rival in rivals),
        "truth again",
    ):
        shown.add_column(column, justify="right")
    for scene, report in scored.items():
        own = (report[figure] for figure in ("median_ssim", "mean_ssim", "p10_ssim"))
        others = (report["baselines"][rival]["median_ssim"] for rival in rivals)
        again = report.get("truth_repeats")
        cells = [f"{value:.3f}" for value in (*own, *others)]
        shown.add_row(scene, str(report["n"]), *cells, "" if again is None else f"{again:.3f}")
    if scored:
        Console(width=None if sys.stdout.isatty() else 160).print(shown)
    for scene, report in reports.items():
        if power := report.get("power"):
            print(f"scene {scene}: received power off by {power['power_error_db']:.2f} dB (median)")


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="wbgs-jax benchmark")
    check(command)
    check_writable(command.out)
    if command.queries:
        write_queries(command.queries, command.scenes or SCENES)
    if command.predictions is None:
        return
    from wbgs_jax._util.compilation import use_compilation_cache
    from wbgs_jax.data import load_dataset
    from wbgs_jax.evaluation.report import environment

    use_compilation_cache()
    name, reports = command.name or command.predictions.resolve().name, dict[str, dict[str, Any]]()
    for scene in scenes_of(command):
        path = command.predictions / f"scene{scene}.npz"
        say(f"scoring {path} ...")
        reports[scene] = score_scene(path, load_dataset(scene))
    show(reports, name)
    if command.out:
        write_json(command.out, {"name": name, "scenes": reports, "environment": environment()})
        say(f"scores: {command.out}")


if __name__ == "__main__":
    run_command(main)
