"""Scores of one command on few spectra, beside every simple method: `python -m experiments.few`,
experiments/results/few.jsonl and few.json.

A case is a data set with some of its training transmitters, drawn at random or along a track; a row is a case and a seed,
trained with the defaults and scored on the test transmitters of the data. Rows that are there are not made again. `--part 0/2`
and `--part 1/2` share the rows between two processes. `--collect FOLDER` takes over rows that lie there as files.
"""

import dataclasses
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from jaxtyping import Float, Int

from experiments.results import FOLDER, SHARED, add_rows, read_lines, read_rows
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.files import read_json, write_json
from wbgs_jax.commands.train import learn_beside
from wbgs_jax.config import Settings
from wbgs_jax.data import Dataset, load_dataset
from wbgs_jax.data.dataset import fewer_transmitters, hold_out_validation, training_links
from wbgs_jax.evaluation.report import environment
from wbgs_jax.evaluation.score import evaluate
from wbgs_jax.fields import default_field, get_field
from wbgs_jax.inference.intervals import LEVEL
from wbgs_jax.inference.kriging import Mixture
from wbgs_jax.inference.predictor import predict_spectra
from wbgs_jax.inference.trained_field import RunConfig
from wbgs_jax.metrics import ssim
from wbgs_jax.training.cross_validation import Training, cross_validated
from wbgs_jax.training.fit_mixture import HeldOut, Known, learn_members, predict_members, share_scores, simple_answers
from wbgs_jax.training.loop import train
from wbgs_jax.training.run_folder import load_trained, write_config

ROWS = FOLDER / "few.jsonl"
TESTED = 300
"""Test spectra that are scored, at most."""
SIMPLE = ("mean_image", "nearest_tx", "inverse_distance", "line_of_sight", "kriging")
"""Simple methods that every row is compared with."""
MARGIN = 0.02
"""SSIM below the best of them that counts."""
Row = dict[str, Any]
Draw = Literal["all", "random", "track"]


@dataclass(frozen=True)
class Case:
    """Some data and how many of their transmitters."""

    name: str
    source: str
    transmitters: int
    """Number of training transmitters, validation included."""
    draw: Draw
    seeds: int
    frequency_ghz: float | None = None


def cases() -> tuple[Case, ...]:
    """Returns all of them, the cheap ones first."""
    rfid, example1 = str(SHARED / "wrfgs_rfid_40"), str(SHARED / "wideband3dgs_example1")
    whole = [Case("rfid_32", rfid, 32, "all", 20), Case("rfid_32_915MHz", rfid, 32, "all", 20, 0.915)]
    parts = [Case(f"rfid_{n}_{draw}", rfid, n, draw, 10) for n in (10, 20) for draw in ("random", "track")]
    samples = [Case(f"example1_{10 * n}", example1, n, "random", 3) for n in (2, 4, 8)]
    rooms = [
        Case(f"scene{scene}_{n}_{draw}", scene, n, draw, 3)
        for n in (5, 10, 20, 40)
        for scene in ("1", "2", "4")
        for draw in ("random", "track")
    ]
    return (*whole, *parts, *samples, *rooms)


def data_of(case: Case, seed: int) -> Dataset:
    """Returns the data of a case: the same seed draws the same transmitters."""
    frequency = None if case.frequency_ghz is None else case.frequency_ghz * 1e9
    dataset = load_dataset(case.source, frequency_hz=frequency)
    if case.draw == "random":
        dataset = fewer_transmitters(dataset, case.transmitters, seed)
    elif case.draw == "track":
        dataset = along_a_track(dataset, case.transmitters, seed)
    test = np.sort(np.random.default_rng([0, 8]).permutation(dataset.test)[:TESTED])
    return hold_out_validation(dataclasses.replace(dataset, test=test))


def along_a_track(dataset: Dataset, count: int, seed: int) -> Dataset:
    """Returns a data set with as many training transmitters, each the nearest to the one before that is left."""
    transmitters = np.unique(dataset.tx_index[dataset.train])
    places = {tx: dataset.tx_positions[dataset.tx_index == tx][0] for tx in transmitters}
    track = [np.random.default_rng([seed, 9]).choice(transmitters)]
    while len(track) < count:
        here = places[track[-1]]
        left = [tx for tx in transmitters if tx not in track]
        track.append(min(left, key=lambda tx: float(np.linalg.norm(places[tx] - here))))
    return dataclasses.replace(dataset, train=dataset.train[np.isin(dataset.tx_index[dataset.train], track)])


def make_row(case: Case, seed: int, runs: Path) -> Row:
    """Returns a row: medians of the SSIM of the command's answer, of the field alone and of every simple method."""
    dataset, begin = data_of(case, seed), time.perf_counter()
    kind = get_field(default_field())
    settings: Settings = kind.presets["cpu"]
    config = RunConfig(case.source, kind.name, "cpu", seed, case.frequency_ghz, settings)
    folder = runs / f"{case.name}_seed{seed}"
    if not folder.exists():
        folder.mkdir(parents=True)
        write_config(folder, config)
    result = train(dataset, kind.name, settings, seed, folder, resume=True)
    learn_beside(result, dataset, config, folder, 0)
    seconds = time.perf_counter() - begin
    trained = load_trained(folder)
    report, _ = evaluate(trained, dataset)
    truth = np.asarray(dataset.pas(dataset.test))
    alone = ssim(predict_spectra(trained.field, trained.params, dataset, dataset.test), truth)
    medians = {name: own["median_ssim"] for name, own in report["baselines"].items()}
    medians["kriging"] = float(np.median(ssim(kriged(dataset, dataset.test, trained.correction), truth)))
    sure = report.get("confidence")
    shutil.rmtree(folder, ignore_errors=True)
    return {
        "case": case.name,
        "seed": seed,
        "transmitters": len(np.unique(dataset.tx_index[training_links(dataset)])),
        "spectra": len(training_links(dataset)),
        "tested": len(dataset.test),
        "median_ssim": report["median_ssim"],
        "alone": float(np.median(alone)),
        "simple": medians,
        "field_answers_alone": trained.correction is None,
        "level": None if sure is None else sure["level"],
        "coverage": None if sure is None else sure["coverage"],
        "expected": None if sure is None else sure["expected"],
        "scored": None if sure is None else sure["scored"],
        "training_seconds": round(seconds, 1),
    } | environment()


def kriged(dataset: Dataset, index: Int[np.ndarray, " n"], beside: Any) -> Float[np.ndarray, "n 90 360"]:
    """Returns what ordinary kriging gives for some links, its length and nugget found by cross-validation, as a run has found
    them, if it has."""
    links = training_links(dataset)
    known = Known(links, dataset.eight_bit(links))
    everything = np.ones((len(index), len(links)), bool)
    mixture = beside if isinstance(beside, Mixture) else learn_members(dataset, known)
    spectra, _ = predict_members(mixture, dataset, known, index, everything, ("kriging",))
    return spectra[:, 0]


def rows_of(path: Path = ROWS) -> list[Row]:
    """Returns the rows that are there, in the order of the cases."""
    rows = read_rows(path).values()
    order = {case.name: number for number, case in enumerate(cases())}
    return sorted((row for row in rows if row["case"] in order), key=lambda row: (order[row["case"]], row["seed"]))


def below(row: Row) -> bool:
    """Returns whether a row scores lower than the best simple method by more than `MARGIN`."""
    return bool(row["median_ssim"] < max(row["simple"].values()) - MARGIN)


def coverage(rows: list[Row]) -> float | None:
    """Returns the share of all scores in 90 % intervals, of rows that have such; None where none has."""
    known = [row for row in rows if row["level"] is not None and row["level"] >= LEVEL - 1e-6]
    tested = sum(row["tested"] for row in known)
    return sum(row["coverage"] * row["tested"] for row in known) / tested if tested else None


def summary(rows: list[Row]) -> dict[str, Any]:
    """Returns what pages quote of the rows, by case."""
    found: dict[str, Any] = {}
    for name in dict.fromkeys(row["case"] for row in rows):
        own = [row for row in rows if row["case"] == name]
        scores = [row["median_ssim"] for row in own]
        found[name] = {
            "seeds": len(own),
            "worst": min(scores),
            "median": float(np.median(scores)),
            "alone": float(np.median([row["alone"] for row in own])),
            "best_simple": float(np.median([max(row["simple"].values()) for row in own])),
            "below": sum(map(below, own)),
            "coverage": coverage(own),
            "seconds": float(np.median([row["training_seconds"] for row in own])),
        }
    return {"cases": found, "rows": len(rows), "below": sum(map(below, rows)), "coverage": coverage(rows)}


def stored(case: Case, seed: int, runs: Path) -> dict[str, Any]:
    """Returns what the choice of the field's share rests on in a case, and what every share is worth on its test transmitters:
    for tests, which then take no time."""
    dataset, kind = data_of(case, seed), get_field(default_field())
    settings: Settings = kind.presets["cpu"]
    result = train(dataset, kind.name, settings, seed, runs / "stored", resume=True)
    how = Training(kind.name, settings, result.steps, seed, runs / "stored")
    known, held = cross_validated(result.field, result.params, dataset, how, print)
    mixture = learn_members(dataset, known)
    scores, u = share_scores(mixture, dataset, held, *simple_answers(mixture, dataset, known, held))
    index = dataset.test
    everything = np.ones((len(index), len(known.links)), bool)
    pas = predict_spectra(result.field, result.params, dataset, index)
    of_test = HeldOut(index, pas, everything, index)
    tested, test_u = share_scores(mixture, dataset, of_test, *simple_answers(mixture, dataset, known, of_test))
    shutil.rmtree(runs / "stored")
    values = {"scores": scores, "u": u, "test_median": np.median(tested, 0), "test_u": test_u}
    return {
        "name": f"{case.name}_seed{seed}",
        "group": held.group.tolist(),
        **{name: np.round(array, 4).tolist() for name, array in values.items()},
    }


@dataclass(frozen=True)
class Command:
    """Make the rows that are missing."""

    only: str = ""
    """Cases whose names begin so."""
    seeds: int = 1000
    """No more of them than so many a case."""
    part: str = "0/1"
    """Which share of the rows."""
    out: Path = ROWS
    collect: Path | None = None
    """Take over the rows of a folder, a file a row, instead."""
    stored: Path | None = None
    """Write there what the choice rests on in the first seed of the cases instead."""
    list: bool = False
    """Say what is there and what is missing."""


def main() -> None:
    """Entry point."""
    use_compilation_cache()
    command = tyro.cli(Command, prog="python -m experiments.few")
    part, parts = map(int, command.part.split("/"))
    wanted = [
        (case, seed) for case in cases() if case.name.startswith(command.only) for seed in range(min(case.seeds, command.seeds))
    ]
    runs = Path(tempfile.gettempdir()) / "wbgs_few"
    if command.stored is not None:
        write_json(command.stored, [stored(case, seed, runs) for case, seed in wanted if seed == 0])
        return
    if command.collect is not None:
        add_rows(command.out, {path.stem: read_json(path) for path in command.collect.glob("*_seed*.json")})
        wanted = []
    for number, (case, seed) in enumerate(wanted):
        name = f"{case.name}_seed{seed}"
        there = name in read_lines(command.out)
        if command.list:
            print(f"{case.name} seed {seed}: {'there' if there else 'missing'}")
        if command.list or number % parts != part or there:
            continue
        row = make_row(case, seed, runs)
        add_rows(command.out, {name: row})
        best = max(row["simple"].values())
        print(f"{case.name} seed {seed}: {row['median_ssim']:.3f}, best simple {best:.3f}", file=sys.stderr, flush=True)
    if not command.list and (rows := rows_of(command.out)):
        write_json(command.out.with_suffix(".json"), summary(rows) | environment())


if __name__ == "__main__":
    run_command(main)
