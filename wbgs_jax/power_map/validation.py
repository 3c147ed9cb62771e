"""How well a map says what was measured where nothing was known: whole rooms held out, and squares of one metre; beside
rivals, most of which know no walls.

Scored is the mean absolute error of the means of small cells, and how many of them lie within the 90 % intervals. Such a mean
has an error of its own: fading over the square root of its readings.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.floor_plan import NO_WALLS, Walls
from wbgs_jax.data.rssi_folder import Readings
from wbgs_jax.power_map.model import APART, MIN_POWERS, NEAREST, Scales, alike, distances, learn_map, noise, received_power

BLOCK, FOLDS = 1.0, 40
"""Metres: squares that are held out; and how often at most, several of them together."""
NINETY = 1.6449
"""Standard deviations to each side that hold 90 % of a normal distribution."""
Parts = list[Bool[np.ndarray, " n"]]
Rival = Callable[[Readings], Float[np.ndarray, "n r"]]


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
    """Returns the scores of a map with walls, a room at a time and then squares of one metre, and those of its rivals.

    Raises:
        UserError: all powers are from one square metre, so that nothing can be held out.
    """
    rooms = [room for room in dict.fromkeys(cells.rooms) if room]
    splits = [(f"room {room}", [np.array([own == room for own in cells.rooms])]) for room in rooms]
    splits.append((f"squares of {BLOCK:g} m", folds(cells)))
    usable = [(name, told) for name, parts in splits if (told := _usable(parts, cells))]
    if not usable:
        raise UserError(f"all powers lie within {BLOCK:g} m: nothing can be held out")
    return [_score(name, parts, cells, walls) for name, parts in usable]


def folds(cells: Readings) -> Parts:
    """Returns the cells of every square of the plan; of many squares, those of several that are drawn together."""
    _, square = np.unique(np.floor(cells.places[:, :2] / BLOCK).astype(int), axis=0, return_inverse=True)
    fold = np.random.default_rng(0).permutation(square.max() + 1)[square.reshape(-1)] % FOLDS
    return [fold == number for number in np.unique(fold)]


def _usable(parts: Parts, cells: Readings) -> Parts:
    """Returns the parts in which something was heard; none of them, if one leaves too little to learn from."""
    heard = np.isfinite(cells.powers)
    told = [part for part in parts if heard[part].any()]
    return told if all(heard[~part].sum() >= MIN_POWERS for part in told) else []


def _score(name: str, parts: Parts, cells: Readings, walls: Walls) -> Score:
    mean, spread = _mapped(parts, cells, walls)
    answers = {"without walls": _mapped(parts, cells, NO_WALLS)[0]}
    for rival, ask in RIVALS.items():
        answers[rival] = np.full(mean.shape, np.nan)
        for part in parts:
            answers[rival][part] = ask(cells.without(part))[part]
    scored = np.isfinite(cells.powers) & np.any(parts, 0)[:, None]
    off = {rival: np.abs(said - cells.powers)[scored] for rival, said in (("map", mean), *answers.items())}
    errors = {rival: float(error.mean()) for rival, error in off.items()}
    within = float((off["map"] <= NINETY * spread[scored]).mean())
    return Score(name, int(scored.sum()), errors.pop("map"), within, errors)


def _mapped(parts: Parts, cells: Readings, walls: Walls) -> tuple[Float[np.ndarray, "n r"], Float[np.ndarray, "n r"]]:
    """Returns what maps say of each part that knew nothing of it, and the standard deviations of its means around that. Scales
    are learned once, from what the largest part leaves."""
    scales: Scales | None = None
    mean, spread = (np.full(cells.powers.shape, np.nan) for _ in range(2))
    places = jnp.asarray(cells.places, jnp.float32)
    for part in sorted(parts, key=np.sum, reverse=True):
        learned = learn_map(cells.without(part), walls, scales)  # shapes stay as they are, for the sake of one compilation
        scales = Scales(*(float(x) for x in learned.scales))
        said, std = (np.asarray(a, float) for a in _received(learned, places))
        mean[part], spread[part] = said[part], np.sqrt(std**2 + noise(scales, np.maximum(cells.counts, 1)))[part]
    return mean, spread


_received = jax.jit(received_power)


def log_distance(known: Readings) -> Float[np.ndarray, "n r"]:
    """Returns what one law of the distance for all receivers says of all places (least squares)."""
    distance = distances(known.places, known.receivers)
    features = np.stack([np.ones_like(distance), -10 * np.log10(np.maximum(distance, NEAREST))], -1)
    heard = np.isfinite(known.powers)
    law, *_ = np.linalg.lstsq(features[heard], known.powers[heard], rcond=None)
    return features @ law


def inverse_distance(known: Readings) -> Float[np.ndarray, "n r"]:
    """Returns the mean of what each receiver heard, weighted by 1 / distance^2 to the places (Shepard 1968)."""
    weights = 1 / np.maximum(distances(known.places, known.places), NEAREST) ** 2
    total = weights @ np.isfinite(known.powers)
    return np.where(total > 0, weights @ np.nan_to_num(known.powers) / np.where(total > 0, total, 1), np.nanmean(known.powers))


def kriging(known: Readings) -> Float[np.ndarray, "n r"]:
    """Returns what a Gaussian process of every receiver by itself says, around what it heard on average."""
    scales, answer = Scales(), np.full(known.powers.shape, np.nanmean(known.powers))
    k = APART**2 * alike(known.places, known.places)
    for r, heard in enumerate(np.isfinite(known.powers).T):
        own = np.flatnonzero(heard)
        if len(own):
            powers, covariance = known.powers[own, r], k[np.ix_(own, own)] + np.diag(noise(scales, known.counts[own, r]))
            answer[:, r] = powers.mean() + k[:, own] @ np.linalg.solve(covariance, powers - powers.mean())
    return answer


RIVALS: dict[str, Rival] = {"log-distance": log_distance, "inverse distance": inverse_distance, "kriging": kriging}
COMPARED = (*RIVALS, "without walls")
"""Names of all rivals."""
