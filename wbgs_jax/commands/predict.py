"""Predict spectra or channel quantities with a trained field, or export it:

wbgs-jax predict --example --tx 1,0.5,1.5 --ghz 28 --picture spectrum.png
wbgs-jax predict --run RUN --tx x,y,z [x,y,z ...] --ghz 28 [60 ...] --out spectra.npz [--picture spectra.png]
wbgs-jax predict --run RUN --line 0,0,1.5:4,0,1.5:41 --ghz 28 --what power --out line.csv --picture line.png
wbgs-jax predict --run RUN --tx x,y,z --sweep 1:100:50 --what delay-spread --out sweep.npz
wbgs-jax predict --run RUN --queries queries.csv --out spectra.npz [--resume]
wbgs-jax predict --run RUN --rx x,y,z --tx x,y,z --ghz 28 --what paths --out paths.csv
wbgs-jax predict --run RUN --export field.zip
"""

import wbgs_jax._util.quiet  # noqa: F401, before JAX is loaded

# isort: split

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
import tyro
from jaxtyping import Float

from wbgs_jax._util.cli import counted, parse_positions, parse_vector, run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import check_writable
from wbgs_jax._util.progress_lines import CountProgress
from wbgs_jax.commands.options import (
    PICTURES,
    TrainedFieldOptions,
    check_effects,
    check_suffixes,
    load_field,
    parse_frequencies,
    warn,
    warn_of_intervals,
)
from wbgs_jax.inference import queries as parsing
from wbgs_jax.inference import results_file
from wbgs_jax.inference.quantities import COMPILED, INTERVALS, QUANTITIES, Options, names_for
from wbgs_jax.inference.queries import Queries, shown_rows
from wbgs_jax.inference.results_file import Answers, open_parts

# Modules that load JAX are imported where they are used, so that `--help` and errors of the command line appear at once.

if TYPE_CHECKING:
    from wbgs_jax.inference.cached_field import CachedField
    from wbgs_jax.inference.evaluate_quantities import LoadedField

    What = str
else:
    What = Literal[names_for("predict")]

OWNERS = {
    **dict.fromkeys(("tx_velocity", "rx_velocity"), ("paths",)),
    **dict.fromkeys(("band_mhz", "points"), ("frequency-response",)),
    "tx_array": ("mimo",),
}
"""Quantities that options affect; the others affect all."""
BLOCK = 256
"""Number of queries predicted and stored at a time."""


@dataclass(frozen=True)
class Command(TrainedFieldOptions):
    """Predict spectra or channel quantities with a trained field, or export it."""

    tx: tuple[str, ...] = ()
    """Transmitters, each as x,y,z in metres (world frame)."""
    line: str = ""
    """Transmitters on a line from:to:number, 0,0,1.5:4,0,1.5:41."""
    grid: str = ""
    """Transmitters on a grid, such as -2,-2,1.5:2,2,1.5:9x9x1."""
    ghz: tuple[float, ...] = ()
    """Frequencies for every transmitter, 1 to 100; from 0.3 for fields that predict paths."""
    sweep: str = ""
    """Frequencies with equal ratios from:to:number, 1:100:50."""
    queries: Path | None = None
    """Instead: a CSV file of queries with columns x,y,z,ghz."""
    rx: str = ""
    """Receiver, by default the first of the data: its index; x,y,z in metres; or
    x,y,z,w,i,j,k with a quaternion (wxyz) that rotates its array into the
    world frame. New receivers need a field with paths."""
    what: What = "spectra"
    """Quantity to predict: power angular spectra, or one that only some fields provide."""
    tx_velocity: str = "0,0,0"
    """Velocity of the transmitters, metres per second (Doppler)."""
    rx_velocity: str = "0,0,0"
    """Velocity of the receiver."""
    band_mhz: float = 100.0
    """Bandwidth of a frequency response ..."""
    points: int = 64
    """... and its number of frequencies."""
    tx_array: str = "1x1"
    """Transmitter array of a MIMO matrix, ROWSxCOLUMNS, half-wavelength spacing, in the world's y-z plane."""
    out: Path | None = None
    """Write the predictions to this .npz file or, if they are single numbers or paths, .csv file."""
    resume: bool = False
    """Continue the same command after an interruption."""
    picture: Path | None = None
    """Draw them, at most 12 links or curves, to this .png, .svg or .pdf file."""
    export: Path | None = None
    """Write the field as a program to this .zip file."""


def check(command: Command) -> None:
    """Raises a `UserError` for an invalid or incomplete command line."""
    _ = command.folder  # one is named
    form = QUANTITIES[command.what].form
    out = (".npz",) if form == "array" else (".npz", ".csv")
    check_suffixes(command, {"out": out, "picture": PICTURES, "export": (".zip",)})
    places = [name for name in ("tx", "line", "grid", "queries") if getattr(command, name)]
    bands = [name for name in ("ghz", "sweep", "queries") if getattr(command, name)]
    queried, writes = bool(places or bands), bool(command.out or command.picture)
    if not (queried or writes or command.export):
        raise UserError("nothing to do; give --tx x,y,z --ghz 28 --out spectra.npz, or --export field.zip")
    if (queried or writes) and not (places and bands and writes):
        raise UserError("predictions need all of --tx x,y,z, --ghz 28 and --out spectra.npz (or --picture spectra.png)")
    if command.export and command.rx:
        raise UserError("an exported field answers for the first receiver of the data; give --export without --rx")
    for several in (places, bands):
        if len(several) > 1:
            raise UserError(f"--{several[0]} and --{several[1]} exclude each other; give one of them")
    check_effects(command, OWNERS, (command.what,), f"--what {command.what}")
    for name, word in _velocities(command).items():
        parse_vector(word, f"--{name}-velocity")
    parsing.parse_array(command.tx_array)
    most_points = 4096
    if not (0 < command.band_mhz < np.inf and 2 <= command.points <= most_points):
        raise UserError(
            f"--band-mhz {command.band_mhz:g} --points {command.points} is not a band; give 2 to {most_points} points"
        )


def queries_of(command: Command) -> Queries:
    """Returns the queries; frequencies outside the band of all fields are a `UserError`."""
    if command.queries:
        positions, ghz = parsing.read_queries(command.queries)
        return Queries(positions, parse_frequencies(ghz, str(command.queries)), paired=True)
    if command.line or command.grid:
        positions = parsing.parse_line(command.line) if command.line else parsing.parse_grid(command.grid)
    else:
        positions = parse_positions(command.tx)
    option = "--sweep" if command.sweep else "--ghz"
    found = Queries(positions, parse_frequencies(parsing.parse_sweep(command.sweep) if command.sweep else command.ghz, option))
    parsing.check_count(len(found), "this command")
    return found


def lowest_queried(command: Command, queries: Queries) -> float:
    """Returns the lowest frequency (hertz) of the queries with their band; a band beyond the valid range is a `UserError`."""
    from wbgs_jax.types import LOWEST_OF_PATHS_HZ, MAX_FREQUENCY_HZ

    half = 0.5e6 * command.band_mhz if command.what == "frequency-response" else 0.0
    lowest, highest = float(queries.frequencies_hz.min() - half), float(queries.frequencies_hz.max() + half)
    if lowest < LOWEST_OF_PATHS_HZ or highest > MAX_FREQUENCY_HZ:
        edge = lowest if lowest < LOWEST_OF_PATHS_HZ else highest
        span = f"{LOWEST_OF_PATHS_HZ / 1e9:g} to {MAX_FREQUENCY_HZ / 1e9:g} GHz"
        raise UserError(f"--band-mhz {2e-6 * half:g} reaches {edge / 1e9:g} GHz; the valid range is {span}")
    return lowest


def _velocities(command: Command) -> dict[str, str]:
    return {"tx": command.tx_velocity, "rx": command.rx_velocity}


def _export(command: Command) -> None:
    from wbgs_jax.inference.evaluate_quantities import check_quantity
    from wbgs_jax.inference.export import export_field
    from wbgs_jax.training.run_folder import open_run

    assert command.export is not None
    trained = open_run(command.folder)
    dataset = trained.dataset()
    check_quantity("spectra", trained.field, dataset)
    export_field(trained, command.export, dataset=dataset)
    say(f"exported: {command.export} ({command.export.stat().st_size / 1e6:.1f} MB)")


def open_field(command: Command, queries: Queries) -> "CachedField | LoadedField":
    """Returns the field for the queries, from the cache if an earlier command stored it there."""
    from wbgs_jax.inference.cached_field import MOST, load_cached, make_cached

    lowest, few = lowest_queried(command, queries), len(queries) <= MOST
    if cached := load_cached(command.folder, command.rx, command.what, len(queries), lowest):
        return cached
    from wbgs_jax.inference.evaluate_quantities import check_quantity

    watched, state = _files(command.folder)
    tx, rx = (parse_vector(word, f"--{name}-velocity") for name, word in _velocities(command).items())
    options = Options(tx, rx, 1e6 * command.band_mhz, command.points, parsing.parse_array(command.tx_array))
    loaded = load_field(command.folder, command.rx, lowest, options)
    check_quantity(command.what, loaded.trained.field, loaded.dataset)
    if few and command.what in COMPILED:
        return make_cached(command.folder, command.rx, len(queries), loaded, watched, state) or loaded
    return loaded


def _files(run: Path) -> tuple[list[Path], str]:
    """Returns the files that a run is read from, and a checksum of their state."""
    from wbgs_jax.inference.cached_field import state_of
    from wbgs_jax.training.run_folder import read_config, sources_of

    files = sources_of(run, read_config(run))
    return files, state_of(files)


def answer_blocks(command: Command, queries: Queries, field: "CachedField | LoadedField") -> Answers:
    """Returns the predictions for all queries in blocks. Several blocks are stored in a folder until the result file is
    written, and remain there after Ctrl-C."""
    blocks = queries.blocks(BLOCK)
    target = command.out or command.picture
    assert target is not None, "checked"
    if len(blocks) == 1:
        return Answers([field.answer(command.what, blocks[0])])
    parts = open_parts(target, _question(command, queries, field.source), command.resume)
    if len(parts):
        say(f"continuing after {len(parts)} of {len(blocks)} blocks of {BLOCK} queries")
    try:
        with CountProgress(f"{command.what}, blocks of {BLOCK}", len(blocks), len(parts)) as progress:
            for block in blocks[len(parts) :]:
                parts.add(field.answer(command.what, block))
                progress.advance()
    except KeyboardInterrupt:
        say(f"{len(parts)} of {len(blocks)} blocks are kept in {parts.folder}; add --resume to the command to continue")
        raise
    return parts


def _question(command: Command, queries: Queries, source: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings that must be the same in a resumed command."""
    options = {
        name: getattr(command, name) for name in ("what", "rx", "tx_velocity", "rx_velocity", "band_mhz", "points", "tx_array")
    }
    run = command.folder.resolve()
    _, trained = _files(run)
    return options | {"run": str(run), "trained": trained, "queries": queries.digest(), "block": BLOCK, "source": source}


def answer(command: Command, queries: Queries) -> None:
    """Predicts for the queries and writes the requested files."""
    if QUANTITIES[command.what].form != "scalar" and command.out is None:
        queries = queries.some(shown_rows(len(queries)))  # only these are drawn
    field = open_field(command, queries)
    positions, frequencies = queries.tx_positions, queries.frequencies_hz
    if queries.paired:
        positions, frequencies = np.unique(positions, axis=0), np.unique(frequencies)
    warn(field.domain, field.source["receiver"]["position"], positions, frequencies)
    answers = answer_blocks(command, queries, field)
    if found := set(answers.names()) & set(INTERVALS):
        values = answers.whole(min(found))
        warn_of_intervals(np.isnan(values.reshape(len(values), -1)[:, 0]))
    for line in results_file.lines(command.what, answers, queries, field.source):
        say(line)
    count = counted(len(queries), "query", "queries")
    if not queries.paired:
        at = counted(len(queries.frequencies_hz), "frequency", "frequencies")
        count = f"{counted(len(queries.tx_positions), 'transmitter')} at {at}"
    if command.out:
        replaced = ", replacing the previous file" if command.out.exists() else ""
        results_file.write(command.out, command.what, answers, queries, field.source)
        say(f"{command.what}: {command.out} ({count}){replaced}")
    if command.picture:
        write_picture(command.picture, command.what, answers, queries, field)
        say(f"picture: {command.picture}")
    answers.remove()


def write_picture(path: Path, what: str, answers: Answers, queries: Queries, field: "CachedField | LoadedField") -> None:
    """Draws the predictions: numbers of all queries, anything else of some links."""
    from wbgs_jax.plotting import draw_prediction, save  # imported here because Matplotlib takes a while to load

    form, shown = QUANTITIES[what].form, shown_rows(len(queries))
    rows = answers.rows if form == "array" else lambda name, _: answers.whole(name)
    found = answers.shared() | {name: rows(name, shown) for name in answers.names()}
    walls = floor_plan(field, queries) if form == "table" else np.zeros((0, 2, 2))
    save(draw_prediction(what, found, queries if form == "scalar" else queries.some(shown), field.source, walls), path)


def floor_plan(field: "CachedField | LoadedField", queries: Queries) -> Float[np.ndarray, "n 2 2"]:
    """Returns the walls at the median height of the transmitters."""
    from wbgs_jax.inference.radio_map import cut_at

    loaded = cast("LoadedField", field)  # tables are not predicted from the cache
    return cut_at(loaded.dataset, float(np.median(queries.tx_positions[:, 2])))


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="wbgs-jax predict")
    check(command)
    queries = queries_of(command) if command.out or command.picture else None
    check_writable(command.out, command.picture, command.export)
    use_compilation_cache()
    if command.export:
        _export(command)
    if queries is not None:
        answer(command, queries)


if __name__ == "__main__":
    run_command(main)
