"""Where to measure next: the places about which a field is most uncertain, in an order to walk them.

The error of a prediction is modelled as a Gaussian process over places: its standard deviation is the error that the field
itself expects there, and its correlation that of an exponential covariance, given the measured places. Places are chosen one
after the other, each as the one with the largest variance given those before (maximum entropy sampling; Shewry and Wynn 1987).
Neighbouring places are thus not chosen together, and where the field expects the same error everywhere, each place is about as
far as possible from all others. Choosing what reduces the mean variance most (A-optimal design) took more readings on both
measured sets.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist

NUGGET = 0.15
"""Variance of what a measurement does not share with its surroundings, such as fading, relative to the variance of errors."""


class NextPlaces(NamedTuple):
    """Places to measure next."""

    numbers: Int[np.ndarray, " count"]
    """Indices of the candidates, in the order of choice."""
    error: Float[np.ndarray, " count+1"]
    """Root mean square error over the candidates that is expected before the first and after each measurement, in the unit of
    the expected errors."""


def choose_next_places(
    candidates: Float[np.ndarray, "c 3"],
    expected_error: Float[np.ndarray, " c"],
    measured: Float[np.ndarray, "m 3"],
    length: float,
    count: int,
) -> NextPlaces:
    """Returns the candidates about which the field is most uncertain, given those before (host).

    Args:
        candidates: places that can be measured, metres.
        expected_error: error that is expected at each now, at least 0: of any unit.
        measured: places that are measured already, metres.
        length: distance over which errors are alike, metres.
        count: number of places to choose, at most that of the candidates.

    Returns:
        The places, and the expected error after each.

    Raises:
        ValueError: the count exceeds the number of candidates, the length is not positive, or an error is negative or NaN.
    """
    if not 0 < count <= len(candidates):
        raise ValueError(f"count is {count}; there are {len(candidates)} candidates")
    if not length > 0:
        raise ValueError(f"length is {length}; it must be positive")
    if not (np.isfinite(expected_error) & (np.asarray(expected_error) >= 0)).all():
        raise ValueError("expected_error is negative or not finite; leave out the candidates without one")
    covariance = _given(candidates, expected_error, measured, length)
    nugget = NUGGET * np.square(expected_error) + np.finfo(float).tiny
    chosen, error = np.zeros(count, int), np.zeros(count + 1)
    error[0] = _root_mean(covariance)
    open_ = np.ones(len(candidates), bool)
    for number in range(count):
        variance = np.diag(covariance)
        chosen[number] = one = int(np.argmax(np.where(open_, variance, -1)))
        open_[one] = False
        column = covariance[:, one].copy()
        covariance -= np.outer(column, column) / (variance[one] + nugget[one])
        error[number + 1] = _root_mean(covariance)
    return NextPlaces(chosen, error)


def walking_order(places: Any, start: Any = None) -> Int[np.ndarray, " n"]:
    """Returns a short walk through all places: the nearest one next, then parts reversed as long as that shortens the walk
    (2-opt; Croes 1958).

    Args:
        places: (n, 3), metres.
        start: (3,), where the walk begins, metres; by default at the first place.

    Returns:
        Indices of the places, in order.
    """
    if not len(places):
        return np.zeros(0, int)
    points = np.asarray(places, float) if start is None else np.concatenate([np.asarray(start, float)[None], places])
    distance = cdist(points, points)
    order, left = [0], set(range(1, len(points)))
    while left:
        order.append(min(left, key=lambda one: float(distance[order[-1], one])))
        left.remove(order[-1])
    walk = np.array(order, int)
    swaps = 1000  # maximum number of reversals that shorten a walk
    for _ in range(swaps):
        if (shorter := _reversed_part(walk, distance)) is None:
            break
        walk = shorter
    return walk if start is None else walk[1:] - 1


def _reversed_part(walk: Int[np.ndarray, " n"], distance: Float[np.ndarray, "n n"]) -> Int[np.ndarray, " n"] | None:
    """Returns a shorter walk with one part reversed, which is never the first place; None if there is none."""
    for i in range(1, len(walk) - 1):
        for j in range(i + 1, len(walk)):
            before, first, last = walk[i - 1], walk[i], walk[j]
            gain = distance[before, first] - distance[before, last]
            if j + 1 < len(walk):
                gain += distance[last, walk[j + 1]] - distance[first, walk[j + 1]]
            if gain > 1e-9:
                return np.concatenate([walk[:i], walk[i : j + 1][::-1], walk[j + 1 :]])
    return None


def _given(
    candidates: Float[np.ndarray, "c 3"],
    expected_error: Float[np.ndarray, " c"],
    measured: Float[np.ndarray, "m 3"],
    length: float,
) -> Float[np.ndarray, "c c"]:
    """Returns the covariance of errors at candidates, given what is measured. Its diagonal holds the squared expected errors,
    which already depend on the distance to measured places as far as the data show that."""
    covariance = np.exp(-cdist(candidates, candidates) / length)
    if len(measured):
        between, own = (np.exp(-cdist(measured, places) / length) for places in (candidates, measured))
        own[np.diag_indices(len(measured))] += NUGGET
        covariance -= between.T @ cho_solve(cho_factor(own), between)
    least = 1e-9  # smallest conditional variance that is divided by
    scale = expected_error / np.sqrt(np.maximum(np.diag(covariance), least))
    covariance *= np.outer(scale, scale)
    return covariance


def _root_mean(covariance: Float[np.ndarray, "c c"]) -> float:
    return float(np.sqrt(np.mean(np.maximum(np.diag(covariance), 0))))
