"""Accuracy of a coherent field at receivers without training data: `python -m experiments.studies.receivers_account RUN ...`.

Every run folder is one of `wbgs-jax train --field wave` on a released scene; scenes traced for other receivers of the same room
are `<scene>_rx<number>.npz` beside it. Transmitters that were trained or validated are left out at all of them. A run on
several of them (`--scene 2,2_rx2,2_rx3`) is scored on the test transmitters of each. Adds its rows to the results in
experiments/results/receivers.json; docs/wave.md quotes them.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from jaxtyping import Float, Int

from experiments.results import FOLDER
from wbgs_jax import load_trained
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.files import read_json, write_json
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.load import load_dataset, released_scenes
from wbgs_jax.evaluation.report import provenance
from wbgs_jax.inference.predictor import observe_queries
from wbgs_jax.inference.trained_field import TrainedField, at_receiver
from wbgs_jax.metrics import score

KEPT = ("median_ssim", "mean_ssim", "p10_ssim")
SAME_M = 1e-3


@dataclass(frozen=True)
class Command:
    """Score trained fields at receivers that they were not trained for."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders."""
    out: Path = FOLDER


def others_of(name: str) -> dict[str, Path]:
    """Returns the released scenes that hold other receivers of a scene."""
    numbers = {path.stem: path for path in released_scenes().values()}
    return {stem: path for stem, path in numbers.items() if stem.startswith(f"{name}_rx")}


def unseen(trained_on: Dataset, other: Dataset) -> Int[np.ndarray, " n"]:
    """Returns the links of another data set whose transmitters stand where none of the first was trained or validated."""
    known = trained_on.tx_positions[np.concatenate([trained_on.train, trained_on.validation])]
    seen = {tuple(place) for place in np.round(known / SAME_M).astype(int)}
    places = np.round(other.tx_positions / SAME_M).astype(int)
    return np.flatnonzero([tuple(place) not in seen for place in places])


def scores_alone(trained: TrainedField, home: Dataset) -> dict[str, Any]:
    """Returns scores at the receiver that a field was trained for, and at those that it was not."""
    others = {name.removeprefix(f"{home.name}_"): load_dataset(path) for name, path in others_of(home.name).items()}
    return {name: scores_at(trained, home, data) for name, data in ({"own": home} | others).items()}


def scores_at(trained: TrainedField, home: Dataset, other: Dataset) -> dict[str, Any]:
    """Returns scores at the first receiver of `other`: of transmitters that are new to the field, and of the test transmitters
    of `other`, which a field trained there is scored on; and the seconds until the first answer there could begin."""
    receiver, new = other.receiver(), unseen(home, other)
    there = at_receiver(trained, receiver, home)
    there.field.plan(there.params, receiver)  # what is compiled once for all is not the receiver's
    begin = time.perf_counter()
    jax.block_until_ready(there.field.plan(there.params, receiver))
    ready = time.perf_counter() - begin
    both = np.union1d(new, other.test)
    spectra = np.asarray(observe_queries(there, receiver, other.query(both), "pas"))
    parts = {"new": new, "test": other.test}
    return {"ready_s": ready} | {name: _scores(spectra[np.isin(both, index)], other, index) for name, index in parts.items()}


def scores_together(trained: TrainedField, name: str) -> dict[str, Any]:
    """Returns scores of a field that was trained on several data sets, on the test transmitters of one of them."""
    one = load_dataset(released_scenes()[name.removeprefix("scene")])
    spectra = np.asarray(observe_queries(trained, one.receiver(), one.query(one.test), "pas"))
    return _scores(spectra, one, one.test) | {"trained_on": trained.dataset().name}


def _scores(spectra: Float[np.ndarray, "n 90 360"], dataset: Dataset, index: Int[np.ndarray, " n"]) -> dict[str, Any]:
    index = np.sort(index)
    found = score(spectra, np.asarray(dataset.pas(index)), dataset.frequencies_hz[index])
    return {key: found[key] for key in KEPT} | {"n": len(index), "tx": len(np.unique(dataset.tx_index[index]))}


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.studies.receivers_account")
    path = command.out / "receivers.json"
    report: dict[str, Any] = read_json(path) if path.exists() else {}
    for run in command.runs:
        trained = load_trained(run)
        home = trained.dataset()
        names = home.name.split("+")
        found = scores_alone(trained, home) if len(names) == 1 else {name: scores_together(trained, name) for name in names}
        report[home.name] = found | {"provenance": provenance(trained)}
        print(home.name, found, file=sys.stderr)
    write_json(path, report)


if __name__ == "__main__":
    run_command(main)
