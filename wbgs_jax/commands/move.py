"""Predict a channel over time while a transmitter, the receiver, a person or a body of the mesh moves:

wbgs-jax move --run RUN --tx 1,0.5,1.5 --person 0,-1,0 0,1,0 --ghz 60 --out walk.npz --picture walk.png
wbgs-jax move --run RUN --tx 1,0.5,1.5 2,0.5,1.5 2,2,1.5 --seconds 3 --ghz 28 --out drive.csv
wbgs-jax move --example --tx 1,0.5,1.5 --body 2,1,0.5 --body-shift 0,0.5,0 --ghz 5 --picture door.png

Whatever moves does so at constant speed, along the straight lines between its places, for the whole time.
"""

import wbgs_jax._util.quiet  # noqa: F401, before JAX is loaded

# isort: split

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro
from jaxtyping import Float

from wbgs_jax._util.cli import parse_positions, parse_vector, run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import check_writable, write_csv
from wbgs_jax._util.progress_lines import CountProgress
from wbgs_jax.commands.options import PICTURES, TrainedFieldOptions, check_suffixes, load_field, parse_frequencies, warn
from wbgs_jax.inference.results_file import write_arrays

if TYPE_CHECKING:
    from wbgs_jax.fields import Field
    from wbgs_jax.propagation.displacement import Motion

# Modules that load JAX are imported where they are used, so that `--help` and errors of the command line appear at once.

MOST = 20_000
"""Maximum number of instants."""
FEWEST = 500
"""Minimum number of instants of the default rate."""


@dataclass(frozen=True)
class Command(TrainedFieldOptions):
    """Predict a channel over time while a transmitter, the receiver, a person or a body of the mesh moves."""

    tx: tuple[str, ...] = ()
    """Transmitter x,y,z in metres (world frame), or several places that it passes."""
    person: tuple[str, ...] = ()
    """Places x,y,z between the feet of a person who walks through the scene, or stands at a single one."""
    body: str = ""
    """A point x,y,z: the body of the mesh that is nearest to it moves ..."""
    body_shift: str = ""
    """... by x,y,z in metres."""
    rx_shift: str = ""
    """Displacement x,y,z of the receiver, metres."""
    rx: str = ""
    """Receiver, by default the first of the data: its index, or x,y,z in metres."""
    ghz: float = 0.0
    """Frequency."""
    seconds: float = 1.0
    """Duration."""
    rate: float | None = None
    """Instants per second; by default as many as the Doppler shifts need, at least 500 in all."""
    out: Path | None = None
    """Write the channel to this .npz file (response, powers, delays and amplitudes of paths, Doppler spectrogram), or its power
    and phase to this .csv file."""
    picture: Path | None = None
    """Draw power and Doppler spectrogram to this .png, .svg or .pdf file."""


def check(command: Command) -> None:
    """Raises a `UserError` for an invalid or incomplete command line."""
    _ = command.folder  # one is named
    check_suffixes(command, {"out": (".npz", ".csv"), "picture": PICTURES})
    if not (command.tx and command.ghz and (command.out or command.picture)):
        raise UserError("a channel over time needs all of --tx x,y,z, --ghz 28 and --out c.npz (or --picture c.png)")
    if bool(command.body) != bool(command.body_shift):
        raise UserError("--body x,y,z and --body-shift x,y,z belong together; give both")
    if not (len(command.tx) > 1 or command.person or command.body or command.rx_shift):
        raise UserError("nothing moves; give --tx two places, or --person, --body and --body-shift, or --rx-shift")
    if not 0 < command.seconds < np.inf:
        raise UserError(f"--seconds {command.seconds:g} is not a duration")
    if command.rate is not None and not 0 < command.rate < np.inf:
        raise UserError(f"--rate {command.rate:g} is not a rate; give instants per second")


def length_of(places: Float[np.ndarray, "n 3"]) -> float:
    """Returns the length of a way, metres."""
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def times_of(command: Command, frequency_hz: float) -> Float[np.ndarray, " t"]:
    """Returns the instants (seconds); too many or too few are a `UserError`.

    A path's length changes by at most the way of each end, and twice the way of a body that reflects it.
    """
    from wbgs_jax.types import SPEED_OF_LIGHT

    ends = length_of(parse_positions(command.tx)), np.linalg.norm(_vector(command.rx_shift, "--rx-shift"))
    bodies = length_of(parse_positions(command.person, "--person"))
    bodies = max(bodies, float(np.linalg.norm(_vector(command.body_shift, "--body-shift"))))
    needed = 2 * (sum(ends) + 2 * bodies) / command.seconds * frequency_hz / SPEED_OF_LIGHT
    spare = 1.25  # rate relative to the lowest one that resolves the Doppler shifts
    rate = max(spare * needed, FEWEST / command.seconds) if command.rate is None else command.rate
    count = round(rate * command.seconds)
    if not 2 <= count <= MOST:
        raise UserError(f"{count:,} instants are not 2 to {MOST:,}; give other --seconds, or --rate R in instants per second")
    if rate < needed:
        say(f"warning: a rate of {rate:g} Hz does not resolve all Doppler shifts; {needed:.0f} Hz would")
    return np.arange(count) / rate


def _vector(word: str, option: str) -> Float[np.ndarray, "3"]:
    return parse_vector(word, option, "displacement", "metres") if word else np.zeros(3)


def motion_of(command: Command, field: "Field", params: Any, share: Float[np.ndarray, " t"]) -> "tuple[Field, Any, Motion]":
    """Returns the field, with the person if there is one, its parameters, and where everything is after shares of the time."""
    from wbgs_jax.applications.movement import add_body, make_movement, nearest_body, person, position_along

    shift = {}
    if command.body:
        number = nearest_body(field, parse_vector(command.body, "--body", "position", "metres"))
        shift[number] = share[:, None] * _vector(command.body_shift, "--body-shift")
    if command.person:
        places = parse_positions(command.person, "--person")
        ahead = places[-1] - places[0]
        field, params, number = add_body(field, params, person(places[0], azimuth=float(np.arctan2(ahead[1], ahead[0]))))
        shift[number] = position_along(places, share) - places[0]
    receiver_shift = share[:, None] * _vector(command.rx_shift, "--rx-shift")
    return field, params, make_movement(field, len(share), shift, receiver_shift=receiver_shift)


def simulate(command: Command) -> None:
    """Computes the channel, prints its figures and writes the files."""
    from wbgs_jax.applications.movement import channel_over_time, position_along
    from wbgs_jax.types import make_query

    frequency_hz = float(parse_frequencies((command.ghz,))[0])
    seconds = times_of(command, frequency_hz)
    rate_hz = 1 / (seconds[1] - seconds[0])
    share = seconds / command.seconds
    loaded = load_field(command.folder, command.rx, frequency_hz)
    field, params, motion = motion_of(command, *loaded.trained.field.receiver_independent(loaded.trained.params), share)
    tx = position_along(parse_positions(command.tx), share)
    warn(loaded.domain, loaded.receiver.position, parse_positions(command.tx), np.array([frequency_hz]))
    at_once = 200  # instants that are computed together
    blocks = -(-len(seconds) // at_once)
    with CountProgress(f"channel, blocks of {at_once} instants", blocks) as progress:
        query = make_query(tx, frequency_hz)
        found = channel_over_time(field, params, loaded.receiver, query, motion, rate_hz, at_once, progress.advance)
    found = {"time_s": seconds, "tx_position": tx} | found
    power_db = found["power_db"]
    low, middle, high = (f"{value:.1f}" for value in np.quantile(power_db, (0, 0.5, 1)))
    say(f"{len(seconds):,} instants, {rate_hz:.6g} per second: power {middle} dB (median), {low} to {high} dB")
    if command.out:
        write(command.out, found, loaded.source | {"frequency_hz": frequency_hz})
        say(f"channel: {command.out}")
    if command.picture:
        from wbgs_jax.plotting import draw_channel, save  # imported here because Matplotlib takes a while to load

        save(draw_channel(found, loaded.source, frequency_hz), command.picture)
        say(f"picture: {command.picture}")


def write(path: Path, found: dict[str, np.ndarray], source: dict[str, Any]) -> None:
    """Writes the channel with its provenance as .npz, or its power and phase as .csv."""
    if path.suffix == ".csv":
        columns = found["time_s"], *found["tx_position"].T, found["power_db"], np.angle(found["response"])
        rows = ([f"{value:.8g}" for value in row] for row in zip(*columns, strict=True))
        write_csv(path, [["time_s", "tx_x", "tx_y", "tx_z", "power_db", "phase_rad"], *rows])
        return
    write_arrays(path, found, source)


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="wbgs-jax move")
    check(command)
    check_writable(command.out, command.picture)
    use_compilation_cache()
    simulate(command)


if __name__ == "__main__":
    run_command(main)
