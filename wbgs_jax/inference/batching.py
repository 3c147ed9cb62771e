"""Evaluates many queries, lists or maps of transmitters, in blocks of one compiled shape."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from wbgs_jax._util.devices import own_devices
from wbgs_jax.inference.predictor import BLOCK, Predictor


def predict_blocks(
    predict: Predictor, tx_positions: Any, frequencies_hz: Any, block: int = BLOCK
) -> Iterator[Float[np.ndarray, " k *answer"]]:
    """Yields the spectra or powers (float32) of n queries in order, in blocks, so that the results need not fit in memory.

    Positions are (n, 3) in metres; frequencies are (n,) or a single one in hertz. All blocks are evaluated with the same shape,
    so that one compilation suffices. A block has `block` queries per device; `make_predictor` divides it among the devices.

    Args:
        predict: from `make_predictor`, `make_power_predictor` or `load_exported`.
        tx_positions: (n, 3), world frame, metres.
        frequencies_hz: (n,) or one, hertz.
        block: queries per device that are evaluated at once.

    Yields:
        Arrays (k, 90, 360) or (k,), at most `block` queries per device in each.

    Raises:
        ValueError: the shapes of positions and frequencies do not match, or `block` is less than 1.
    """
    if block < 1:
        raise ValueError(f"block is {block}; give at least 1 query per device")
    positions = _positions(tx_positions)
    frequencies = np.broadcast_to(np.asarray(frequencies_hz, np.float32), len(positions))
    n, block = len(positions), block * own_devices().count

    def part(start: int) -> Float[np.ndarray, " k *answer"]:
        index = np.minimum(np.arange(start, start + block), n - 1)  # the last block is filled up with copies of the last query
        return np.asarray(predict(positions[index], frequencies[index]))[: n - start]

    return map(part, range(0, n, block))  # lazy, but invalid arguments raise an error here


def predict_many(
    predict: Predictor, tx_positions: Any, frequencies_hz: Any, block: int = BLOCK
) -> Float[np.ndarray, " n *answer"]:
    """Returns the blocks of `predict_blocks` as one array.

    Args:
        predict, tx_positions, frequencies_hz, block: as in `predict_blocks`.

    Returns:
        Spectra (n, 90, 360), or powers (n,) in dB, float32.

    Raises:
        ValueError: as in `predict_blocks`.
    """
    n, done = len(_positions(tx_positions)), 0
    answers = None
    for part in predict_blocks(predict, tx_positions, frequencies_hz, block):
        answers = np.empty((n, *part.shape[1:]), np.float32) if answers is None else answers
        answers[done : done + len(part)] = part
        done += len(part)
    return np.asarray(predict(np.zeros((0, 3), np.float32), np.zeros(0, np.float32))) if answers is None else answers


def _positions(tx_positions: Any) -> Float[np.ndarray, "n d"]:
    """Returns positions, of which there may be one or none."""
    positions = np.asarray(tx_positions, np.float32)
    return np.atleast_2d(positions) if positions.size else np.zeros((0, 3), np.float32)


def map_queries(
    xs: Any, ys: Any, height: float, frequencies_hz: Any
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Returns the positions (metres) and frequencies (hertz) of a map at one height, with x fastest, then y, then frequency.

    The results of the n = frequencies * ys * xs queries can be reshaped to (frequencies, ys, xs, ...).

    Args:
        xs, ys: coordinates of the columns and of the rows, world frame, metres.
        height: of the transmitters, metres.
        frequencies_hz: one or several, hertz.

    Returns:
        Positions (n, 3) and frequencies (n,).

    Example:
        >>> positions, frequencies = map_queries([0.0, 1.0], [5.0], 1.5, 2.4e9)
        >>> positions.tolist(), frequencies.tolist()
        ([[0.0, 5.0, 1.5], [1.0, 5.0, 1.5]], [2400000000.0, 2400000000.0])
    """
    frequency, y, x = np.meshgrid(np.atleast_1d(frequencies_hz), np.atleast_1d(ys), np.atleast_1d(xs), indexing="ij")
    return np.stack([x, y, np.full(x.shape, height)], -1).reshape(-1, 3).astype(float), frequency.reshape(-1).astype(float)


def predict_map(
    predict: Predictor, xs: Any, ys: Any, height: float, frequencies_hz: Any, block: int = BLOCK
) -> Float[np.ndarray, " n *answer"]:
    """Returns the spectra (float32, 130 kB each) or powers for a map of transmitters, in the order of `map_queries`.

    Args:
        predict, block: as in `predict_blocks`.
        xs, ys, height, frequencies_hz: as in `map_queries`.

    Returns:
        Spectra (frequencies * ys * xs, 90, 360), or powers, float32.
    """
    return predict_many(predict, *map_queries(xs, ys, height, frequencies_hz), block)
