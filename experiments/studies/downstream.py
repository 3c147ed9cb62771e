"""Value of fields for locating transmitters and choosing beams: `python -m experiments.studies.downstream`.

For scenes 1, 2 and 4, and 10, 40, 160 and all training transmitters, a small coherent field is trained into
runs/downstream/SCENE_txNUMBER (used where it exists, resumed where it was interrupted). It predicts

* where held-out transmitters stand that are observed as spectra at a few frequencies, beside the place of the training
  transmitter whose spectra are most alike, and the mean of the four most alike ones, weighted by likeness;
* which beams to use for held-out transmitters, beside those that the nearest training transmitter's spectrum ranks highest.

`--part validation` scores what settings are chosen by. Adds its rows to experiments/results/downstream.json, scene by scene and
number by number; those that are there, or a half of one, are not made again. docs/applications.md quotes them.
"""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # read with JAX; see wbgs_jax/_util/quiet.py

# isort: split

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float, Int

from experiments.results import FOLDER
from wbgs_jax import load_trained
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_json, write_json
from wbgs_jax.applications import make_locator, score_beams
from wbgs_jax.applications.locate import pooled
from wbgs_jax.commands import train as training
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.evaluation.baselines import nearest_tx
from wbgs_jax.evaluation.report import provenance
from wbgs_jax.inference.predictor import observe
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.training.checkpoint import checkpoint_steps

RUNS = Path("runs/downstream")
SETTINGS = (
    *("--field", "wave", "--preset", "cpu", "--no-neighbours"),
    *("--wave.specular-tried", "256", "--wave.specular-kept", "48"),
    *("--wave.diffracted-tried", "512", "--wave.diffracted-kept", "96"),
    *("--calibration.no-geometry", "--calibration.antenna-rounds", "0", "--calibration.rounds", "1"),
    *("--calibration.spectra", "64", "--calibration.glance", "16"),
    *("--calibration.propagation-spectra", "24", "--calibration.position-std-spectra", "24"),
    *("--optim.steps", "100", "--optim.min-steps", "100"),
    *("--loop.evaluate-every", "100", "--loop.evaluate-spectra", "16"),
)
"""A small coherent field: fewer paths, one round of the search for materials, few steps."""
STEPS = 100
PARTS = {"localisation", "beams"}
"""Parts of a row; `account` makes those that are missing."""
ALIKE = 4
"""Training transmitters whose places are averaged."""


@dataclass(frozen=True)
class Command:
    """Score localisation and beams of small coherent fields."""

    scenes: tuple[str, ...] = ("1", "2", "4")
    """Released scenes, or scene files."""
    numbers: tuple[int, ...] = (10, 40, 160, 0)
    """Training transmitters; 0: all."""
    ghz: tuple[float, ...] = (1.0, 5.0, 24.25)
    """Frequencies at which transmitters are observed that are to be located."""
    transmitters: int = 24
    """Held-out transmitters that are located."""
    step: float = 0.5
    """Metres between places of the grid."""
    part: Literal["test", "validation"] = "test"
    settings: tuple[str, ...] = SETTINGS
    """Settings of the training."""
    tables: bool = False
    """Print the tables of docs/applications.md, of the rows that are there, and make none."""
    runs: Path = RUNS
    out: Path = FOLDER


def main() -> None:
    """Entry point."""
    use_compilation_cache()
    command = tyro.cli(Command, prog="python -m experiments.studies.downstream")
    path = command.out / f"downstream{'' if command.part == 'test' else '_validation'}.json"
    if command.tables:
        print("\n\n".join([localisation_table(read_json(path)), beams_table(read_json(path))]))
        return
    for number in command.numbers:
        for scene in command.scenes:
            report: dict[str, Any] = read_json(path) if path.exists() else {}
            name, row = f"scene{scene}" if scene.isdecimal() else Path(scene).stem, f"tx{number or 'all'}"
            known = report.get(name, {}).get(row, {})
            if not PARTS - set(known):
                continue
            trained = trained_field(command, scene, command.runs / f"{name}_{row}", number)
            say(f"{name}, {row} ...")
            found = known | account(trained, command, PARTS - set(known))
            report[name] = report.get(name, {}) | {row: found | {"provenance": provenance(trained)}}
            write_json(path, report)
            say(f"{name}, {row}: {found}")


def trained_field(command: Command, scene: str, folder: Path, number: int) -> TrainedField:
    """Returns the field of a folder, trained or trained to its end where it is not there."""
    steps = checkpoint_steps(folder / "checkpoints")
    if not steps or (command.settings == SETTINGS and steps[-1] < STEPS):
        arguments = ["--scene", scene, "--train-tx", str(number), "--out", str(folder), *command.settings]
        training.main([*arguments, "--resume"])
    return load_trained(folder)


def account(trained: TrainedField, command: Command, parts: set[str]) -> dict[str, Any]:
    """Returns scores of localisation and of beams on held-out transmitters, as far as they are wanted."""
    own = trained.dataset()
    held_out = transmitters_of(own, own.test if command.part == "test" else own.validation)
    chosen = np.sort(np.random.default_rng(0).permutation(held_out)[: command.transmitters])
    return {
        **({"localisation": localisation(trained, own, chosen, command)} if "localisation" in parts else {}),
        **({"beams": beams(trained, own, command.part)} if "beams" in parts else {}),
    }


def transmitters_of(dataset: Dataset, index: Int[np.ndarray, " n"]) -> Int[np.ndarray, " tx"]:
    """Returns the transmitters of some links, each once."""
    return np.unique(dataset.tx_index[index])


def links_of(dataset: Dataset, transmitters: Int[np.ndarray, " tx"], ghz: tuple[float, ...]) -> Int[np.ndarray, "tx freq"]:
    """Returns the links of transmitters at some frequencies, to the first receiver.

    Raises:
        UserError: there is no such link.
    """
    rows = []
    for tx in transmitters:
        own = np.flatnonzero((dataset.tx_index == tx) & (dataset.receiver_index == 0))
        away = np.abs(dataset.frequencies_hz[own] / np.array(ghz)[:, None] / 1e9 - 1)
        if away.min(1).max() > 1e-6:
            raise UserError(f"{dataset.name} has no {ghz[int(away.min(1).argmax())]:g} GHz; give --ghz of its frequencies")
        rows.append(own[away.argmin(1)])
    return np.array(rows).reshape(len(transmitters), len(ghz))


def localisation(trained: TrainedField, dataset: Dataset, chosen: Int[np.ndarray, " tx"], command: Command) -> dict[str, Any]:
    """Returns errors (metres) of located transmitters: of the field, of fingerprints, and how far the nearest training
    transmitter is from them."""
    links = links_of(dataset, chosen, command.ghz)
    truth = dataset.tx_positions[links[:, 0]]
    begin = time.perf_counter()
    locate = make_locator(trained, np.array(command.ghz) * 1e9, step=command.step)
    locate.answers.block_until_ready()
    grid = time.perf_counter() - begin
    found = [locate(dataset.pas(row)) for row in links]
    seconds = (time.perf_counter() - begin - grid) / len(links)
    best = np.array([one.position for one in found])
    candidates = np.array([np.concatenate([one.position[None], one.others]) for one in found])
    known = links_of(dataset, transmitters_of(dataset, dataset.train), command.ghz)
    prints = fingerprints(dataset, known, links)
    places = dataset.tx_positions[known[:, 0]]
    errors = {
        "field": np.linalg.norm(best - truth, axis=-1),
        "field_or_runner_up": np.linalg.norm(candidates - truth[:, None], axis=-1).min(1),
        **{name: np.linalg.norm(at - truth, axis=-1) for name, at in by_fingerprint(prints, places).items()},
        "nearest_training_transmitter": np.linalg.norm(places[None] - truth[:, None], axis=-1).min(1),
    }
    report: dict[str, Any] = {name: summary(values) for name, values in errors.items()}
    return report | {"ghz": list(command.ghz), "n": len(truth), "grid_s": round(grid, 1), "seconds": round(seconds, 2)}


def fingerprints(
    dataset: Dataset, known: Int[np.ndarray, "m freq"], tested: Int[np.ndarray, "n freq"]
) -> Float[np.ndarray, "n m"]:
    """Returns one minus the cosine between the spectra of transmitters, as the locator compares them."""

    def features(links: Int[np.ndarray, "k freq"]) -> Float[np.ndarray, "k numbers"]:
        spectra = np.stack([np.asarray(pooled(jnp.asarray(dataset.pas(row)))) for row in links])
        flat = spectra.reshape(*links.shape, -1)
        flat = flat / np.linalg.norm(flat, axis=-1, keepdims=True) / np.sqrt(links.shape[1])
        return flat.reshape(len(links), -1)

    return 1 - features(tested) @ features(known).T


def by_fingerprint(unlike: Float[np.ndarray, "n m"], places: Float[np.ndarray, "m 3"]) -> dict[str, Float[np.ndarray, "n 3"]]:
    """Returns the place of the training transmitter that is most alike, and the weighted mean of the most alike ones."""
    order = np.argsort(unlike, 1)[:, :ALIKE]
    weights = 1 / np.maximum(np.take_along_axis(unlike, order, 1), 1e-6)
    weights /= weights.sum(1, keepdims=True)
    return {"fingerprint": places[order[:, 0]], "fingerprints_weighted": (weights[..., None] * places[order]).sum(1)}


def beams(trained: TrainedField, dataset: Dataset, part: str) -> dict[str, Any]:
    """Returns what beams are worth that are chosen by the field, and by the spectrum of the nearest training transmitter."""
    index = dataset.test if part == "test" else dataset.validation
    truth = np.asarray(dataset.pas(index))
    predicted = {"field": np.asarray(observe(trained, dataset, index).pas), "nearest_tx": nearest_tx(dataset)(index)}
    scores = {name: score_beams(spectra, truth)._asdict() for name, spectra in predicted.items()}
    return scores | {"n": len(index)}


def summary(errors: Float[np.ndarray, " n"]) -> dict[str, float]:
    """Returns median, mean and 90th percentile, metres."""
    return {
        "median_m": float(np.median(errors)),
        "mean_m": float(np.mean(errors)),
        "p90_m": float(np.percentile(errors, 90)),
    }


def rows(report: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    """Returns (scene, row, scores) of what is there, scene by scene, by the number of training transmitters."""
    found = [(scene, row, report[scene][row]) for scene in sorted(report) for row in report[scene]]
    return sorted(found, key=lambda one: (one[0], int(one[1].removeprefix("tx").replace("all", "99999"))))


def mark(scene: str, row: str, place: str, report: dict[str, Any], decimals: int) -> str:
    """Returns a number as pages quote it (`experiments.evidence`)."""
    value: Any = report[scene][row]
    for name in place.split("."):
        value = value[name]
    return f"<!-- downstream.json {scene}.{row}.{place} {decimals} -->{value:,.{decimals}f}<!-- / -->"


def localisation_table(report: dict[str, Any]) -> str:
    """Returns median, mean and 90th percentile of the errors as a table of a page."""
    kinds = ("field", "fingerprint", "fingerprints_weighted")
    lines = ["| scene | training transmitters | field | most alike | four most alike |", "| --- | ---: | ---: | ---: | ---: |"]
    for scene, row, found in rows(report):
        if "localisation" not in found:
            continue
        cells = [
            " / ".join(mark(scene, row, f"localisation.{kind}.{name}_m", report, 2) for name in ("median", "mean", "p90"))
            for kind in kinds
        ]
        lines.append(f"| {scene.removeprefix('scene')} | {row.removeprefix('tx')} | {' | '.join(cells)} |")
    return "\n".join(lines)


def beams_table(report: dict[str, Any]) -> str:
    """Returns what beams are worth as a table of a page."""
    lines = ["| scene | training transmitters | field | nearest transmitter |", "| --- | ---: | ---: | ---: |"]
    names = (("top1", 2), ("top3", 2), ("loss_db", 2), ("loss_top3_db", 2))
    for scene, row, found in rows(report):
        if "beams" not in found:
            continue
        cells = [
            " / ".join(mark(scene, row, f"beams.{kind}.{name}", report, decimals) for name, decimals in names)
            for kind in ("field", "nearest_tx")
        ]
        lines.append(f"| {scene.removeprefix('scene')} | {row.removeprefix('tx')} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    run_command(main)
