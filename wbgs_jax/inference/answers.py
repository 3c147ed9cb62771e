"""What the commands share that ask a trained field: where and at which frequencies, what is doubtful there, and files."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import wbgs_jax
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.places import closed_bodies
from wbgs_jax.data.surface import DatasetScene
from wbgs_jax.fields import field_names, get_field
from wbgs_jax.inference.bounds import ROUNDED, Bounds, frequencies, link_words, point_words
from wbgs_jax.inference.predictor import Trained, trained_band
from wbgs_jax.types import LARGEST_COORDINATE_M, LOWEST_OF_PATHS_HZ, MIN_FREQUENCY_HZ, Receiver

__all__ = [
    "bounds_of",
    "check_frequencies",
    "doubts",
    "frequencies",
    "link_words",
    "point_words",
    "receiver_at",
    "source_of",
    "write_answer",
]

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
    if "paths" in trained.field.known():
        return LOWEST_OF_PATHS_HZ
    return min(MIN_FREQUENCY_HZ, trained_band(dataset)[0])


def check_frequencies(trained: Trained, dataset: Dataset, lowest_hz: float) -> None:
    """Raises a `UserError` where a field is asked below what it answers."""
    if lowest_hz < (lowest := lowest_answered(trained, dataset)) * (1 - ROUNDED):
        able = " or ".join(name for name in field_names() if "paths" in get_field(name).gives)
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
