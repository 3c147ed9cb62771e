"""Ask a trained field for maps over a floor: what reaches the receiver from a transmitter at every place of a level plane.

wbgs-jax map --run RUN --ghz 28 [60 ...] --out map.npz --picture map.png
wbgs-jax map --run RUN --ghz 28 --what best-beam|k-factor|delay-spread|angular-spread --height 1.2 --step 0.1 --out map.npz
"""

import wbgs_jax._util.quiet  # noqa: F401, before JAX is loaded

# isort: split

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import tyro
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from wbgs_jax._util.command import run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write
from wbgs_jax._util.progress import CountProgress
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.surface import DatasetScene
from wbgs_jax.inference.answers import check_frequencies, doubts, frequencies, receiver_at, source_of, write_answer
from wbgs_jax.inference.floor import Plane, ask_plane, cut_at, pieces, plane_over
from wbgs_jax.inference.predictor import at_receiver
from wbgs_jax.radio.channel import NOT_HEARD_DB
from wbgs_jax.training.run_folder import load_trained

MOST_PLACES = 1_000_000
SHOWN = 6
"""Frequencies in a picture."""
SUFFIXES = {"out": ".npz", "picture": ".png"}
What = Literal["power", "best-beam", "k-factor", "delay-spread", "angular-spread"]


class Look(NamedTuple):
    """How a quantity is drawn."""

    name: str
    """In the answer."""
    label: str
    scale: float = 1.0
    """Drawn units in one of the answer's."""
    colors: str = "viridis"


LOOKS: dict[str, Look] = {
    "power": Look("power_db", "received power [dB of the transmitted]"),
    "best-beam": Look("best_beam", "azimuth of the best beam [deg]", colors="twilight"),
    "k-factor": Look("k_factor_db", "K-factor [dB]"),
    "delay-spread": Look("delay_spread_s", "r.m.s. delay spread [ns]", 1e9),
    "angular-spread": Look("angular_spread_deg", "spread of the azimuth of arrival [deg]"),
}


@dataclass(frozen=True)
class Command:
    """Ask a trained field for maps of transmitters over a level plane."""

    run: Path
    """Run folder."""
    ghz: tuple[float, ...]
    """Frequencies, 1 to 100, and from 0.3 for fields with paths: a map each."""
    what: What = "power"
    """What to map; all but best-beam only where the field knows it."""
    height: float | None = None
    """Of the transmitters, metres; by default the median of those of the data."""
    step: float = 0.25
    """Metres between places."""
    area: str = ""
    """Corners of the plane, x0,y0:x1,y1 in metres; by default all of the scene."""
    rx: str = ""
    """Another receiver than the first of the data: the number of one of them, x,y,z in metres, or x,y,z,w,i,j,k with the
    quaternion that turns its array into the world frame."""
    out: Path | None = None
    """Write the maps to this .npz file: values (frequency, y, x)."""
    picture: Path | None = None
    """Draw the maps (the first 6) with the walls into this .png file."""


def check(command: Command) -> None:
    """Raises a `UserError` for a command line that asks for nothing, or for what cannot be."""
    if not (command.out or command.picture):
        raise UserError("nothing to do; give --out map.npz, --picture map.png, or both")
    for name, suffix in SUFFIXES.items():
        path = getattr(command, name)
        if path is not None and path.suffix != suffix:
            raise UserError(f"--{name} {path} does not end in {suffix}; rename it")
    if not (np.isfinite(command.step) and command.step > 0):
        raise UserError(f"--step {command.step:g} is no distance; give metres, such as --step 0.25")
    if command.height is not None and not np.isfinite(command.height):
        raise UserError(f"--height {command.height:g} is no height; give metres, such as --height 1.5")


def plane_of(command: Command, dataset: Dataset) -> Plane:
    """Returns the plane that is asked for; one that is empty or has too many places is a `UserError`."""
    low, high = DatasetScene(dataset).box[:, :2]
    if command.area:
        try:
            corners = np.array([[float(part) for part in corner.split(",")] for corner in command.area.split(":")])
        except ValueError:
            corners = np.zeros(0)
        if corners.shape != (2, 2) or not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
            raise UserError(f"--area {command.area} is no rectangle; give x0,y0:x1,y1 in metres, the lower corner first")
        low, high = corners
    if np.prod((high - low) / command.step) > MOST_PLACES:
        raise UserError(f"--step {command.step:g} makes more than {MOST_PLACES:,} places; give a larger one, or an --area")
    height = float(np.median(dataset.tx_positions[:, 2])) if command.height is None else command.height
    return plane_over(low, high, height, command.step)


def draw(what: str, answer: dict[str, np.ndarray], walls: Float[np.ndarray, "n 2 2"], rx: Float[np.ndarray, "3"]) -> Figure:
    """Returns a figure of the first `SHOWN` maps with the walls that the plane cuts, and the receiver as a star."""
    look, xs, ys = LOOKS[what], answer["xs"], answer["ys"]
    values = _drawn(look, answer)[:SHOWN]
    half = [(np.ptp(places) / (len(places) - 1) if len(places) > 1 else 1.0) / 2 for places in (xs, ys)]
    extent = (xs[0] - half[0], xs[-1] + half[0], ys[0] - half[1], ys[-1] + half[1])
    wide = extent[1] - extent[0] > extent[3] - extent[2]
    rows, columns = (len(values), 1) if wide and len(values) < 4 else (-(-len(values) // 2), min(2, len(values)))
    ratio = (extent[3] - extent[2]) / (extent[1] - extent[0])
    figure = Figure(figsize=(1.5 + 6 * columns, 0.8 + rows * (0.5 + 6 * min(ratio, 2.0))), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    span = {"vmin": -180.0, "vmax": 180.0} if what == "best-beam" else _span(values)
    for i, axis in enumerate(axes.flat):
        if i >= len(values):
            axis.axis("off")
            continue
        shown = axis.imshow(values[i], extent=extent, origin="lower", cmap=look.colors, aspect="equal", **span)
        axis.add_collection(LineCollection(list(walls), colors="black", linewidths=0.8))
        axis.plot(*rx[:2], "*", color="white", markeredgecolor="black", markersize=14)
        axis.set(xlim=extent[:2], ylim=extent[2:])
        axis.set_title(f"{answer['frequencies_hz'][i] / 1e9:g} GHz", fontsize=10)
    figure.supxlabel("x [m]", fontsize=9)
    figure.supylabel("y [m]", fontsize=9)
    figure.colorbar(shown, ax=axes, shrink=0.8, label=f"{look.label}, transmitters {answer['height']:.3g} m high")
    return figure


def _drawn(look: Look, answer: dict[str, np.ndarray]) -> Float[np.ndarray, "freq ny nx"]:
    values = answer[look.name]
    if look.name == "best_beam":
        return answer["beam_azimuth_deg"][values]
    heard = values > NOT_HEARD_DB if look.name == "power_db" else np.ones(values.shape, bool)
    drawn = look.scale * np.where(heard, values, np.nan)
    return drawn[..., 0] if drawn.ndim > 3 else drawn


def _span(values: Float[np.ndarray, "freq ny nx"]) -> dict[str, Any]:
    """Returns limits of the colours that leave out the extreme hundredths."""
    low, high = np.nanquantile(values, [0.01, 0.99])
    return {"vmin": float(low), "vmax": float(high)}


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    use_compilation_cache()
    command = tyro.cli(Command, args=arguments, prog="wbgs-jax map")
    check(command)
    frequencies_hz = frequencies(command.ghz)
    trained = load_trained(command.run)
    dataset = trained.dataset()
    plane, receiver = plane_of(command, dataset), receiver_at(command.rx, dataset)
    trained = at_receiver(trained, receiver, dataset)
    check_frequencies(trained, float(frequencies_hz.min()))
    rx = np.asarray(receiver.position)
    corners = np.array([[x, y, plane.height] for x in plane.xs[[0, -1]] for y in plane.ys[[0, -1]]])
    for line in doubts(dataset, rx, corners, frequencies_hz):
        say(f"warning: {line}")
    with CountProgress(f"map of {command.what}", pieces(plane, frequencies_hz)) as progress:
        answer = ask_plane(command.what, trained, dataset, receiver, plane, frequencies_hz, progress.advance)
    size = f"{len(plane.xs)} x {len(plane.ys)} places at {len(frequencies_hz)} frequencies"
    if command.out:
        write_answer(command.out, answer, source_of(trained, dataset, receiver) | {"what": command.what})
        say(f"map: {command.out} ({size})")
    if command.picture:
        with atomic_write(command.picture) as stream:
            draw(command.what, answer, cut_at(dataset, plane.height), rx).savefig(stream, format="png", dpi=110)
        say(f"picture: {command.picture}")


if __name__ == "__main__":
    run_command(main)
