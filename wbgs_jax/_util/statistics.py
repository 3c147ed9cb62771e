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


def lower_bound(gains: Float[np.ndarray, " n"], group: Int[np.ndarray, " n"], usual_spread: float, errors: float) -> float:
    """Returns the lower confidence bound of the mean gain over groups of links. Their variance combines the observed one with a
    prior that counts as two groups, so that a few groups that happen to agree are little evidence.

    Args:
        gains: of every link.
        group: groups of links with correlated errors, such as transmitters.
        usual_spread: prior standard deviation of the gain over groups.
        errors: distance of the bound from the mean, standard errors.
    """
    mean_gains = by_transmitter(gains, group)
    n, usual_weight = len(mean_gains), 2.0
    variance = (usual_weight * usual_spread**2 + np.sum((mean_gains - mean_gains.mean()) ** 2)) / (usual_weight + n - 1)
    return float(mean_gains.mean() - errors * np.sqrt(variance / n))


def by_transmitter(gains: Float[np.ndarray, "*c n"], tx_index: Int[np.ndarray, " n"]) -> Float[np.ndarray, "*c k"]:
    """Returns the mean gain of every transmitter, along the last axis."""
    return np.moveaxis(np.array([gains[..., tx_index == tx].mean(-1) for tx in np.unique(tx_index)]), 0, -1)
