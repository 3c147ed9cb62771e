"""Predict maps with a trained field: a quantity at the receiver for transmitters all over a horizontal plane.

wbgs-jax map --run RUN --ghz 28 [60 ...] --out map.npz --picture map.png
wbgs-jax map --example --ghz 2.4 28 --picture map.png      the trained field that comes with the package
wbgs-jax map --run RUN --ghz 28 --what best-beam|k-factor|delay-spread|angular-spread --height 1.2 --step 0.1 --out map.npz
wbgs-jax map --run RUN --ghz 28 --what sinr|rsrp|best-server|throughput --tx x,y,z [x,y,z ...] --out map.npz --cdf cdf.png
"""

import wbgs_jax._util.quiet  # noqa: F401, before JAX is loaded

# isort: split

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro
from jaxtyping import Float

from wbgs_jax._util.cli import parse_number, parse_positions, run_command, say
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
from wbgs_jax.inference.quantities import INTERVALS, NETWORK, Network, names_for

# Modules that load JAX are imported where they are used, so that `--help` and errors of the command line appear at once.

if TYPE_CHECKING:
    from wbgs_jax.inference.evaluate_quantities import LoadedField

    What = str
else:
    What = Literal[names_for("map")]


@dataclass(frozen=True)
class Command(TrainedFieldOptions):
    """Predict maps with a trained field, for transmitters all over a horizontal plane."""

    ghz: tuple[float, ...]
    """Frequencies, one map for each; 1 to 100, or 0.3 to 100 for fields that predict paths."""
    what: What = "power"
    """Quantity to map; some fields provide only best-beam."""
    tx: tuple[str, ...] = ()
    """Transmitters x,y,z in metres of rsrp, sinr, best-server and throughput, which are mapped over receivers."""
    power_dbm: tuple[float, ...] = (20.0,)
    """Their powers, one each or one for all."""
    load: tuple[float, ...] = (1.0,)
    """Their mean activity as interferers, 0 to 1, one each or one for all."""
    bandwidth_mhz: float = 100.0
    """Bandwidth of noise and throughput."""
    noise_figure: float = 7.0
    """Noise figure of the receivers, dB."""
    height: float | None = None
    """Height of the plane, metres; by default the median of the transmitters in the data."""
    step: float = 0.25
    """Distance between neighbouring positions, metres."""
    area: str = ""
    """Corners of the plane, x0,y0:x1,y1 in metres; by default the whole scene."""
    rx: str = ""
    """Receiver, by default the first of the data: its index, x,y,z in metres, or
    x,y,z,w,i,j,k with a quaternion (wxyz) that rotates its array into the world frame."""
    out: Path | None = None
    """Write the maps to this .npz file, as arrays (frequency, y, x)."""
    picture: Path | None = None
    """Draw the maps (the first 6) and the walls to this .png, .svg or .pdf file."""
    cdf: Path | None = None
    """Draw the distribution of the quantity over the plane to this .png, .svg or .pdf file."""

    @property
    def network(self) -> Network:
        """Powers, loads and noise of several transmitters."""
        return Network(self.power_dbm, self.load, 1e6 * self.bandwidth_mhz, self.noise_figure)


def check(command: Command) -> None:
    """Raises a `UserError` for an invalid command line, or one without an output."""
    _ = command.folder  # one is named
    if not command.ghz:
        raise UserError("--ghz has no frequency; give gigahertz, such as --ghz 28")
    if not (command.out or command.picture or command.cdf):
        raise UserError("nothing to do; give --out map.npz, --picture map.png, or both")
    check_suffixes(command, {"out": (".npz",), "picture": PICTURES, "cdf": PICTURES})
    _check_network(command)
    if not (np.isfinite(command.step) and command.step > 0):
        raise UserError(f"--step {command.step:g} is not a distance; give metres, such as --step 0.25")
    if command.height is not None and not np.isfinite(command.height):
        raise UserError(f"--height {command.height:g} is not a height; give metres, such as --height 1.5")


def _check_network(command: Command) -> None:
    several = ", ".join(NETWORK)
    if (command.what in NETWORK) != bool(command.tx):
        raise UserError(
            f"--what {command.what} {'needs' if not command.tx else 'takes no'} --tx x,y,z; it belongs to {several}"
        )
    owners = dict.fromkeys(("power_dbm", "load", "bandwidth_mhz", "noise_figure"), NETWORK)
    check_effects(command, owners, (command.what,), f"--what {command.what}")
    if command.tx and command.rx:
        raise UserError("--tx maps over all receivers of the plane; omit --rx")
    for option, values in {"power-dbm": command.power_dbm, "load": command.load}.items():
        if len(values) not in (1, max(len(command.tx), 1)):
            raise UserError(
                f"--{option} has {len(values)} numbers for {len(command.tx)} transmitters; give one each or one for all"
            )
        if not np.isfinite(values).all():
            raise UserError(f"--{option} {' '.join(map(str, values))} is not finite; give numbers")
    if not all(0 <= load <= 1 for load in command.load):
        raise UserError(f"--load {' '.join(map(str, command.load))} is not an activity; give numbers from 0 to 1")
    if not (np.isfinite(command.bandwidth_mhz) and command.bandwidth_mhz > 0 and np.isfinite(command.noise_figure)):
        raise UserError(
            f"--bandwidth-mhz {command.bandwidth_mhz:g} --noise-figure {command.noise_figure:g}: no noise; give MHz and dB"
        )


def plane_of(command: Command, dataset: Any) -> Any:
    """Returns the plane (`radio_map.Plane`) of the command line; an empty area or too many positions are a `UserError`."""
    from wbgs_jax.data.scene import DatasetScene
    from wbgs_jax.inference.radio_map import plane_over

    low, high = DatasetScene(dataset).box[:, :2]
    if command.area:
        try:
            corners = np.array([[parse_number(part) for part in corner.split(",")] for corner in command.area.split(":")])
        except ValueError:
            corners = np.zeros(0)
        if corners.shape != (2, 2) or not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
            raise UserError(f"--area {command.area} is not a rectangle; give x0,y0:x1,y1 in metres, the lower corner first")
        low, high = corners
    most_places = 1_000_000
    if np.prod((high - low) / command.step) > most_places:
        raise UserError(
            f"--step {command.step:g} gives more than {most_places:,} positions; give a larger one, or a smaller --area"
        )
    height = float(np.median(dataset.tx_positions[:, 2])) if command.height is None else command.height
    return plane_over(low, high, height, command.step)


def at_transmitters(positions: Float[np.ndarray, "tx 3"], field: "LoadedField") -> "list[LoadedField]":
    """Returns a trained field at isotropic antennas in the places of transmitters, which receive there."""
    from wbgs_jax.fields.calibratable import at_isotropic_antennas
    from wbgs_jax.inference.trained_field import at_receiver
    from wbgs_jax.types import make_receiver

    def at(receiver: Any) -> "LoadedField":
        trained = at_receiver(field.trained, receiver, field.dataset)
        own, params = at_isotropic_antennas(trained.field, trained.params)
        return replace(field, trained=replace(trained, field=own, params=params), receiver=receiver)

    return [at(make_receiver(position, element_positions=np.zeros((1, 3)))) for position in positions]


def make_maps(command: Command) -> None:
    """Predicts the maps and writes the requested files."""
    from wbgs_jax.inference.radio_map import cut_at, evaluate_network, evaluate_plane, pieces
    from wbgs_jax.inference.results_file import write_arrays

    frequencies_hz, positions = parse_frequencies(command.ghz), parse_positions(command.tx)
    field = load_field(command.folder, command.rx, float(frequencies_hz.min()))
    plane = plane_of(command, field.dataset)
    rx = positions if len(positions) else np.asarray(field.receiver.position)[None]
    corners = np.array([[x, y, plane.height] for x in plane.xs[[0, -1]] for y in plane.ys[[0, -1]]])
    receiving, sending = (corners, positions) if len(positions) else (rx, corners)
    warn(field.domain, receiving, sending, frequencies_hz)
    with CountProgress(f"map of {command.what}", len(rx) * pieces(plane, frequencies_hz)) as progress:
        if len(positions):
            fields = at_transmitters(positions, field)
            answer = evaluate_network(fields, plane, frequencies_hz, command.network, progress.advance)
            answer["tx_positions"] = positions
        else:
            answer = evaluate_plane(command.what, field, plane, frequencies_hz, progress.advance)
    outside = np.asarray(field.domain.outside(plane.positions())).reshape(len(plane.ys), len(plane.xs))
    missing = outside | np.asarray(field.domain.out_of_band(frequencies_hz))[:, None, None]
    answer["no_confidence"] = missing.all(0)
    if answer.keys() & set(INTERVALS):
        warn_of_intervals(missing)
    size = f"{len(plane.xs)} x {len(plane.ys)} positions at {len(frequencies_hz)} frequencies"
    if command.out:
        write_arrays(command.out, answer, _source(command, field))
        say(f"map: {command.out} ({size})")
    if command.picture or command.cdf:
        from wbgs_jax.plotting import draw_distribution, draw_maps, save

        if command.picture:
            save(draw_maps(command.what, answer, cut_at(field.dataset, plane.height), field.source), command.picture)
            say(f"picture: {command.picture}")
        if command.cdf:
            save(draw_distribution(command.what, answer | {"no_confidence": outside}, field.source), command.cdf)
            say(f"distribution: {command.cdf}")


def _source(command: Command, field: "LoadedField") -> dict[str, Any]:
    """Returns the provenance of the maps."""
    if not command.tx:
        return field.source | {"what": command.what}
    source = {name: value for name, value in field.source.items() if name != "receiver"}
    return source | {"what": command.what} | command.network._asdict()


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="wbgs-jax map")
    check(command)
    check_writable(command.out, command.picture, command.cdf)
    use_compilation_cache()
    make_maps(command)


if __name__ == "__main__":
    run_command(main)
