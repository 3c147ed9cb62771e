"""Scales of the residuals of a path loss law: their covariance, and its most probable parameters for given residuals (Rasmussen
and Williams 2006, section 5.4)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from wbgs_jax.data.floor_plan import namespace
from wbgs_jax.data.rssi_folder import Readings

LENGTH = 1.0
"""Correlation length of the residuals near a place and of those behind walls, metres."""
Scale = float | Float[Array, ""]


@dataclass(frozen=True)
class Scales:
    """Standard deviations of the residuals of the law (dB), and a length. The defaults are prior medians: receivers of one kind
    differ by about a decibel, the shadows of rooms and furniture by a few."""

    near: Scale = 3.0
    """Standard deviation of the part of u that decays within a metre, ..."""
    far: Scale = 3.0
    """... of the part that decays over rooms, ..."""
    wall: Scale = 4.0
    """... of v (walls), ..."""
    gain: Scale = 1.0
    """... of the gains of receivers, ..."""
    place: Scale = 0.5
    """... of the part that is not a function of the position, ..."""
    reading: Scale = 4.5
    """... and of a single reading (fading)."""
    length_m: Scale = 5.0
    """Correlation length of the part that decays over rooms, metres."""


WIDTHS = Scales(near=0.7, far=0.7, wall=0.7, gain=1.0, place=0.5, reading=0.5, length_m=0.7)
"""Prior standard deviations of the logarithms of all scales."""


def distances(a: Any, b: Any) -> Any:
    """Returns the distances (metres) of positions (n, 3) from others (m, 3) as (n, m), with a finite gradient at 0."""
    return namespace(a).sqrt(namespace(a).sum((a[:, None] - b) ** 2, -1) + 1e-12)


def alike(apart: Any) -> Any:
    """Returns the correlation of nearby residuals whose positions are `apart`, metres."""
    return namespace(apart).exp(-apart / LENGTH)


def covariance(scales: Scales, apart: Any, shared: Any, root_walls: Any, others: Any) -> Any:
    """Returns the covariance (dB^2) of residuals at one receiver.

    Args:
        scales: standard deviations and length.
        apart: distances between the two positions of each pair, metres.
        shared: `in_one_room` of each pair.
        root_walls: sqrt(w) of the first position of each pair, ...
        others: ... and of the second.
    """
    near = (scales.near**2 + scales.wall**2 * root_walls * others) * alike(apart)
    return near + scales.far**2 * shared * namespace(apart).exp(-apart / scales.length_m) + scales.gain**2


def in_one_room(crossed: Any, others: Any) -> Any:
    """Returns the correlation (b, n) of residuals by what is crossed towards all receivers, which marks a room, because rooms
    have shadows of their own: the smaller, the more the numbers of walls and ceilings differ, in the mean over receivers.

    Args:
        crossed: sqrt(w) and L(k) of the links from positions to all receivers (b, r, 2), ...
        others: ... and from others (n, r, 2).
    """
    fall = 10.0  # anything between 3 and 30 scores alike
    first, second = (marks.reshape(len(marks), -1) for marks in (crossed, others))
    if namespace(crossed) is np:
        differences = cdist(first, second, "cityblock")
    else:
        differences = abs(first[:, None] - second).sum(-1)
    return namespace(crossed).exp(-fall * differences / crossed.shape[1])


def noise(scales: Scales, counts: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Returns the variance (dB^2) of means of `counts` readings around the part that is a function of the position."""
    return float(scales.place) ** 2 + float(scales.reading) ** 2 / counts


def learn_scales(
    readings: Readings,
    root_walls: Float[np.ndarray, "n r"],
    shared: Float[np.ndarray, "n n"],
    left: Float[np.ndarray, "n r"],
) -> Scales:
    """Returns the scales of maximum posterior probability, with the values of `Scales` as prior medians.

    Args:
        readings: positions and numbers of readings.
        root_walls: sqrt(w) of every link.
        shared: `in_one_room` of all positions.
        left: residuals of the law, dB.
    """
    first, widths = np.log([*vars(Scales()).values()]), np.array([*vars(WIDTHS).values()])
    received = np.isfinite(readings.powers)
    shuffled = np.random.default_rng(0).permutation(len(received))  # a part has to contain neighbours and distant places
    looked_at = int(min(400, 400 * (8 / max(received.any(0).sum(), 1)) ** (1 / 3)))  # positions of every receiver that are used
    chosen = []
    for r in np.flatnonzero(received.any(0)):
        own = shuffled[received[shuffled, r]][:looked_at]
        apart = distances(readings.places[own], readings.places[own])
        by_walls = alike(apart) * np.outer(root_walls[own, r], root_walls[own, r])
        chosen.append((apart, by_walls, shared[np.ix_(own, own)], 1 / readings.counts[own, r], left[own, r]))

    def negative_log_posterior(logs: np.ndarray) -> tuple[float, np.ndarray]:
        away = (logs - first) / widths
        total, gradient = 0.5 * np.sum(away**2), away / widths
        near, far, wall, gain, place, reading, _ = np.exp(2 * logs)
        length = np.exp(logs[-1])
        for apart, by_walls, in_room, shares, values in chosen:
            close, wide = alike(apart), in_room * np.exp(-apart / length)
            k = near * close + far * wide + wall * by_walls + gain
            k[np.diag_indices(len(values))] += place + reading * shares
            factor = cho_factor(k, lower=True)
            weights, inverse = cho_solve(factor, values), cho_solve(factor, np.eye(len(values)))
            total += 0.5 * values @ weights + np.sum(np.log(np.diag(factor[0])))
            slope = inverse - np.outer(weights, weights)  # twice the derivative by K
            diagonal, of_far = np.diag(slope), slope * wide
            by_scale = [np.sum(slope * close), np.sum(of_far), np.sum(slope * by_walls), np.sum(slope)]
            by_noise = [diagonal.sum(), diagonal @ shares]
            parts = [*by_scale, *by_noise, 0.5 * np.sum(of_far * apart) / length]
            gradient = gradient + np.array([near, far, wall, gain, place, reading, far]) * parts
        return float(total), gradient

    bounds = [(x - 2.3, x + 2.3) for x in first]
    found = minimize(negative_log_posterior, first, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 30})
    return Scales(*(float(x) for x in np.exp(found.x)))
