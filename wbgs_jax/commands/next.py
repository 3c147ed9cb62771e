"""Choose where to measure next, the places about which a trained field is most uncertain:

wbgs-jax next --run RUN --candidates places.csv --count 10 [--out next.csv]
wbgs-jax next --run RUN --grid -2,-2,1.5:2,2,1.5:9x9x1 --count 10 --ghz 2.4 28
wbgs-jax next --data READINGS --grid 0,0,1.3:8,6,1.3:33x25x1 --count 20
"""

import wbgs_jax._util.quiet  # noqa: F401, before JAX is loaded

# isort: split

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from jaxtyping import Float

from wbgs_jax._util.cli import parse_vector, point_words, run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import check_writable, write_csv
from wbgs_jax.commands.options import SurveyOptions, TrainedFieldOptions, check_suffixes, load_field, parse_frequencies
from wbgs_jax.inference import queries as parsing
from wbgs_jax.inference.results_file import EXACT


@dataclass(frozen=True)
class Command(TrainedFieldOptions, SurveyOptions):
    """Choose where to measure next: the places about which a field is most uncertain, in an order to walk them."""

    data: Path | None = None
    """Instead of a trained field: a folder of readings (docs/measured.md), to which a map of received power is fitted first."""
    candidates: Path | None = None
    """CSV file of the places where a transmitter can be, with columns x,y,z in metres, ..."""
    grid: str = ""
    """... or a grid of them, such as -2,-2,1.5:2,2,1.5:9x9x1."""
    count: int = 10
    """Number of places to choose."""
    ghz: tuple[float, ...] = ()
    """Frequencies at which errors count; by default some of the training frequencies."""
    rx: str = ""
    """Receiver, by default the first of the data: its index, or x,y,z in metres."""
    start: str = ""
    """Place x,y,z where the walk begins, by default the most uncertain place."""
    length: float | None = None
    """Distance over which errors are alike, metres; by default three times that between neighbouring measured places, or that
    of the map of readings."""
    out: Path | None = None
    """Write the places, in the order of the walk, to this .csv file."""


class State(NamedTuple):
    """Measured places and expected errors before the next measurement."""

    measured: Float[np.ndarray, "m 3"]
    """Measured places, metres."""
    error: Float[np.ndarray, " c"]
    """Error that is expected at the candidates; NaN where none is known."""
    unit: str
    """Unit of the error."""
    length: float
    """Distance over which errors are alike, metres."""


def check(command: Command) -> None:
    """Raises a `UserError` for an invalid or incomplete command line."""
    check_suffixes(command, {"out": (".csv",)})
    if command.data and (command.run or command.example):
        raise UserError("--data FOLDER takes the place of a trained field; give one of them")
    if not command.data:
        _ = command.folder  # one is named
    if (command.candidates is None) == (not command.grid):
        raise UserError("give the places that can be measured: --candidates places.csv, or --grid FROM:TO:NXxNYxNZ")
    most_chosen = 200  # maximum number of places that are chosen
    if not 1 <= command.count <= most_chosen:
        raise UserError(f"--count {command.count} is not a number of places; give 1 to {most_chosen}")
    if command.start:
        parse_vector(command.start, "--start", "position", "metres")
    if command.length is not None and not 0 < command.length < np.inf:
        raise UserError(f"--length {command.length:g} is not a distance; give metres")
    if command.data and (command.ghz or command.rx):
        raise UserError("--ghz and --rx are those of a trained field; readings have neither")
    if command.survey_settings() and not command.data:
        raise UserError("--floor-plan, --height and --cell are those of readings: give --data FOLDER")


def candidates_of(command: Command) -> Float[np.ndarray, "c 3"]:
    """Returns the places that can be measured, metres; too few or too many are a `UserError`."""
    if command.grid:
        places = parsing.parse_grid(command.grid)
    else:
        assert command.candidates is not None, "checked"
        places = parsing.read_positions(command.candidates)
    places = np.unique(places, axis=0)
    most = 4000  # maximum number of candidates
    if len(places) > most:
        raise UserError(f"{len(places):,} candidates are too many; at most {most:,} are possible")
    return places


def of_run(command: Command, places: Float[np.ndarray, "c 3"]) -> State:
    """Returns the state of a trained field: mean expected errors over frequencies, and the places of its data."""
    from wbgs_jax.training.fit_kriging import spacing

    given = parse_frequencies(command.ghz) if command.ghz else None
    loaded = load_field(command.folder, command.rx, None if given is None else float(given.min()))
    data, trained = loaded.dataset, loaded.trained
    if given is not None and (beyond := given[np.asarray(loaded.domain.out_of_band(given))]).size:
        raise UserError(f"--ghz {beyond[0] / 1e9:g} lies outside of the trained band, where no error is expected; omit it")
    learned = np.unique(data.frequencies_hz[data.train])
    frequencies = 4  # number of training frequencies at which errors are expected, if none are given
    some = np.unique(np.linspace(0, len(learned) - 1, min(frequencies, len(learned))).round().astype(int))
    frequencies_hz = learned[some] if given is None else given
    measured = np.unique(data.tx_positions[np.concatenate([data.train, data.validation])], axis=0)
    # Default of the distance over which errors are alike, in median distances between neighbouring measured places.
    default_spacings = 3.0
    length = default_spacings * spacing(measured) if len(measured) > 1 else default_spacings
    at_once = 128  # candidates whose spectra are in memory together
    blocks = [places[start : start + at_once] for start in range(0, len(places), at_once)]
    if trained.intervals is not None:
        ssim = [loaded.evaluate("spectra", block, frequencies_hz)["expected"][..., 0] for block in blocks]
        return State(measured, np.mean(1 - np.concatenate(ssim), -1), "SSIM", length)
    if trained.power_intervals is not None:
        error_db = [loaded.evaluate("power", block, frequencies_hz)["expected_error_db"] for block in blocks]
        return State(measured, np.mean(np.concatenate(error_db), -1), "dB", length)
    say("there are no prediction intervals at this receiver, so that errors count the same everywhere")
    allowed = np.where(np.asarray(loaded.domain.outside(places)), np.nan, 1.0)
    return State(measured, allowed, "(unknown)", length)


def of_readings(command: Command, places: Float[np.ndarray, "c 3"]) -> State:
    """Returns the state of a map fitted to readings: mean standard deviations over receivers, and the measured places."""
    import jax
    import jax.numpy as jnp

    from wbgs_jax._util.pytree import map_blocks
    from wbgs_jax.power_map.model import LENGTH as ALIKE_M
    from wbgs_jax.power_map.model import learn_map, received_power
    from wbgs_jax.power_map.survey import load_survey

    assert command.data is not None, "checked"
    survey = load_survey(command.data, **command.survey_settings())
    apart = np.abs(places[:, 2, None] - np.unique(survey.measured[:, 2])).min(1)
    most_apart_m = 0.5  # a map of one height is not one of another
    if apart.max() > most_apart_m:
        say(f"note: candidates are up to {apart.max():.2g} m above or below all readings, whose height is z or --height")
    learned = learn_map(survey.cells, survey.walls)
    predict = jax.jit(lambda block: received_power(learned, block)[1])
    std = map_blocks(predict, jnp.asarray(places, jnp.float32), 256)
    outside = survey.domain.outside(places)
    return State(np.asarray(survey.measured, float), np.where(outside, np.nan, std.mean(1)), "dB", ALIKE_M)


def choose(command: Command) -> None:
    """Chooses the places, prints them and writes the file."""
    from wbgs_jax.applications.measurement_plan import choose_next_places, walking_order

    places = candidates_of(command)
    state = of_readings(command, places) if command.data else of_run(command, places)
    possible = np.isfinite(state.error)
    if not possible.all():
        say(f"{(~possible).sum()} of {len(places)} candidates are left out: inside bodies, or outside of the room or the band")
    places, error = places[possible], state.error[possible]
    if len(places) < command.count:
        raise UserError(f"{len(places)} candidates are fewer than --count {command.count}; give more places, or a lower count")
    length = state.length if command.length is None else command.length
    found = choose_next_places(places, error, state.measured, length, command.count)
    chosen = places[found.numbers]
    start = parse_vector(command.start, "--start", "position", "metres") if command.start else None
    order = walking_order(chosen, None if start is None else np.asarray(start))
    for step, one in enumerate(order, 1):
        print(f"{step:3}. {point_words(chosen[one])}, expected error {error[found.numbers[one]]:.3g} {state.unit}")
    fall = 1 - found.error[-1] / max(found.error[0], np.finfo(float).tiny)
    say(f"r.m.s. error over {len(places)} candidates: {100 * fall:.0f} % lower after these {len(chosen)} measurements")
    say(f"(as expected now, with errors that are alike over {length:.2g} m)")
    if command.out:
        rows = ([*(format(part, EXACT) for part in chosen[one]), f"{error[found.numbers[one]]:g}"] for one in order)
        write_csv(command.out, [["x", "y", "z", "expected_error"], *rows])
        say(f"places: {command.out}")


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="wbgs-jax next")
    check(command)
    check_writable(command.out)
    use_compilation_cache()
    choose(command)


if __name__ == "__main__":
    run_command(main)
