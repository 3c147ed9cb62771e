"""Validation of a map on held-out measurements: whole rooms and squares of one metre, compared with baselines, which ignore
walls.

A floor plan has controls: the same plan turned and mirrored about its middle, and none. Only if its map is better than all of
them has it been shown that the plan itself helps, and not merely some walls.

Scores are the mean absolute error of the means of small cells, and the fraction of these within the 90 % intervals. The means
have an error of their own: fading divided by the square root of the number of readings.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.progress_lines import CountProgress
from wbgs_jax._util.statistics import standard_error
from wbgs_jax.data.floor_plan import NO_WALLS, Walls, crossings
from wbgs_jax.data.rssi_folder import Readings
from wbgs_jax.power_map.model import (
    APART,
    MIN_POWERS,
    NEAREST,
    Scales,
    alike,
    covariance_of_powers,
    distances,
    find_ceilings,
    fit_law,
    in_one_room,
    law_features,
    learn_scales,
    noise,
    residuals,
)

BLOCK, FOLDS = 1.0, 40
"""Side of the held-out squares, metres; and the maximum number of folds, into which several squares are combined."""
ROOMS = 10
"""Maximum number of rooms that are held out one at a time; more are combined into as many groups of whole rooms."""
NINETY = 1.6449
"""Half width of the 90 % interval of a normal distribution, in standard deviations."""
Parts = list[Bool[np.ndarray, " n"]]
Rival = Callable[[Readings], Float[np.ndarray, "n r"]]


@dataclass(frozen=True)
class Score:
    """Scores for one way of holding out measurements."""

    held_out: str
    means: int
    """Number of cell means that were scored, over all receivers."""
    error_db: float
    """Mean absolute error of the map ..."""
    within: float
    """... and the fraction of means within its 90 % intervals."""
    rivals_db: dict[str, float]
    """Mean absolute errors of the baselines."""
    controls_db: dict[str, float]
    """Mean absolute errors with the floor plan turned and mirrored; empty without one."""
    plan_helps: bool | None
    """Whether the plan is better than all controls and than none, by more than two standard errors; None without a plan, and
    for one that is the same turned and mirrored."""


def scores(cells: Readings, walls: Walls) -> list[Score]:
    """Returns the scores of a map with walls and of its baselines, holding out one room at a time (one group of rooms, if there
    are more than `ROOMS`) and then squares of one metre. Parts without which too little remains to learn from are not scored.

    Raises:
        UserError: all powers are from one square metre, or too few, so that nothing can be held out.
    """
    splits = [*_rooms(cells), (f"squares of {BLOCK:g} m", folds(cells))]
    usable = [(name, scored) for name, parts in splits if (scored := _usable(parts, cells))]
    received = np.isfinite(cells.powers)
    if not usable and len(np.unique(squares(cells)[received.any(1)])) == 1:
        raise UserError(f"all powers lie within {BLOCK:g} m, so nothing can be held out")
    if not usable:
        raise UserError(f"{received.sum()} mean powers are too few for holding any out: at least {MIN_POWERS} must remain")
    with CountProgress("held out", len(usable)) as progress:
        found = []
        for name, parts in usable:
            found.append(_score(name, parts, cells, walls))
            progress.advance()
    return found


def _rooms(cells: Readings) -> list[tuple[str, Parts]]:
    """Returns the rooms by name as parts to hold out, or groups of them, of one name together."""
    names = [room for room in dict.fromkeys(cells.rooms) if room]
    rooms = [np.array([own == name for own in cells.rooms]) for name in names]
    if len(rooms) <= ROOMS:
        return [(f"room {name}", [room]) for name, room in zip(names, rooms, strict=True)]
    return [(f"{len(rooms)} rooms in {ROOMS} groups", [np.any(rooms[first::ROOMS], 0) for first in range(ROOMS)])]


def folds(cells: Readings) -> Parts:
    """Returns masks of the cells of every square of the plan; if there are many squares, of random groups of them."""
    square = squares(cells)
    fold = np.random.default_rng(0).permutation(square.max() + 1)[square] % FOLDS
    return [fold == number for number in np.unique(fold)]


def squares(cells: Readings) -> Int[np.ndarray, " n"]:
    """Returns the number of the square of the plan that each cell lies in."""
    _, square = np.unique(np.floor(cells.places[:, :2] / BLOCK).astype(int), axis=0, return_inverse=True)
    return square.reshape(-1)


def _usable(parts: Parts, cells: Readings) -> Parts:
    """Returns the parts in which something was received, and without which enough remains to learn from."""
    received = np.isfinite(cells.powers)
    return [part for part in parts if received[part].any() and received[~part].sum() >= MIN_POWERS]


def _score(name: str, parts: Parts, cells: Readings, walls: Walls) -> Score:
    mean, spread = _mapped(parts, cells, walls)
    predictions = {"without walls": _mapped(parts, cells, NO_WALLS)[0]}
    for rival, predict in RIVALS.items():
        predictions[rival] = np.full(mean.shape, np.nan)
        for part in parts:
            predictions[rival][part] = predict(cells.without(part))[part]
    changed = wrong_plans(cells, walls)
    predictions |= {control: _mapped(parts, cells, other)[0] for control, other in changed.items()}
    scored = np.isfinite(cells.powers) & np.any(parts, 0)[:, None]
    off = {rival: np.abs(powers - cells.powers)[scored] for rival, powers in (("map", mean), *predictions.items())}
    errors = {rival: float(error.mean()) for rival, error in off.items()}
    within = float((off["map"] <= NINETY * spread[scored]).mean())
    square = np.broadcast_to(squares(cells)[:, None], scored.shape)[scored]
    others = [off[control] - off["map"] for control in ("without walls", *changed)]
    helps = all(_surely_positive(gain, square) for gain in others) if changed else None
    controls = {control: errors.pop(control) for control in changed}
    return Score(name, int(scored.sum()), errors.pop("map"), within, errors, controls, helps)


def _surely_positive(gains: Float[np.ndarray, " n"], square: Int[np.ndarray, " n"]) -> bool:
    """Returns whether the mean gain over squares is significantly positive."""
    gain, error = standard_error(gains, square)
    n_sigma = 2.0  # standard errors over squares by which a floor plan must be better than its controls
    return gain > n_sigma * error


def wrong_plans(cells: Readings, walls: Walls) -> dict[str, Walls]:
    """Returns the floor plan turned by 180 degrees and mirrored about the middle of the building, by name, as far as that puts
    other walls between readings and receivers; none without walls."""
    if not len(walls.ends):
        return {}
    ends = np.asarray(walls.ends, float)
    points = np.concatenate([ends.reshape(-1, 2), cells.places[:, :2], cells.receivers[:, :2]])
    middle = (points.min(0) + points.max(0)) / 2
    plans = {name: dataclasses.replace(walls, ends=middle + signs * (ends - middle)) for name, signs in SIGNS.items()}
    between = [crossings(plan, cells.places[:, None, :2], cells.receivers[None, :, :2]) for plan in (walls, *plans.values())]
    return {
        name: plan for (name, plan), own in zip(plans.items(), between[1:], strict=True) if not np.allclose(own, between[0])
    }


SIGNS = {"plan turned": np.array([-1, -1]), "plan mirrored in x": np.array([-1, 1]), "plan mirrored in y": np.array([1, -1])}
"""Factors on coordinates relative to the middle that make a floor plan wrong, by name."""


def _mapped(parts: Parts, cells: Readings, walls: Walls) -> tuple[Float[np.ndarray, "n r"], Float[np.ndarray, "n r"]]:
    """Returns the predictions for each part by maps learned without it, and the standard deviations of the cell means around
    these. Scales are learned only once, without the largest part.

    A Gaussian process without some of its data needs no solution of its own: with Q the inverse covariance of all powers, those
    of a part follow from all others with covariance (Q_part)^-1 and deviate from them by (Q_part)^-1 (Q powers)_part (Rasmussen
    and Williams 2006, section 5.4.2, for single values).
    """
    features = law_features(cells.places, cells.receivers, walls, find_ceilings(cells.places[:, 2]))
    crossed, received = -features[..., 2:4], np.isfinite(cells.powers)
    root_walls, shared = crossed[..., 0], in_one_room(crossed, crossed)
    largest = cells.without(max(parts, key=np.sum))
    law, _ = fit_law(largest, features)
    scales = learn_scales(largest, root_walls, shared, residuals(largest, features, law))
    laws = [fit_law(cells.without(part), features) for part in parts]
    mean, variance = (np.full(cells.powers.shape, np.nan) for _ in range(2))
    for r, mask in enumerate(received.T):
        own = np.flatnonzero(mask)
        inverse = np.linalg.inv(covariance_of_powers(scales, cells, root_walls, shared, own, r))
        for part, (law, law_covariance) in zip(parts, laws, strict=True):
            out = part[own]
            if out.any():
                off = inverse[out] @ (cells.powers[own, r] - features[own, r] @ law)
                of_part, rows = np.linalg.inv(inverse[np.ix_(out, out)]), own[out]
                mean[rows, r] = cells.powers[rows, r] - of_part @ off
                of_law = np.einsum("bi,ij,bj->b", features[rows, r], law_covariance, features[rows, r])
                variance[rows, r] = np.diag(of_part) + of_law
    return mean, np.sqrt(variance)


def log_distance(measured: Readings) -> Float[np.ndarray, "n r"]:
    """Returns the predictions of one log-distance law for all receivers (least squares) at all positions."""
    distance = distances(measured.places, measured.receivers)
    features = np.stack([np.ones_like(distance), -10 * np.log10(np.maximum(distance, NEAREST))], -1)
    received = np.isfinite(measured.powers)
    law, *_ = np.linalg.lstsq(features[received], measured.powers[received], rcond=None)
    return features @ law


def inverse_distance(measured: Readings) -> Float[np.ndarray, "n r"]:
    """Returns the mean of each receiver's powers, weighted by 1 / distance^2 to the positions (Shepard 1968)."""
    weights = 1 / np.maximum(distances(measured.places, measured.places), NEAREST) ** 2
    total = weights @ np.isfinite(measured.powers)
    return np.where(
        total > 0, weights @ np.nan_to_num(measured.powers) / np.where(total > 0, total, 1), np.nanmean(measured.powers)
    )


def kriging(measured: Readings) -> Float[np.ndarray, "n r"]:
    """Returns the predictions of a separate Gaussian process for each receiver, around its mean power."""
    scales, predicted = Scales(), np.full(measured.powers.shape, np.nanmean(measured.powers))
    k = APART**2 * alike(distances(measured.places, measured.places))
    for r, mask in enumerate(np.isfinite(measured.powers).T):
        own = np.flatnonzero(mask)
        if len(own):
            powers, covariance = measured.powers[own, r], k[np.ix_(own, own)] + np.diag(noise(scales, measured.counts[own, r]))
            predicted[:, r] = powers.mean() + k[:, own] @ np.linalg.solve(covariance, powers - powers.mean())
    return predicted


RIVALS: dict[str, Rival] = {"log-distance": log_distance, "inverse distance": inverse_distance, "kriging": kriging}
COMPARED = (*RIVALS, "without walls")
"""Names of all baselines."""
