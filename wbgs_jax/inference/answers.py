"""What the commands share that ask a trained field: where and at which frequencies, what is doubtful there, and files.

A run folder opened for one question: by what an earlier command left ready where that will do, else by reading the run.

Where a trained field was trained, what is doubtful elsewhere, and how lines name links.
"""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

import wbgs_jax
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.scene import DatasetScene, closed_bodies
from wbgs_jax.fields import field_names, get_field
from wbgs_jax.fields.base import outputs_of
from wbgs_jax.inference.predictor import Trained, trained_band
from wbgs_jax.inference.queries import Product, Queries
from wbgs_jax.inference.ready import MOST, QUANTITIES, Ready, load_ready, make_ready
from wbgs_jax.mesh.solids import ClosedBody, inside
from wbgs_jax.types import LARGEST_COORDINATE_M, LOWEST_OF_PATHS_HZ, MAX_FREQUENCY_HZ, MIN_FREQUENCY_HZ, Receiver

CONFIDENCES = ("expected", "expected_error_db", "within_db")
"""Arrays of answers that record how sure they are."""
NEAR = 1e-3
"""Metres outside of a box that are none."""
ROUNDED = 1e-6
"""By what share a frequency that is asked for in gigahertz may miss that of the data."""


class Bounds(NamedTuple):
    """What a field knows by training."""

    name: str
    """Of the data."""
    box: Float[np.ndarray, "2 3"]
    """Lowest and highest corner, metres."""
    band: tuple[float, float]
    """Hertz."""
    beyond: float = 0.0
    """How far (metres) outside of the box answers still have a confidence: nothing where surfaces close it."""
    bodies: tuple[ClosedBody, ...] = ()
    """In which no antenna can stand."""

    def as_json(self) -> list[Any]:
        """Returns what `Bounds.from_json` reads."""
        bodies = [[body.name, np.round(body.triangles, 5).tolist()] for body in self.bodies]
        return [self.name, np.asarray(self.box).tolist(), list(self.band), self.beyond, bodies]

    @classmethod
    def from_json(cls, values: list[Any]) -> "Bounds":
        """Returns what `as_json` gave."""
        name, box, (low, high), beyond, bodies = values
        solids = tuple(ClosedBody(own, np.array(triangles)) for own, triangles in bodies)
        return cls(name, np.array(box), (low, high), beyond, solids)

    def without_confidence(self, positions: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Returns at which places nobody knows how sure an answer is: in a body, or outside of what was trained."""
        low, high = self.box
        away = np.linalg.norm(np.maximum(np.maximum(low - positions, positions - high), 0), axis=-1)
        result = away > self.beyond + NEAR
        for body in self.bodies:
            result |= inside(body, np.asarray(positions, np.float64))
        return result

    def doubts(
        self, rx: Float[np.ndarray, "3"], tx_positions: Float[np.ndarray, "tx 3"], frequencies_hz: Float[np.ndarray, " freq"]
    ) -> list[str]:
        """Returns why some of the answers should not be trusted: one line each."""
        (low, high), band = self.box, self.band
        box = f"the box of {self.name}, {point_words(low)} to {point_words(high)}"
        places = [("RX", rx), *(("TX", tx) for tx in tx_positions)]
        lines = [
            f"{end} {point_words(place)} lies outside {box}; the field was not trained there"
            for end, place in places
            if ((place < low) | (place > high)).any()
        ]
        points = np.array([place for _, place in places], np.float64)
        within = [inside(body, points) for body in self.bodies]
        lines += [
            f"{end} {point_words(place)} is inside a closed body ({body.name} of {self.name}), where no antenna can stand"
            for number, (end, place) in enumerate(places)
            for body, there in zip(self.bodies, within, strict=True)
            if there[number]
        ]
        for f in frequencies_hz:
            if band[0] * (1 - ROUNDED) <= f <= band[1] * (1 + ROUNDED):
                continue
            if f < MIN_FREQUENCY_HZ:
                lines.append(
                    f"{f / 1e9:g} GHz lies below {MIN_FREQUENCY_HZ / 1e9:g} GHz: rays stand for short waves, and describe "
                    "badly what is not many wavelengths large"
                )
            else:
                trained = f"the trained {band[0] / 1e9:g} to {band[1] / 1e9:g} GHz"
                lines.append(f"{f / 1e9:g} GHz lies outside {trained}; the field was not trained there")
        return lines


def point_words(position: Float[np.ndarray, "3"]) -> str:
    """Returns "(x, y, z) m"."""
    return "({:.6g}, {:.6g}, {:.6g}) m".format(*position)


def link_words(tx_position: Float[np.ndarray, "3"], frequency_hz: float) -> str:
    """Returns how a line names a link."""
    return f"TX {point_words(tx_position)} at {frequency_hz / 1e9:g} GHz"


def frequencies(ghz: tuple[float, ...], source: str = "--ghz") -> Float[np.ndarray, " freq"]:
    """Returns hertz; what no field answers is a `UserError` that names where it was read."""
    low, high = LOWEST_OF_PATHS_HZ / 1e9, MAX_FREQUENCY_HZ / 1e9
    if wrong := [f for f in ghz if not low <= f <= high]:
        raise UserError(f"{source} {wrong[0]:g} is outside the model's {low:g} to {high:g} GHz; give gigahertz in that range")
    return np.array(ghz) * 1e9


SHORTEST = 1e-3
"""Of quaternions that are taken."""


def receiver_at(word: str, dataset: Dataset) -> Receiver:
    """Returns a receiver of the data by its number (none: the first), or another one from "x,y,z" or "x,y,z,w,i,j,k", otherwise
    like the first; anything else is a `UserError`."""
    if not word or (word.isdecimal() and len(word) < 7):
        return dataset.receiver(int(word or 0))
    like = dataset.receiver()
    try:
        values = np.array([float(part) for part in word.split(",")])
    except ValueError:
        values = np.zeros(0)
    turn = values[3:] if len(values) > 3 else np.asarray(like.orientation)
    turned = SHORTEST < np.linalg.norm(turn) < 1 / SHORTEST
    if len(values) not in (3, 7) or not (np.abs(values) <= LARGEST_COORDINATE_M).all() or not turned:
        raise UserError(f"--rx {word[:60]} is no receiver; give a number, x,y,z in metres, or x,y,z,w,i,j,k with a quaternion")
    unit = np.asarray(turn / np.linalg.norm(turn), np.float32)
    return dataclasses.replace(like, position=jnp.asarray(values[:3], jnp.float32), orientation=jnp.asarray(unit))


def lowest_answered(trained: Trained, dataset: Dataset) -> float:
    """Returns the lowest frequency (hertz) at which a field can be asked: that of the model's band, or of its training; paths
    hold below, too."""
    if "paths" in outputs_of(trained.field):
        return LOWEST_OF_PATHS_HZ
    return min(MIN_FREQUENCY_HZ, trained_band(dataset)[0])


def check_frequencies(trained: Trained, dataset: Dataset, lowest_hz: float) -> None:
    """Raises a `UserError` where a field is asked below what it answers."""
    if lowest_hz < (lowest := lowest_answered(trained, dataset)) * (1 - ROUNDED):
        able = " or ".join(name for name in field_names() if "paths" in get_field(name).outputs)
        raise UserError(
            f"the {trained.field.name} field of this run answers from {lowest / 1e9:g} GHz on, not at "
            f"{lowest_hz / 1e9:g} GHz; below, only fields with paths do: train --field {able} on data with a mesh"
        )


def bounds_of(dataset: Dataset) -> Bounds:
    """Returns where a field knows something by training."""
    box = np.asarray(DatasetScene(dataset).box, np.float64)
    beyond = 0.0 if len(dataset.faces) else 0.5 * float(np.linalg.norm(box[1] - box[0]))
    return Bounds(dataset.name, box, trained_band(dataset), beyond, closed_bodies(dataset))


def doubts(
    dataset: Dataset,
    rx: Float[np.ndarray, "3"],
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
) -> list[str]:
    """Returns why some of the answers should not be trusted: one line each."""
    return bounds_of(dataset).doubts(rx, tx_positions, frequencies_hz)


def write_answer(path: Path, arrays: dict[str, Any], source: dict[str, Any]) -> None:
    """Writes the answer's arrays that are known, and where they come from as JSON text in `meta`."""
    known = {name: value for name, value in arrays.items() if value is not None}
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **known, meta=np.array(json.dumps(source)))


def source_of(trained: Trained, dataset: Dataset, receiver: Receiver) -> dict[str, Any]:
    """Returns where an answer comes from: scene, field, step, version, and the receiver that was asked; and the chance that
    true values lie in the intervals beside it, where there are any."""
    asked = {name: np.asarray(getattr(receiver, name)).tolist() for name in ("position", "orientation")}
    origin = {name: value for name, value in trained.origin().items() if name in ("field", "step")}
    learned = {"interval_level": trained.confidence, "power_interval_level": trained.power_confidence}
    levels = {name: round(float(own.level), 4) for name, own in learned.items() if own is not None}
    return {"scene": dataset.name, "version": wbgs_jax.__version__, "receiver": asked} | origin | levels


class Options(NamedTuple):
    """Of some quantities alone."""

    tx_velocity: Float[np.ndarray, "3"]
    """Metres a second."""
    rx_velocity: Float[np.ndarray, "3"]
    band_hz: float
    """Of frequency responses."""
    points: int
    """Frequencies in the band."""
    tx_array: tuple[int, int]
    """Rows and columns of a MIMO matrix's transmitters."""


class Opened(NamedTuple):
    """Who answers, and what lines and files say of it."""

    answer: Callable[[list[Product]], dict[str, np.ndarray]]
    """Answers a block of queries (`evaluate_quantities.answer_block`)."""
    bounds: Bounds
    source: dict[str, Any]
    """Scene, field, step, version and receiver (`answers.source_of`)."""


def open_field(
    run: Path,
    rx: str,
    what: str,
    queries: Queries,
    lowest_hz: float,
    options: Options,
    load: Callable[[], tuple[Any, list[Path]]],
) -> Opened:
    """Returns who answers queries. The first command that asks a little leaves the field ready for those that follow.

    Args:
        run: the folder.
        rx: names the receiver (`answers.receiver_at`).
        what: is asked.
        queries: all of them.
        lowest_hz: the lowest frequency among them.
        options: of some quantities.
        load: reads the run: a trained field, and the files and folders that it follows from.

    Raises:
        UserError: the run cannot be read, or knows nothing of what is asked.
    """
    few = len(queries) <= MOST and what in QUANTITIES
    if few and (ready := load_ready(run, rx, len(queries))) and _knows(ready, what, lowest_hz):
        return _opened_ready(ready, what, queries)
    return _opened_run(run, rx, what, queries, lowest_hz, options, load, few)


def _knows(ready: Ready, what: str, lowest_hz: float) -> bool:
    return what in ready.meta["what"] and lowest_hz >= ready.meta["lowest_hz"]


def _opened_ready(ready: Ready, what: str, queries: Queries) -> Opened:
    bounds = Bounds.from_json(ready.meta["bounds"])
    positions, frequencies_hz = queries.flat()
    answer = _masked(ready(what, positions, frequencies_hz), bounds, positions)
    return Opened(lambda block: answer, bounds, ready.meta["source"])


def _masked(answer: dict[str, np.ndarray], bounds: Bounds, positions: Float[np.ndarray, "n 3"]) -> dict[str, np.ndarray]:
    """Returns an answer without confidence where there is none (NaN)."""
    if not set(CONFIDENCES) & set(answer):
        return answer
    nowhere = bounds.without_confidence(positions)
    return {
        name: np.where(nowhere.reshape(-1, *[1] * (values.ndim - 1)), np.nan, values).astype(values.dtype)
        if name in CONFIDENCES
        else values
        for name, values in answer.items()
    }


def _opened_run(
    run: Path, rx: str, what: str, queries: Queries, lowest_hz: float, options: Options, load: Callable[[], Any], few: bool
) -> Opened:
    # Here: what was left ready needs nothing of all this, and it takes seconds to load.
    from wbgs_jax.inference import evaluate_quantities
    from wbgs_jax.inference.predictor import at_receiver
    from wbgs_jax.inference.quantities import check_known, known_quantities

    trained, watched = load()
    dataset = trained.dataset()
    receiver = receiver_at(rx, dataset)
    trained = at_receiver(trained, receiver, dataset)
    check_frequencies(trained, dataset, lowest_hz)
    check_known(what, trained, dataset)
    bounds, source = bounds_of(dataset), source_of(trained, dataset, receiver)
    if few:
        meta = {
            "source": source,
            "bounds": bounds.as_json(),
            "what": known_quantities(trained, dataset),
            "lowest_hz": lowest_answered(trained, dataset),
        }
        if ready := make_ready(run, rx, len(queries), trained, receiver, watched, meta):
            return _opened_ready(ready, what, queries)

    def answer(block: list[Product]) -> dict[str, np.ndarray]:
        found = evaluate_quantities.answer_block(what, trained, dataset, receiver, options, block)
        rows = np.concatenate([product.rows for product in block])
        positions = np.concatenate([np.repeat(one.tx_positions, len(one.frequencies_hz), axis=0) for one in block])
        return _masked(found, bounds, positions[np.argsort(rows)])

    return Opened(answer, bounds, source)
