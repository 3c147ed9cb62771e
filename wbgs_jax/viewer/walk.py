"""A walk through the room: a closed route along some of the transmitters of the data, at constant speed."""

import numpy as np
from jaxtyping import Float


def stops(tx_positions: Float[np.ndarray, "n 3"], count: int = 8, seed: int = 0) -> Float[np.ndarray, "count 3"]:
    """Returns transmitters that are far apart, in the order of a short round trip."""
    places = np.unique(tx_positions, axis=0)
    chosen = [int(np.random.default_rng(seed).integers(len(places)))]
    away = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < min(count, len(places)):
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(places - places[chosen[-1]], axis=1))
    left, way = places[chosen], [places[chosen[0]]]
    left = left[1:]
    while len(left):
        nearest = int(np.argmin(np.linalg.norm(left - way[-1], axis=1)))
        way.append(left[nearest])
        left = np.delete(left, nearest, axis=0)
    return np.array(way)


def place_on(way: Float[np.ndarray, "n 3"], distance_m: float) -> Float[np.ndarray, "3"]:
    """Returns the position after a distance along a closed route."""
    closed = np.concatenate([way, way[:1]])
    lengths = np.linalg.norm(np.diff(closed, axis=0), axis=1)
    total = lengths.sum()
    if total <= 0:
        return way[0]
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    return np.array([np.interp(distance_m % total, along, closed[:, axis]) for axis in range(3)])
