"""Fit a map of received power to measured powers (readings), and validate it on held-out readings:

wbgs-jax measure --data FOLDER [--out scores.json] [--picture maps.png]
wbgs-jax measure --data FOLDER --tx x,y,z [x,y,z ...] [--answers powers.csv]
wbgs-jax measure --floor-plan walls.csv --ceiling 2.6 --mesh walls.ply
"""

import wbgs_jax._util.quiet  # noqa: F401, before JAX is loaded

# isort: split

import dataclasses
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from trimesh.exchange.ply import export_ply

from wbgs_jax._util.cli import parse_positions, run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, check_writable, write_csv, write_json
from wbgs_jax.commands.options import PICTURES, SurveyOptions, check_effects, check_suffixes
from wbgs_jax.data.floor_plan import extruded
from wbgs_jax.data.rssi_folder import attribution
from wbgs_jax.data.tables import check_positions
from wbgs_jax.evaluation.report import environment
from wbgs_jax.inference.domain import Domain
from wbgs_jax.plotting import draw_power_maps, save
from wbgs_jax.power_map.model import PowerMap, Scales, learn_map, received_power
from wbgs_jax.power_map.survey import find_walls, load_survey
from wbgs_jax.power_map.validation import COMPARED, NINETY, Score, scores


@dataclass(frozen=True)
class Command(SurveyOptions):
    """Fit a map of received power to readings at many positions, and validate it on held-out rooms and squares."""

    data: Path | None = None
    """Folder with readings.csv, receivers.csv and, optionally, the floor plan walls.csv (docs/measured.md)."""
    out: Path | None = None
    """Write the scores to this .json file."""
    picture: Path | None = None
    """Draw the maps of all receivers to this .png, .svg or .pdf file."""
    tx: tuple[str, ...] = ()
    """Transmitters, each as x,y,z in metres, for which to predict the received powers."""
    answers: Path | None = None
    """Write these received powers to this .csv file."""
    ceiling: float = 2.6
    """Height of the walls in --mesh, metres."""
    mesh: Path | None = None
    """Write the walls of the floor plan, with floor and ceiling, to this .ply file."""


def check(command: Command) -> None:
    """Raises a `UserError` for an invalid or incomplete command line."""
    check_suffixes(command, {"out": (".json",), "picture": PICTURES, "answers": (".csv",), "mesh": (".ply",)})
    if command.data is None and (command.floor_plan is None or command.mesh is None):
        raise UserError("give --data FOLDER with readings, or --floor-plan walls.csv --mesh walls.ply")
    if command.data is None and (command.tx or command.out or command.picture):
        raise UserError("predicted powers need readings: give --data FOLDER")
    if command.answers and not command.tx:
        raise UserError("--answers needs --tx x,y,z")
    check_effects(command, {"ceiling": ("--mesh",)}, ["--mesh"] * bool(command.mesh), "a map")
    command.survey_settings()
    if not 0 < command.ceiling < np.inf:
        raise UserError(f"--ceiling is {command.ceiling:g}; give metres")


def table(found: list[Score]) -> Table:
    """Returns the scores as a table for the terminal."""
    columns = ["held out", "means", "this map", "90 % hold", *COMPARED]
    shown = Table(*columns, title="mean absolute error of the means of cells, dB")
    for score in found:
        errors = (f"{score.rivals_db[rival]:.2f}" for rival in COMPARED)
        shown.add_row(escape(score.held_out), str(score.means), f"{score.error_db:.2f}", f"{100 * score.within:.0f} %", *errors)
    return shown


def of_the_plan(found: list[Score]) -> list[str]:
    """Returns what the controls show about the floor plan, one line for each way of holding out."""
    lines = []
    for score in found:
        if score.plan_helps is not None:
            others = {"left out": score.rivals_db["without walls"]} | score.controls_db
            listed = ", ".join(f"{name.removeprefix('plan ')} {error:.2f}" for name, error in others.items())
            shown = "the plan helps" if score.plan_helps else "that the plan helps is not shown"
            lines.append(f"{score.held_out}: {score.error_db:.2f} dB with the plan, {listed}: {shown}")
    return lines


def answers(learned: PowerMap, places: Float[np.ndarray, "tx 3"], where: Domain) -> list[list[str]]:
    """Returns a header, then one row per transmitter: its position, then mean power and half width of the 90 % interval
    for every receiver; the latter is NaN outside of the measured domain."""
    mean, std = (np.asarray(a) for a in received_power(learned, jnp.asarray(places, jnp.float32)))
    std = np.where(where.outside(places)[:, None], np.nan, std)
    names = [f"{name}_{r + 1}" for r in range(mean.shape[1]) for name in ("dbm", "within_db")]
    pairs = np.stack([mean, NINETY * std], -1).reshape(len(places), -1)
    rows = [[*(f"{x:g}" for x in place), *(f"{x:.2f}" for x in row)] for place, row in zip(places, pairs, strict=True)]
    return [["x", "y", "z", *names], *rows]


def report(learned: PowerMap, found: list[Score], command: Command, size: float) -> dict[str, Any]:
    """Returns the content of a results file."""
    scales = np.asarray(learned.scales, float).round(4).tolist()
    assert command.data is not None, "checked"
    return {
        "data": command.data.resolve().name,
        "attribution": attribution(command.data),
        "cell_m": size,
        "law": _law_as_json(learned),
        "scales": dict(zip((field.name for field in dataclasses.fields(Scales)), scales, strict=True)),
        "scores": {_key(score.held_out): _as_json(score) for score in found},
        "environment": environment(),
    }


def _law_as_json(learned: PowerMap) -> dict[str, float]:
    """Returns the parameters of the law that the data determine, by name."""
    at_one_metre, exponent, wall, ceiling, *additional = np.asarray(learned.law, float).round(4).tolist()
    law = {"dbm_at_one_metre": at_one_metre, "exponent": exponent}
    if len(learned.walls.ends):
        law["first_wall_db"] = wall
    for name, further in zip(learned.walls.classes, additional, strict=True):
        law[f"first_wall_db_{_key(name)}"] = round(wall + further, 4)
    return law | ({"first_ceiling_db": ceiling} if len(learned.ceilings) else {})


def _as_json(score: Score) -> dict[str, Any]:
    return dataclasses.asdict(score) | {
        kind: {_key(name): error for name, error in getattr(score, kind).items()} for kind in ("rivals_db", "controls_db")
    }


def _key(name: str) -> str:
    return re.sub(r"\W+", "_", name)


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    use_compilation_cache()
    command = tyro.cli(Command, args=arguments, prog="wbgs-jax measure")
    check(command)
    check_writable(command.out, command.picture, command.answers, command.mesh)
    places, walls = parse_positions(command.tx), find_walls(command.data, command.floor_plan)
    check_positions("--tx", places)
    if command.mesh and not len(walls.ends):
        raise UserError("--mesh needs walls: give --floor-plan walls.csv")
    if command.mesh:
        with atomic_write(command.mesh) as stream:
            stream.write(export_ply(extruded(walls, command.ceiling)))
        say(f"mesh: {command.mesh} ({len(walls.ends)} walls, {command.ceiling:g} m high)")
    if command.data is None:
        return
    survey = load_survey(command.data, **command.survey_settings())
    cells, size = survey.cells, survey.cell_m
    say(f"{len(cells.places)} cells of {size:g} m, {len(cells.receivers)} receivers, {len(walls.ends)} walls or faces of walls")
    if cells.ids:
        say(", ".join(cells.titles))
    for line in attribution(command.data):
        say(f"about the data: {line}")
    learned = learn_map(cells, walls)
    if command.tx:
        where = survey.domain
        rows = answers(learned, places, where)
        for row, outside in zip(rows[1:], where.outside(places), strict=True):
            what = "mean dBm" if outside else "mean dBm, 90 % within"
            powers = [row[3 + 2 * r] + ("" if outside else f" ± {row[4 + 2 * r]}") for r in range(len(cells.receivers))]
            listed = ", ".join(f"{r}: {power}" for r, power in enumerate(powers, 1))
            rest = "; outside of the readings: no interval" if outside else ""
            print(f"TX ({', '.join(row[:3])}) m, {what}: receiver {listed}{rest}")
        if command.answers:
            write_csv(command.answers, rows)
            say(f"answers: {command.answers}")
    if command.picture:
        save(draw_power_maps(learned, walls, cells), command.picture)
        say(f"picture: {command.picture}")
    if command.out or not (command.tx or command.picture):
        found = scores(cells, walls)
        Console(width=None if sys.stdout.isatty() else 140).print(table(found))
        for line in of_the_plan(found):
            print(line)
        if command.out:
            write_json(command.out, report(learned, found, command, size))
            say(f"scores: {command.out}")


if __name__ == "__main__":
    run_command(main)
