"""How well a map says what was measured where it was not told: whole rooms held out, and squares of one metre; beside rivals
that know no walls.

Scored is the mean absolute error of the means of small cells, and how many of them lie within the 90 % intervals. Such a mean
has an error of its own: fading over the square root of its readings.
"""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from wbgs_jax.measured.floor_plan import NO_WALLS, Walls
from wbgs_jax.measured.power_map import APART, LENGTH, NEAREST, Scales, learn_map, received_power
from wbgs_jax.measured.readings import Readings

BLOCK = 1.0
"""Metres."""
FEWEST = 10
"""Cells of a room that is held out, and of what is left."""
NINETY = 1.6449
"""Standard deviations to each side that hold 90 % of a normal distribution."""
Rival = Callable[[Readings, Readings], Float[np.ndarray, "n r"]]


@dataclass(frozen=True)
class Score:
    """Of one way of holding out."""

    held_out: str
    means: int
    """Of cells, at all receivers, that were scored."""
    error_db: float
    """Mean absolute error of the map ..."""
    within: float
    """... and the share of means in its 90 % intervals."""
    rivals_db: dict[str, float]
    """Mean absolute errors of the others."""


def scores(cells: Readings, walls: Walls) -> list[Score]:
    """Returns the scores of a map with walls, a room at a time and then all blocks, and those of its rivals."""
    rooms = [room for room in dict.fromkeys(cells.rooms) if room]
    splits = [(f"room {room}", [np.array(cells.rooms) == room]) for room in rooms]
    splits = [(name, parts) for name, parts in splits if FEWEST <= parts[0].sum() <= len(cells.places) - FEWEST]
    return [_score(name, parts, cells, walls) for name, parts in [*splits, (f"blocks of {BLOCK:g} m", list(blocks(cells)))]]


def blocks(cells: Readings) -> Iterator[Bool[np.ndarray, " n"]]:
    """Gives the cells of every square of the plan."""
    _, block = np.unique(np.floor(cells.places[:, :2] / BLOCK).astype(int), axis=0, return_inverse=True)
    for number in range(block.max() + 1):
        yield block.reshape(-1) == number


def _score(name: str, parts: list[Bool[np.ndarray, " n"]], cells: Readings, walls: Walls) -> Score:
    """Returns the scores over all parts, each held out in turn. Scales are learned once, from what the largest part leaves."""
    truth, said, spread = cells.powers, *(np.full(cells.powers.shape, np.nan) for _ in range(2))
    others = {rival: np.full(truth.shape, np.nan) for rival in RIVALS}
    scales: Scales | None = None
    for part in sorted(parts, key=np.sum, reverse=True):
        known, asked = cells.at(~part), cells.at(part)
        # Shapes stay as they are, for the sake of one compilation.
        learned = learn_map(dataclasses.replace(cells, powers=np.where(part[:, None], np.nan, truth)), walls, scales)
        scales = Scales(*(float(x) for x in learned.scales))
        mean, std = (np.asarray(a, float)[part] for a in _received(learned, jnp.asarray(cells.places, jnp.float32)))
        own = scales.place**2 + scales.reading**2 / np.maximum(asked.counts, 1)
        said[part], spread[part] = mean, np.sqrt(std**2 + own)
        for rival, ask in RIVALS.items():
            others[rival][part] = ask(known, asked)
    scored = np.isfinite(truth) & np.any(parts, 0)[:, None]
    off = np.abs(said - truth)[scored]
    errors = {rival: float(np.abs(answer - truth)[scored].mean()) for rival, answer in others.items()}
    return Score(name, int(scored.sum()), float(off.mean()), float((off <= NINETY * spread[scored]).mean()), errors)


_received = jax.jit(received_power)


def log_distance(known: Readings, asked: Readings) -> Float[np.ndarray, "n r"]:
    """Returns what one law of the distance for all receivers says (least squares)."""

    def features(readings: Readings) -> np.ndarray:
        distance = np.linalg.norm(readings.places[:, None] - readings.receivers, axis=-1)
        return np.stack([np.ones_like(distance), -10 * np.log10(np.maximum(distance, NEAREST))], -1)

    heard = np.isfinite(known.powers)
    law, *_ = np.linalg.lstsq(features(known)[heard], known.powers[heard], rcond=None)
    return features(asked) @ law


def inverse_distance(known: Readings, asked: Readings) -> Float[np.ndarray, "n r"]:
    """Returns the mean of what each receiver heard, weighted by 1 / distance^2 to the places (Shepard 1968)."""
    square = np.sum((asked.places[:, None] - known.places) ** 2, -1)
    weights = 1 / np.maximum(square, NEAREST**2)
    heard = np.isfinite(known.powers).astype(float)
    return (weights @ np.nan_to_num(known.powers)) / np.maximum(weights @ heard, 1e-12)


def kriging(known: Readings, asked: Readings) -> Float[np.ndarray, "n r"]:
    """Returns what a Gaussian process of every receiver by itself says, around what it heard on average."""
    average = np.nanmean(known.powers, 0)
    places = np.concatenate([known.places, asked.places])
    distance = np.linalg.norm(places[:, None] - known.places, axis=-1)
    scales, answer = Scales(), np.zeros((len(asked.places), len(average)))
    k = APART**2 * np.exp(-distance / LENGTH)
    for r, mean in enumerate(average):
        own = np.flatnonzero(np.isfinite(known.powers[:, r]))
        noise = np.diag(scales.place**2 + scales.reading**2 / known.counts[own, r])
        weights = np.linalg.solve(k[np.ix_(own, own)] + noise, known.powers[own, r] - mean)
        answer[:, r] = mean + k[len(known.places) :, own] @ weights
    return answer


def without_walls(known: Readings, asked: Readings) -> Float[np.ndarray, "n r"]:
    """Returns what the same map says that was not told of any wall."""
    return np.asarray(_received(learn_map(known, NO_WALLS, Scales()), jnp.asarray(asked.places, jnp.float32))[0], float)


RIVALS: dict[str, Rival] = {
    "log-distance": log_distance,
    "inverse distance": inverse_distance,
    "kriging": kriging,
    "without walls": without_walls,
}
