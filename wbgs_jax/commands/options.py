"""Options shared by several commands: parsing of receivers and frequencies, and loading of trained fields.

JAX is not loaded before a run is opened, so that `--help` and errors of the command line appear at once.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro
from jaxtyping import Bool, Float

from wbgs_jax._util.cli import parse_numbers, say
from wbgs_jax._util.errors import UserError
from wbgs_jax.training import EXAMPLE

if TYPE_CHECKING:
    from wbgs_jax.data.dataset import Dataset
    from wbgs_jax.inference.domain import Domain
    from wbgs_jax.inference.evaluate_quantities import LoadedField
    from wbgs_jax.inference.quantities import Options
    from wbgs_jax.types import Receiver

SHOWN = 12
"""Maximum number of warnings printed."""
PICTURES = (".png", ".svg", ".pdf")
"""Suffixes of pictures."""


@dataclass(frozen=True, kw_only=True)
class TrainedFieldOptions:
    """The trained field of a command: a run of one's own, or the example."""

    run: Path | None = None
    """Run folder."""
    example: tyro.conf.FlagCreatePairsOff[bool] = False
    """Instead: the trained field in the package, of scene 1."""

    @property
    def folder(self) -> Path:
        """The run folder; a command line that names none, or two, is a `UserError`."""
        if self.example and self.run is not None:
            raise UserError("--run and --example exclude each other; give one of them")
        if not self.example and self.run is None:
            raise UserError(
                "no trained field; give --example for the one that comes with the package, or --run RUN, a folder of "
                "`wbgs-jax train --scene 1 --out RUN`"
            )
        return self.run or EXAMPLE


@dataclass(frozen=True, kw_only=True)
class SurveyOptions:
    """Height and cells of readings, and their floor plan."""

    floor_plan: Path | None = None
    """Walls x1,y1,x2,y2 or corners x,y (.csv); by default the folder's."""
    height: float | None = None
    """Height of readings without z, metres; by default 1.3."""
    cell: float | None = None
    """Side of the cells that are averaged, metres; by default 0.25."""

    def survey_settings(self) -> dict[str, Any]:
        """Returns the arguments of `load_survey` that were given; what cannot be a length is a `UserError`."""
        given = {"height": self.height, "cell": self.cell}
        for name, value in given.items():
            if value is not None and not (np.isfinite(value) and (name == "height" or value > 0)):
                raise UserError(f"--{name} is {value:g}; give metres")
        named = {"floor_plan": self.floor_plan, "height_m": self.height, "cell_m": self.cell}
        return {name: value for name, value in named.items() if value is not None}


def check_effects(command: Any, owners: Mapping[str, Sequence[str]], given: Sequence[str], words: str) -> None:
    """Raises a `UserError` for an option that was given without effect.

    Args:
        command: the command line.
        owners: what options belong to, such as quantities or kinds of input; any one suffices.
        given: which of these the command line has.
        words: the same for the message.
    """
    for name, own in owners.items():
        if getattr(command, name) != getattr(type(command), name) and not set(own) & set(given):
            raise UserError(f"--{name.replace('_', '-')} has no effect on {words}; it belongs to {' or '.join(own)}")


def check_suffixes(command: Any, suffixes: Mapping[str, Sequence[str]]) -> None:
    """Raises a `UserError` if the name of an output file has none of the suffixes that its option allows."""
    for name, allowed in suffixes.items():
        path = getattr(command, name)
        if path is not None and path.suffix not in allowed:
            raise UserError(f"--{name} {path} does not end in {' or '.join(allowed)}; rename it")


def parse_frequencies(ghz: Iterable[float], source: str = "--ghz") -> Float[np.ndarray, " freq"]:
    """Returns hertz; frequencies outside the band of all fields are a `UserError` whose message starts with `source`."""
    from wbgs_jax.types import LOWEST_OF_PATHS_HZ, MAX_FREQUENCY_HZ

    ghz = tuple(ghz)
    low, high = LOWEST_OF_PATHS_HZ / 1e9, MAX_FREQUENCY_HZ / 1e9
    if wrong := [f for f in ghz if not low <= f <= high]:
        raise UserError(f"{source} {wrong[0]:g} is outside the model's {low:g} to {high:g} GHz; give gigahertz in that range")
    return np.array(ghz) * 1e9


def parse_receiver(word: str, dataset: "Dataset") -> "Receiver":
    """Returns a receiver of the data by its index (the first if `word` is empty), or one at "x,y,z" or "x,y,z,w,i,j,k" that
    otherwise equals the first; anything else is a `UserError`."""
    import jax.numpy as jnp

    from wbgs_jax.types import LARGEST_COORDINATE_M

    if not word or (word.isdecimal() and len(word) < 7):
        return dataset.receiver(int(word or 0))
    like = dataset.receiver()
    values = parse_numbers(word)
    turn = values[3:] if len(values) > 3 else np.asarray(like.orientation)
    shortest = 1e-3  # minimum length of a quaternion; the maximum is its inverse, others are mistakes
    rotated = shortest < np.linalg.norm(turn) < 1 / shortest
    if len(values) not in (3, 7) or not (np.abs(values) <= LARGEST_COORDINATE_M).all() or not rotated:
        raise UserError(
            f"--rx {word[:60]} is not a receiver; give its index, x,y,z in metres, or x,y,z,w,i,j,k with a quaternion"
        )
    unit = np.asarray(turn / np.linalg.norm(turn), np.float32)
    return dataclasses.replace(like, position=jnp.asarray(values[:3], jnp.float32), orientation=jnp.asarray(unit))


def load_field(run: Path, rx: str, lowest_hz: float | None = None, options: "Options | None" = None) -> "LoadedField":
    """Returns the trained field of a run folder at a receiver.

    Args:
        run: the run folder.
        rx: the receiver, as on the command line (`parse_receiver`).
        lowest_hz: the lowest frequency of the queries, if available.
        options: options of some quantities.

    Raises:
        UserError: the run cannot be read, or the field cannot be queried at this receiver or frequency.
    """
    from wbgs_jax.inference.evaluate_quantities import LoadedField
    from wbgs_jax.inference.quantities import Options
    from wbgs_jax.inference.trained_field import at_receiver
    from wbgs_jax.training.run_folder import open_run

    trained = open_run(run)
    dataset = trained.dataset()
    receiver = parse_receiver(rx, dataset)
    loaded = LoadedField(at_receiver(trained, receiver, dataset), dataset, receiver, options or Options())
    if lowest_hz is not None:
        _check_frequency(loaded, lowest_hz)
    return loaded


def _check_frequency(loaded: "LoadedField", lowest_hz: float) -> None:
    from wbgs_jax.fields import field_names, get_field
    from wbgs_jax.inference.domain import ROUNDED
    from wbgs_jax.inference.evaluate_quantities import lowest_frequency

    field = loaded.trained.field
    if lowest_hz < (lowest := lowest_frequency(field, loaded.dataset)) * (1 - ROUNDED):
        able = " or ".join(name for name in field_names() if "paths" in get_field(name).outputs)
        raise UserError(
            f"the {field.name} field of this run can be queried from {lowest / 1e9:g} GHz upwards, not at "
            f"{lowest_hz / 1e9:g} GHz; only fields with paths extend below: train --field {able} on data with a mesh"
        )


def warn(
    domain: "Domain",
    rx: Any,
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
    most: int = SHOWN,
) -> None:
    """Prints at most `most` warnings about unreliable predictions."""
    lines = domain.warnings(np.asarray(rx), tx_positions, frequencies_hz)
    for line in lines[:most]:
        say(f"warning: {line}")
    if len(lines) > most:
        say(f"warning: and {len(lines) - most} more of this kind")


def warn_of_intervals(missing: Bool[np.ndarray, "*n"]) -> None:
    """Prints one warning if some predictions have no valid prediction interval."""
    if missing.any():
        few = f"{missing.sum()} of {missing.size} predictions have" if missing.size > 1 else "the prediction has"
        say(f"warning: {few} no prediction interval; the interval is NaN in files")
