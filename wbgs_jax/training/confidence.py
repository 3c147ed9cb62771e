"""What the validation part says about how sure a trained field's answers are, on the host.

Every transmitter is left out in turn, so that what is left of the scores is that of transmitters that were not looked at. Of a
few sets of features, each with the ones before, the largest is taken that lowers the mean squared rest by more than chance.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.stats import t as student_t

from wbgs_jax.data.dataset import Dataset
from wbgs_jax.evaluation.metrics import ssim
from wbgs_jax.fields import Field
from wbgs_jax.inference.confidence import FEATURES, LEVEL, MARGIN, Confidence, features
from wbgs_jax.inference.neighbours import Neighbours, correct
from wbgs_jax.inference.predictor import observe_links

FEWEST, MOST = 8, 300
"""Validation spectra below which nothing is said; those that are looked at, at most."""
FEW = 20
"""Rests below which their own quantiles do not reach `LEVEL`."""
SETS = (0, 1, 3, 5, FEATURES)
"""Numbers of features that are tried: none, the distance, and how bright the answer is, and the frequency, and the power."""
RIDGE = 1.0
"""Of the scaled features: that of one spectrum."""
_features = jax.jit(features)


def learn_confidence(field: Field, params: Any, dataset: Dataset, neighbours: Neighbours | None) -> Confidence | None:
    """Returns how sure answers are; None for data of several receivers or received powers, or with too few validation spectra.

    `neighbours` are those of the training part alone, if neighbours are asked.
    """
    if dataset.kind == "power" or dataset.n_receivers > 1 or len(dataset.validation) < FEWEST:
        return None
    index = np.random.default_rng(1).permutation(dataset.validation)[:MOST]
    query, trained = dataset.query(index), np.unique(dataset.tx_positions[dataset.train], axis=0)
    seen, rx = observe_links(field, params, dataset, index), np.asarray(dataset.receiver().position)
    pas = np.asarray(correct(neighbours, jnp.asarray(seen.pas), query))
    places = jnp.asarray(rx, jnp.float32), jnp.asarray(trained, jnp.float32)
    power = None if seen.power_db is None else jnp.asarray(seen.power_db)
    known = np.asarray(_features(jnp.asarray(pas), query, *places, power), np.float64)
    error = np.log(1 + MARGIN - np.minimum(ssim(pas, np.asarray(dataset.pas(index))), 1))
    learned = fit(known, error, dataset.tx_index[index])
    return Confidence(*places, *(jnp.asarray(array, jnp.float32) for array in learned))


def fit(
    known: Float[np.ndarray, "n k"], error: Float[np.ndarray, "n"], tx_index: Int[np.ndarray, "n"]
) -> tuple[np.ndarray | float, ...]:
    """Returns mean and scale of the features, weights, quantiles and surplus of a `Confidence`, from features and log errors of
    some answers."""
    mean, scale = known.mean(0), known.std(0) + 1e-6
    scaled = (known - mean) / scale
    rests = {size: left_out(scaled[:, :size], error, tx_index) for size in SETS}
    chosen = SETS[0]
    for size in SETS[1:]:
        gain = rests[chosen] ** 2 - rests[size] ** 2
        by_tx = np.array([gain[tx_index == tx].mean() for tx in np.unique(tx_index)])
        if by_tx.mean() > by_tx.std() / np.sqrt(len(by_tx)):
            chosen = size
    weights = np.zeros(known.shape[1] + 1)
    weights[[*range(chosen), -1]] = regress(scaled[:, :chosen], error)
    rest = rests[chosen]
    return mean, scale, weights, interval(rest), float(np.exp(rest).mean())


def regress(scaled: Float[np.ndarray, "n k"], error: Float[np.ndarray, "n"]) -> Float[np.ndarray, "k+1"]:
    """Returns the weights of the features and of 1 (ridge regression; 1 is not held back)."""
    columns = np.column_stack([scaled, np.ones(len(scaled))])
    penalty = np.diag([RIDGE] * scaled.shape[1] + [0.0])
    weights: np.ndarray = np.linalg.solve(columns.T @ columns + penalty, columns.T @ error)
    return weights


def left_out(
    scaled: Float[np.ndarray, "n k"], error: Float[np.ndarray, "n"], tx_index: Int[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Returns what a regression on all other transmitters leaves of every error."""
    rest = np.zeros(len(error))
    for tx in np.unique(tx_index):
        own = tx_index == tx
        weights = regress(scaled[~own], error[~own]) if not own.all() else np.append(np.zeros(scaled.shape[1]), error.mean())
        rest[own] = error[own] - scaled[own] @ weights[:-1] - weights[-1]
    return rest


def interval(rest: Float[np.ndarray, "n"]) -> Float[np.ndarray, "2"]:
    """Returns the ends between which `LEVEL` of further rests lie, with the correction for the number of those seen.

    A few cannot have such quantiles: there it is the interval of Student's t, no narrower than what was seen.
    """
    n, tail = len(rest), round((1 - LEVEL) / 2, 9)  # binary fractions would lose a place
    ordered = np.sort(rest)
    low = max(int(np.floor(tail * (n + 1))) - 1, 0)
    high = min(int(np.ceil((1 - tail) * (n + 1))) - 1, n - 1)
    ends = ordered[[low, high]]
    if n >= FEW:
        return ends
    spread = rest.std(ddof=1) * np.sqrt(1 + 1 / n) * student_t.ppf(1 - tail, n - 1)
    return np.array([min(ends[0], rest.mean() - spread), max(ends[1], rest.mean() + spread)])
