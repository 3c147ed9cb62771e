"""What the validation part says about how sure a trained field's answers are, on the host.

Every transmitter is left out in turn, so that what is left of the scores is that of transmitters that were not looked at. Of a
few sets of features, each with the ones before, the largest is taken that lowers the mean squared rest by more than chance;
small validation parts can tell of few features only.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.stats import t as student_t

from wbgs_jax._util.statistics import standard_error
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.evaluation.metrics import ssim
from wbgs_jax.fields import Field, Observation
from wbgs_jax.inference.confidence import (
    FEATURES,
    LEVEL,
    MARGIN,
    POWER_FEATURES,
    POWER_MARGIN_DB,
    Confidence,
    PowerConfidence,
    features,
    power_features,
)
from wbgs_jax.inference.neighbours import Neighbours, correct
from wbgs_jax.inference.predictor import as_observed, observe_links
from wbgs_jax.radio.channel import NOT_HEARD_DB

FEWEST, MOST = 8, 1000
"""Validation spectra below which nothing is said; those that are looked at, at most."""
FEW, FEW_TX = 20, 8
"""Rests, and transmitters, below which their own quantiles do not reach `LEVEL`."""
ALIKE = 0.3
"""Share of a transmitter by which quantiles reach further than links that are no more alike than others would need."""
SETS = (0, 1, 3, 5, FEATURES)
"""Numbers of features that are tried: none, the distance, and how bright the answer is, and the frequency, and the power."""
POWER_SETS = (0, 1, 2, POWER_FEATURES)
"""The same of received powers: none, the distance, and the power itself, and the frequency."""
ENOUGH = 5
"""Transmitters for every feature, at least: of fewer a regression learns their own errors by heart."""
RIDGE = 1.0
"""Of the scaled features: that of one spectrum."""
_features, _power_features = jax.jit(features), jax.jit(power_features)


def learn_confidence(
    field: Field, params: Any, dataset: Dataset, neighbours: Neighbours | None
) -> tuple[Confidence | None, PowerConfidence | None]:
    """Returns how sure spectra and received powers are; None where field or data know nothing of them, or for too few
    validation links.

    `neighbours` are those of the training part alone, if neighbours are asked.
    """
    if len(dataset.validation) < FEWEST or len(np.unique(dataset.tx_index[dataset.validation])) < 2:
        return None, None
    index = np.random.default_rng(1).permutation(dataset.validation)[:MOST]
    seen = observe_links(field, params, dataset, index)
    return _of_spectra(field, params, seen, dataset, index, neighbours), _of_powers(seen, dataset, index)


def _of_spectra(
    field: Field, params: Any, seen: Observation, dataset: Dataset, index: Int[np.ndarray, " n"], neighbours: Neighbours | None
) -> Confidence | None:
    if dataset.kind == "power":
        return None
    query = dataset.query(index)
    pas = np.asarray(correct(neighbours, jnp.asarray(seen.pas), query))
    trained, receivers = _trained(dataset), jnp.asarray(dataset.rx_positions(index), jnp.float32)
    power = None if seen.power_db is None else jnp.asarray(seen.power_db)
    known = np.asarray(_features(jnp.asarray(pas), query, receivers, trained, power), np.float64)
    alike = ssim(as_observed(field, params, pas), np.asarray(dataset.pas(index)))
    error = np.log(1 + MARGIN - np.minimum(alike, 1))
    *learned, rest = fit(known, error, dataset.tx_index[index], SETS)
    arrays = *learned, interval(rest, dataset.tx_index[index]), np.exp(rest).mean()
    places = dataset.receivers.position if dataset.n_receivers > 1 else dataset.receiver().position
    return Confidence(places, trained, *(jnp.asarray(array, jnp.float32) for array in arrays))


def _of_powers(seen: Observation, dataset: Dataset, index: Int[np.ndarray, " n"]) -> PowerConfidence | None:
    truth = dataset.received_db(index)
    if truth is None or seen.power_db is None:
        return None
    heard = np.flatnonzero(truth > NOT_HEARD_DB)
    if len(heard) < FEWEST or len(np.unique(dataset.tx_index[index[heard]])) < 2:
        return None
    index, said = index[heard], np.asarray(seen.power_db)[heard]
    receivers = jnp.asarray(dataset.rx_positions(index), jnp.float32)
    trained = _trained(dataset)
    known = np.asarray(_power_features(jnp.asarray(said), dataset.query(index), receivers, trained), np.float64)
    error = np.log(POWER_MARGIN_DB + np.abs(said.astype(np.float64) - truth[heard]))
    *learned, rest = fit(known, error, dataset.tx_index[index], POWER_SETS)
    arrays = *learned, upper_end(rest, dataset.tx_index[index]), np.exp(rest).mean()
    return PowerConfidence(trained, *(jnp.asarray(array, jnp.float32) for array in arrays))


def _trained(dataset: Dataset) -> Float[Array, "m 3"]:
    """Returns where transmitters stood that were trained."""
    return jnp.asarray(np.unique(dataset.tx_positions[dataset.train], axis=0), jnp.float32)


def fit(
    known: Float[np.ndarray, "n k"], error: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"], sets: tuple[int, ...]
) -> tuple[np.ndarray, ...]:
    """Returns mean and scale of the features, and the weights, of a `Confidence`, from features and log errors of some answers,
    and what is left of these errors; `sets` are the numbers of features that are tried."""
    mean, scale = known.mean(0), known.std(0) + 1e-6
    scaled = (known - mean) / scale
    sets = tuple(size for size in sets if ENOUGH * size <= len(np.unique(tx_index)))
    rests = {size: left_out(scaled[:, :size], error, tx_index) for size in sets}
    chosen = sets[0]
    for size in sets[1:]:
        gain, noise = standard_error(rests[chosen] ** 2 - rests[size] ** 2, tx_index)
        if gain > noise:
            chosen = size
    weights = np.zeros(known.shape[1] + 1)
    weights[[*range(chosen), -1]] = regress(scaled[:, :chosen], error)
    return mean, scale, weights, rests[chosen]


def regress(scaled: Float[np.ndarray, "n k"], error: Float[np.ndarray, " n"]) -> Float[np.ndarray, " k+1"]:
    """Returns the weights of the features and of 1 (ridge regression; 1 is not held back)."""
    columns = np.column_stack([scaled, np.ones(len(scaled))])
    penalty = np.diag([RIDGE] * scaled.shape[1] + [0.0])
    weights: np.ndarray = np.linalg.solve(columns.T @ columns + penalty, columns.T @ error)
    return weights


def left_out(
    scaled: Float[np.ndarray, "n k"], error: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Returns what a regression on all other transmitters leaves of every error."""
    rest = np.zeros(len(error))
    for tx in np.unique(tx_index):
        own = tx_index == tx
        weights = regress(scaled[~own], error[~own]) if not own.all() else np.append(np.zeros(scaled.shape[1]), error.mean())
        rest[own] = error[own] - scaled[own] @ weights[:-1] - weights[-1]
    return rest


def interval(rest: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"]) -> Float[np.ndarray, "2"]:
    """Returns the ends between which `LEVEL` of further rests lie."""
    tail = (1 - LEVEL) / 2
    return np.array([-upper_end(-rest, tx_index, tail), upper_end(rest, tx_index, tail)])


def upper_end(rest: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"], tail: float = 1 - LEVEL) -> float:
    """Returns what all but a share `tail` of further rests lie below, with the correction for the number of those seen.

    Rests of one transmitter are alike, so that quantiles vary with the number of transmitters rather than that of rests: they
    reach further by 0.3 / transmitters, which holds `LEVEL` within 4 % from 8 transmitters on, however alike they are. A few
    rests, or those of a few transmitters, cannot have such a quantile: there it is that of Student's t, no lower than what was
    seen, which counts transmitters.
    """
    n, n_tx, tail = len(rest), len(np.unique(tx_index)), round(tail, 9)  # binary fractions would lose a place
    if n_tx < FEW_TX:
        n = n_tx
    elif n >= FEW:
        below = max(n - int(np.floor(tail * (n + 1))), int(np.ceil((1 - tail + ALIKE / n_tx) * n)) - 1)
        return float(np.sort(rest)[min(below, n - 1)])
    return float(max(rest.max(), rest.mean() + rest.std(ddof=1) * np.sqrt(1 + 1 / n) * student_t.ppf(1 - tail, n - 1)))
