"""Ask a trained field for spectra, or export it:

wbgs-jax predict --run RUN --tx x,y,z [x,y,z ...] --ghz 28 [60 ...] --out spectra.npz [--picture spectra.png]
wbgs-jax predict --run RUN --tx x,y,z --ghz 28 --what snapshot|power|k-factor|delay-spread --out channel.npz
wbgs-jax predict --run RUN --tx x,y,z --ghz 28 --what paths --out paths.csv
wbgs-jax predict --run RUN --rx x,y,z --tx x,y,z --ghz 28 --out elsewhere.npz
wbgs-jax predict --run RUN --export field.zip
"""


# isort: split

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from jaxtyping import Float
from matplotlib.figure import Figure

from wbgs_jax._util.command import parse_positions, parse_vector, run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, write_csv
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.inference.answers import (
    check_frequencies,
    doubts,
    frequencies,
    link_words,
    point_words,
    receiver_at,
    source_of,
    write_answer,
)
from wbgs_jax.inference.confidence import LEVEL, expect_many
from wbgs_jax.inference.export import export_field
from wbgs_jax.inference.links import as_rows, ask_mimo, ask_paths, ask_response
from wbgs_jax.inference.neighbours import for_receiver
from wbgs_jax.inference.predictor import at_receiver, observe_queries
from wbgs_jax.inference.quantities import ask_channel
from wbgs_jax.radio.array import planar_array
from wbgs_jax.training.run_folder import TrainedField, load_trained
from wbgs_jax.types import LOWEST_OF_PATHS_HZ, MAX_FREQUENCY_HZ, Receiver, make_query

SHOWN = 12
"""Spectra in a picture."""
SUFFIXES = {"out": ".npz", "picture": ".png", "export": ".zip"}
What = Literal[
    "spectra",
    "snapshot",
    "power",
    "beamforming-gain",
    "k-factor",
    "angular-spread",
    "delay-spread",
    "paths",
    "frequency-response",
    "mimo",
]
MOST_POINTS, MOST_ELEMENTS = 4096, 1024


@dataclass(frozen=True)
class Command:
    """Ask a trained field for the spectra of transmitters, or export it."""

    run: Path
    """Run folder."""
    tx: tuple[str, ...] = ()
    """Transmitters, each as x,y,z in metres (world frame)."""
    ghz: tuple[float, ...] = ()
    """Frequencies, 1 to 100, and from 0.3 for fields with paths; every transmitter is asked at every one of them."""
    rx: str = ""
    """Another receiver than the first of the data: the number of one of them; or x,y,z in metres, or x,y,z,w,i,j,k with the
    quaternion that turns its array into the world frame. Array and pattern stay. Only fields with paths know places that the
    data do not have."""
    what: What = "spectra"
    """What to ask for: power angular spectra, or quantities of the channel, which only some fields know."""
    tx_velocity: str = "0,0,0"
    """Of the transmitters, metres a second: Doppler shifts of paths follow from it."""
    rx_velocity: str = "0,0,0"
    """Of the receiver."""
    band_mhz: float = 100.0
    """Width of the band of a frequency response ..."""
    points: int = 64
    """... and frequencies in it."""
    tx_array: str = "1x1"
    """Of a MIMO matrix: ROWSxCOLUMNS elements of each transmitter half a wavelength apart, in the y-z plane of the world."""
    out: Path | None = None
    """Write the answers to this .npz file; a table of paths to a .csv file, too."""
    picture: Path | None = None
    """Draw the spectra (the first 12) into this .png file."""
    export: Path | None = None
    """Write the field to this .zip file, which runs without its training code (docs/inference.md)."""


@dataclass(frozen=True)
class Spectra:
    """The answer: every transmitter at every frequency."""

    pas: Float[np.ndarray, "tx freq 90 360"]
    """float32."""
    tx_positions: Float[np.ndarray, "tx 3"]
    frequencies_hz: Float[np.ndarray, " freq"]
    expected: Float[np.ndarray, "tx freq 3"] | None = None
    """Expected SSIM of every answer, and the ends of its interval; None where a run does not know how sure it is."""


def check(command: Command) -> None:
    """Raises a `UserError` for a command line that asks for nothing, or for half of something."""
    for name, suffix in SUFFIXES.items():
        path = getattr(command, name)
        if path is not None and path.suffix not in (suffix, *([".csv"] if (name, command.what) == ("out", "paths") else [])):
            raise UserError(f"--{name} {path} does not end in {suffix}; rename it")
    asks, writes = bool(command.tx or command.ghz), bool(command.out or command.picture)
    if not (asks or writes or command.export):
        raise UserError("nothing to do; give --tx x,y,z --ghz 28 --out spectra.npz, or --export field.zip")
    if (asks or writes) and not (command.tx and command.ghz and writes):
        raise UserError("answers need all of --tx x,y,z, --ghz 28 and --out spectra.npz (or --picture spectra.png)")
    for name, word in _velocities(command).items():
        parse_vector(word, f"--{name}-velocity")
    _array(command.tx_array)
    if not (0 < command.band_mhz < np.inf and 2 <= command.points <= MOST_POINTS):
        raise UserError(f"--band-mhz {command.band_mhz:g} --points {command.points} is no band; give 2 to {MOST_POINTS} points")
    if command.what != "spectra" and (command.picture or (asks and not command.out)):
        raise UserError(f"--what {command.what} writes numbers: give --out channel.npz, and no --picture")


def ask(
    trained: TrainedField,
    receiver: Receiver,
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
) -> Spectra:
    """Returns the spectra of every transmitter at every frequency."""
    shape = len(tx_positions), len(frequencies_hz)
    tx, frequency = np.repeat(tx_positions, shape[1], axis=0), np.tile(frequencies_hz, shape[0])
    seen = observe_queries(trained, receiver, make_query(tx, frequency))
    pas, power = np.asarray(seen.pas), None if seen.power_db is None else np.asarray(seen.power_db)
    confidence = for_receiver(trained.confidence, receiver)
    expected = None
    if confidence is not None:
        expected = np.stack(expect_many(confidence, pas, tx, frequency, power), -1).reshape(*shape, 3)
    return Spectra(pas.reshape(*shape, *pas.shape[1:]), tx_positions, frequencies_hz, expected)


def sureness(spectra: Spectra) -> list[str]:
    """Returns how good the first `SHOWN` answers are expected to be: one line each."""
    if spectra.expected is None:
        return []
    lines = []
    for (tx, frequency), (ssim, low, high) in zip(
        np.ndindex(spectra.expected.shape[:2]), spectra.expected.reshape(-1, 3), strict=True
    ):
        where = link_words(spectra.tx_positions[tx], float(spectra.frequencies_hz[frequency]))
        lines.append(f"{where}: expected SSIM {ssim:.2f}, {100 * LEVEL:.0f} % between {low:.2f} and {min(high, 1):.2f}")
    return lines[:SHOWN]


def ask_for(
    command: Command,
    trained: TrainedField,
    dataset: Dataset,
    receiver: Receiver,
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
) -> dict[str, np.ndarray]:
    """Returns the arrays that answer what is asked for beside spectra."""
    asked = receiver, tx_positions, frequencies_hz
    if command.what == "paths":
        velocities = (parse_vector(word, f"--{name}-velocity") for name, word in _velocities(command).items())
        return ask_paths(trained, dataset, *asked, *velocities)
    if command.what == "frequency-response":
        return ask_response(trained, *asked, 1e6 * command.band_mhz, command.points)
    if command.what == "mimo":
        return ask_mimo(trained, *asked, planar_array(*_array(command.tx_array)))
    return ask_channel(command.what, trained, dataset, *asked)


def lowest_asked(command: Command, frequencies_hz: Float[np.ndarray, " freq"]) -> float:
    """Returns the lowest frequency (hertz) that is asked for; a band that reaches beyond what fields know is a `UserError`."""
    half = 0.5e6 * command.band_mhz if command.what == "frequency-response" else 0.0
    lowest, highest = float(frequencies_hz.min() - half), float(frequencies_hz.max() + half)
    if lowest < LOWEST_OF_PATHS_HZ or highest > MAX_FREQUENCY_HZ:
        edge = lowest if lowest < LOWEST_OF_PATHS_HZ else highest
        span = f"{LOWEST_OF_PATHS_HZ / 1e9:g} to {MAX_FREQUENCY_HZ / 1e9:g} GHz"
        raise UserError(f"--band-mhz {2e-6 * half:g} reaches {edge / 1e9:g} GHz; the model knows {span}")
    return lowest


def _velocities(command: Command) -> dict[str, str]:
    return {"tx": command.tx_velocity, "rx": command.rx_velocity}


def _array(word: str) -> tuple[int, int]:
    """Returns rows and columns of "4x2"; anything else is a `UserError`."""
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", word)
    rows, columns = (int(number) for number in found.groups()) if found else (0, 0)
    if not 0 < rows * columns <= MOST_ELEMENTS:
        raise UserError(f"--tx-array {word} is no array; give ROWSxCOLUMNS, such as 4x2, at most {MOST_ELEMENTS} elements")
    return rows, columns


def power_lines(answer: dict[str, np.ndarray]) -> list[str]:
    """Returns the first `SHOWN` received powers, and how sure they are: one line each; nothing of other quantities."""
    if "within_db" not in answer:
        return []
    lines = []
    for place, power in np.ndenumerate(answer["power_db"]):
        where = link_words(answer["tx_positions"][place[0]], float(answer["frequencies_hz"][place[1]]))
        expected, within = (answer[name][place] for name in ("expected_error_db", "within_db"))
        sure = f"expected {expected:.1f} dB off, {100 * LEVEL:.0f} % within {within:.1f} dB"
        lines.append(f"{where}: {power:.1f} dB of the transmitted power; {sure}")
    return lines[:SHOWN]


def draw(spectra: Spectra) -> Figure:
    """Returns a figure of the first `SHOWN` spectra over azimuth and zenith, the frequencies of a transmitter in a row."""
    images = spectra.pas.reshape(-1, *spectra.pas.shape[2:])[:SHOWN]
    columns = min(2, len(images))
    rows = -(-len(images) // columns)
    figure = Figure(figsize=(5.5 * columns, 1.9 * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for i, axis in enumerate(axes.flat):
        if i >= len(images):
            axis.axis("off")
            continue
        tx, frequency = divmod(i, len(spectra.frequencies_hz))
        shown = axis.imshow(images[i], vmin=0, vmax=1, cmap="viridis", extent=(-180, 180, 90, 0), aspect="auto")
        axis.set_title(
            f"{spectra.frequencies_hz[frequency] / 1e9:g} GHz, TX {point_words(spectra.tx_positions[tx])}", fontsize=9
        )
        axis.set(xticks=range(-180, 181, 90), yticks=(0, 45, 90))
    figure.supxlabel("azimuth [deg]", fontsize=9)
    figure.supylabel("zenith [deg]", fontsize=9)
    figure.colorbar(shown, ax=axes, shrink=0.8, label="normalised amplitude")
    return figure


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    use_compilation_cache()
    command = tyro.cli(Command, args=arguments, prog="wbgs-jax predict")
    check(command)
    tx_positions, frequencies_hz = parse_positions(command.tx), frequencies(command.ghz)
    trained = load_trained(command.run)
    dataset = trained.dataset()
    if command.export:
        export_field(trained, command.export, dataset=dataset)
        say(f"exported: {command.export} ({command.export.stat().st_size / 1e6:.1f} MB)")
    if not (command.out or command.picture):
        return
    receiver = receiver_at(command.rx, dataset)
    trained = at_receiver(trained, receiver, dataset)
    check_frequencies(trained, lowest_asked(command, frequencies_hz))
    for line in doubts(dataset, np.asarray(receiver.position), tx_positions, frequencies_hz):
        say(f"warning: {line}")
    if command.what != "spectra":
        assert command.out is not None, "checked"
        answer = ask_for(command, trained, dataset, receiver, tx_positions, frequencies_hz)
        for line in power_lines(answer):
            say(line)
        if command.out.suffix == ".csv":
            write_csv(command.out, as_rows(answer))
        else:
            write_answer(command.out, answer, source_of(trained, dataset, receiver))
        say(f"{command.what}: {command.out} ({len(tx_positions)} transmitters at {len(frequencies_hz)} frequencies)")
        return
    spectra = ask(trained, receiver, tx_positions, frequencies_hz)
    for line in sureness(spectra):
        say(line)
    if command.out:
        write_answer(command.out, vars(spectra), source_of(trained, dataset, receiver))
        say(f"spectra: {command.out} ({len(tx_positions)} transmitters at {len(frequencies_hz)} frequencies)")
    if command.picture:
        with atomic_write(command.picture) as stream:
            draw(spectra).savefig(stream, format="png", dpi=110)
        say(f"picture: {command.picture}")


if __name__ == "__main__":
    run_command(main)
