"""Statistics of gains of one method over another. Links of one transmitter are correlated, so transmitters are the samples."""

import numpy as np
from jaxtyping import Float, Int


def standard_error(gains: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"]) -> tuple[float, float]:
    """Returns the mean gain and its standard error, with transmitters as the independent samples.

    Args:
        gains: of every link.
        tx_index: transmitter of every link.
    """
    by_tx = by_transmitter(gains, tx_index)
    error = by_tx.std(ddof=1) / np.sqrt(len(by_tx)) if len(by_tx) > 1 else np.inf
    return float(by_tx.mean()), float(error)


def by_transmitter(gains: Float[np.ndarray, "*c n"], tx_index: Int[np.ndarray, " n"]) -> Float[np.ndarray, "*c k"]:
    """Returns the mean gain of every transmitter, along the last axis."""
    return np.moveaxis(np.array([gains[..., tx_index == tx].mean(-1) for tx in np.unique(tx_index)]), 0, -1)
