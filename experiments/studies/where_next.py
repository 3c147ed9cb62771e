"""Readings that a map of received power needs, by how their places are chosen: `python -m experiments.studies.where_next`,
experiments/results/where_next.json.

A quarter of the places of a measured set is held out; measuring begins at five random ones of the others and continues in
rounds of ten. The places of a round are random, as far as possible from all earlier ones, or the most
uncertain ones (`applications.measurement_plan`). All draws are common to the three.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float, Int

from experiments.results import FOLDER, SHARED
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.files import write_json
from wbgs_jax.applications import choose_next_places
from wbgs_jax.data.rssi_folder import Readings
from wbgs_jax.evaluation.report import environment
from wbgs_jax.power_map.model import LENGTH, learn_map, received_power
from wbgs_jax.power_map.survey import load_survey

SETS = {"ble_flat": 100, "ble_tetam": 40}
"""Measured sets, and the number of random readings whose error the others have to reach."""
BEGIN, ROUND, MOST = 5, 10, 145
METHODS = ("random", "farthest", "uncertain")
_received = jax.jit(received_power)


def curve(cells: Readings, walls: Any, method: str, seed: int) -> dict[int, float]:
    """Returns the mean absolute error (dB) on held-out places by the number of readings."""
    rng = np.random.default_rng(seed)
    places, order = np.asarray(cells.places, float), rng.permutation(len(cells.places))
    test, pool = np.split(order, [len(order) // 4])
    known, found = pool[:BEGIN], dict[int, float]()
    while True:
        learned = learn_map(cells.without(~np.isin(np.arange(len(places)), known)), walls)
        mean, std = (np.asarray(a) for a in _received(learned, jnp.asarray(places, jnp.float32)))
        found[len(known)] = float(np.nanmean(np.abs(mean - cells.powers)[test]))
        left = pool[~np.isin(pool, known)]  # in the random order of the seed
        count = min(ROUND, len(left), MOST - len(known))
        if count <= 0:
            return found
        known = np.concatenate([known, CHOOSE[method](places, std.mean(1), known, left, count)])


def _random(places: Any, error: Any, known: Any, left: Int[np.ndarray, " n"], count: int) -> Int[np.ndarray, " k"]:
    return left[:count]


def _farthest(
    places: Float[np.ndarray, "p 3"], error: Any, known: Int[np.ndarray, " m"], left: Int[np.ndarray, " n"], count: int
) -> Int[np.ndarray, " k"]:
    away, chosen = np.linalg.norm(places[left][:, None] - places[known], axis=-1).min(1), list[int]()
    for _ in range(count):
        chosen.append(int(left[np.argmax(away)]))
        away = np.minimum(away, np.linalg.norm(places[left] - places[chosen[-1]], axis=-1))
    return np.array(chosen)


def _uncertain(
    places: Float[np.ndarray, "p 3"],
    error: Float[np.ndarray, " p"],
    known: Int[np.ndarray, " m"],
    left: Int[np.ndarray, " n"],
    count: int,
) -> Int[np.ndarray, " k"]:
    return left[choose_next_places(places[left], error[left], places[known], LENGTH, count).numbers]


CHOOSE = dict(zip(METHODS, (_random, _farthest, _uncertain), strict=True))


def readings_for(error: float, curve: dict[int, float]) -> float:
    """Returns the number of readings at which a curve falls to an error for good, interpolated; infinity if it never does."""
    counts, errors = np.array(list(curve)), np.array(list(curve.values()))
    above = np.flatnonzero(errors > error)
    if not len(above):
        return float(counts[0])
    last = int(above[-1])
    if last + 1 == len(counts):
        return float("inf")
    share = (errors[last] - error) / (errors[last] - errors[last + 1])
    return float(counts[last] + share * (counts[last + 1] - counts[last]))


def account(name: str, seeds: int) -> dict[str, Any]:
    """Returns the mean curves of a set over seeds, with standard deviations, and the readings that each method needs."""
    survey = load_survey(SHARED / name)
    curves = {method: [curve(survey.cells, survey.walls, method, seed) for seed in range(seeds)] for method in METHODS}
    mean = {method: {n: float(np.mean([one[n] for one in own])) for n in own[0]} for method, own in curves.items()}
    std = {method: float(np.mean([np.std([one[n] for one in own]) for n in own[0]])) for method, own in curves.items()}
    counts = np.array(list(mean["random"]))
    reached = float(np.interp(SETS[name], counts, list(mean["random"].values())))
    needed = {method: readings_for(reached, own) for method, own in mean.items()}
    return {"random_readings": SETS[name], "error_db": reached, "readings": needed, "curves_db": mean, "std_over_seeds_db": std}


@dataclass(frozen=True)
class Command:
    """Count the readings that a map needs, by how their places are chosen."""

    seeds: int = 20
    out: Path = FOLDER / "where_next.json"


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.studies.where_next")
    found = {name: account(name, command.seeds) for name in SETS}
    for name, own in found.items():
        say(f"{name}: {own['readings']} readings for {own['error_db']:.2f} dB")
    write_json(command.out, {"sets": found, "seeds": command.seeds} | environment())


if __name__ == "__main__":
    run_command(main)
