"""Evidence of decisions, and how often they take the harmful side: `python -m experiments.studies.decisions_account`.

Writes experiments/results/decisions.json: for every decision, how many transmitters it has in the data that are at hand; and,
from stored scores of pairs of trainings on the same test transmitters, how often one of them is taken for better by n
transmitters alone although it is worse on all of them.
"""

import itertools
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from jaxtyping import Float
from scipy.special import expit

from experiments.few import SHARED
from experiments.results import FOLDER, read_rows
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import write_json
from wbgs_jax.config import CalibrationConfig
from wbgs_jax.data import Dataset, load_dataset
from wbgs_jax.data.dataset import hold_out_validation
from wbgs_jax.evaluation.report import environment
from wbgs_jax.fields import mixture
from wbgs_jax.fields.mixture import SHARES
from wbgs_jax.training import fit_kriging
from wbgs_jax.training.calibration.objective import surely_better
from wbgs_jax.training.fit_mixture import ERRORS, ERRORS_WITH_PATHS, choose_share
from wbgs_jax.training.loop import VALIDATION_LINKS

COUNTS = (3, 10, 30, 100)
"""Transmitters that decide."""
HARM = 0.005
"""SSIM by which the side that is taken is worse on all transmitters: what counts as harm."""
PAIRS, DRAWS = 300, 24
"""Pairs of trainings, and draws of transmitters of each."""
FEWEST = 100
"""Test transmitters of a result that is used."""


class Decision(NamedTuple):
    """Decision, its evidence, and its outcome where evidence is missing."""

    name: str
    spectra: int
    """Looked at, at most."""
    part: str
    """`train` or `validation`."""
    errors: float
    """Standard errors by which a change has to be better; 0 where it is no test."""
    harmless: str
    """Outcome without evidence."""


def decisions() -> tuple[Decision, ...]:
    """Returns all of them."""
    own = CalibrationConfig()
    return (
        Decision("antennas", own.antenna_spectra, "train", own.antenna_n_sigma, "isotropic, or what the data name"),
        Decision("materials, against the list", own.spectra, "train", own.n_sigma, "an entry of the list"),
        Decision("thicknesses", own.thickness_spectra, "train", own.thickness_n_sigma, "the thickness that is there"),
        Decision("absent bodies", own.spurious_spectra, "train", own.spurious_n_sigma, "all bodies are there"),
        Decision("idealisations", own.propagation_spectra, "train", own.propagation_n_sigma, "as ray tracers have it"),
        Decision("array tuning", own.array_gain_spectra // 2, "train", own.array_gain_n_sigma, "elements in tune"),
        Decision("geometry", own.geometry_snapshots, "train", own.geometry_n_sigma, "the mesh as it is"),
        Decision("clutter", own.absorption_spectra, "train", own.absorption_n_sigma, "none"),
        Decision("noise floor", mixture.COMPARED, "validation", mixture.SURE, "none"),
        Decision("shares of the two fields by query", VALIDATION_LINKS, "validation", 1.0, "one share for all"),
        Decision("residuals of neighbours", fit_kriging.SCORED, "validation", fit_kriging.SURE, "not used; never below 20"),
        Decision("share of a field beside simple methods", 10_000, "validation", ERRORS, "the simple methods"),
        Decision("... of a field that follows paths", 10_000, "validation", ERRORS_WITH_PATHS, "the field"),
    )


def transmitters(dataset: Dataset, decision: Decision) -> int:
    """Returns how many transmitters a decision looks at."""
    part = getattr(dataset, decision.part)
    looked = np.random.default_rng(0).permutation(part)[: decision.spectra]
    return len(np.unique(dataset.tx_index[looked]))


def stored_gains(rng: np.random.Generator, folder: Path = FOLDER) -> list[Float[np.ndarray, "2 tx"]]:
    """Returns scores by transmitter (means over frequencies) of pairs of trainings on the same test links."""
    groups: dict[Any, list[np.ndarray]] = {}
    rows = (row for path in sorted(folder.glob("*.jsonl")) for row in read_rows(path).values())
    for values in rows:
        if "ssim" in values and len(values["tx"]) >= FEWEST:
            key = values["job"]["scene"], tuple(values["tx"]), tuple(values["ssim"])
            groups.setdefault(key, []).append(np.mean(list(values["ssim"].values()), 0))
    pairs = [np.stack(pair) for group in groups.values() for pair in itertools.permutations(group, 2)]
    return [pairs[i] for i in rng.permutation(len(pairs))[:PAIRS]]


def simulate(rng: np.random.Generator) -> dict[str, dict[str, float]]:
    """Returns for every test and number of transmitters how often a side is taken that is worse by more than `HARM`, among all
    draws and, `of_worse`, among those in which the other side is worse by as much."""
    pairs = stored_gains(rng)
    if not pairs:
        raise UserError(f"{FOLDER} holds no scores of {FEWEST} transmitters")

    def by_share(first: np.ndarray, second: np.ndarray, with_paths: bool) -> float:
        """Returns the weight of the second: a field beside simple methods, or simple methods beside a field with paths."""
        simple, field = (second, first) if with_paths else (first, second)
        scores = (1 - SHARES) * simple[:, None] + SHARES * field[:, None]
        (bias, _), alone = choose_share(scores, np.zeros(len(first)), np.arange(len(first)), with_paths)
        share = 1.0 if alone else float(expit(bias))
        return 1 - share if with_paths else share

    tests = {
        "surely_better_1": lambda a, b: float(surely_better(b - a, np.arange(len(a)), 1.0)),
        "surely_better_2": lambda a, b: float(surely_better(b - a, np.arange(len(a)), 2.0)),
        "surely_better_3": lambda a, b: float(surely_better(b - a, np.arange(len(a)), 3.0)),
        "share_2": lambda a, b: by_share(a, b, with_paths=False),
        "share_1": lambda a, b: by_share(a, b, with_paths=True),
    }
    found: dict[str, dict[str, float]] = {}
    for name, taken in tests.items():
        for count in COUNTS:
            harmed, worse, total = 0, 0, 0
            for first, second in pairs:
                loss = float(np.mean(first - second))
                for _ in range(DRAWS // (6 if count >= 30 else 1)):
                    some = rng.integers(len(first), size=count)
                    total, worse = total + 1, worse + (loss > HARM)
                    if loss > HARM:
                        harmed += bool(taken(first[some], second[some]) * loss > HARM)
            found.setdefault(name, {})[str(count)] = round(harmed / total, 4)
            found.setdefault(f"{name}_of_worse", {})[str(count)] = round(harmed / max(worse, 1), 4)
        print(name, found[name], found[f"{name}_of_worse"], file=sys.stderr, flush=True)
    return found


@dataclass(frozen=True)
class Command:
    """List decisions, and simulate them."""

    out: Path = FOLDER


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.studies.decisions_account")
    sources = [*"123456", *(str(SHARED / name) for name in ("wideband3dgs_example1", "wrfgs_rfid_40"))]
    data = {Path(source).name: hold_out_validation(load_dataset(source)) for source in sources}
    listed = [
        decision._asdict() | {"transmitters": {name: transmitters(dataset, decision) for name, dataset in data.items()}}
        for decision in decisions()
    ]
    report = {"decisions": listed, "harm": HARM, "simulation": simulate(np.random.default_rng(0))}
    write_json(command.out / "decisions.json", report | environment())


if __name__ == "__main__":
    run_command(main)
