"""What the validation part says about how sure a trained field's answers are, on the host.

Every transmitter is left out in turn, so that what is left of the scores is that of transmitters that were not looked at. Of a
few sets of features, each with the ones before, the largest is taken that lowers the mean squared rest by more than chance;
small validation parts can tell of few features only.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wbgs_jax._util.statistics import standard_error
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.fields import Field, Observation
from wbgs_jax.fields.base import Params
from wbgs_jax.inference.intervals import (
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
from wbgs_jax.inference.kriging import Neighbours, correct
from wbgs_jax.inference.predictor import as_observed, observe_links
from wbgs_jax.metrics import ssim
from wbgs_jax.radio.channel import NOT_HEARD_DB

FEWEST, MOST = 8, 1000
"""Validation spectra below which nothing is said; those that are looked at, at most."""
DRAWS = 400
"""Of one link of every transmitter."""
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
    field: Field, params: Params, dataset: Dataset, neighbours: Neighbours | None
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
    field: Field,
    params: Params,
    seen: Observation,
    dataset: Dataset,
    index: Int[np.ndarray, " n"],
    neighbours: Neighbours | None,
) -> Confidence | None:
    if not dataset.has_spectra:
        return None
    query = dataset.query(index)
    pas = np.asarray(correct(neighbours, jnp.asarray(seen.pas), query))
    trained, receivers = _trained(dataset), jnp.asarray(dataset.rx_positions(index), jnp.float32)
    power = None if seen.power_db is None else jnp.asarray(seen.power_db)
    known = np.asarray(_features(jnp.asarray(pas), query, receivers, trained, power), np.float64)
    alike = ssim(as_observed(field, params, pas), np.asarray(dataset.pas(index)))
    places = dataset.receivers.position if dataset.n_receivers > 1 else dataset.receiver().position
    return confidence_of(known, alike, dataset.tx_index[index], places, trained)


def confidence_of(
    known: Float[np.ndarray, "n k"],
    scores: Float[np.ndarray, " n"],
    tx_index: Int[np.ndarray, " n"],
    rx_position: Float[Array, "*r 3"],
    tx_position: Float[Array, "m 3"],
) -> Confidence:
    """Returns how sure answers are, from the features and scores (SSIM) of some of them.

    Args:
        known: features of the answers (`inference.intervals.features`).
        scores: what they scored.
        tx_index: their transmitters.
        rx_position: of the receivers, metres.
        tx_position: of the transmitters that are known, metres.
    """
    *learned, rest = fit(known, np.log(1 + MARGIN - np.minimum(scores, 1)), tx_index, SETS)
    quantiles, level = interval(rest, tx_index)
    arrays = *learned, quantiles, np.exp(rest).mean(), level
    return Confidence(rx_position, tx_position, *(jnp.asarray(array, jnp.float32) for array in arrays))


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
    level = exact_level(dataset.tx_index[index])
    arrays = *learned, upper_end(rest, dataset.tx_index[index], 1 - level), np.exp(rest).mean(), level
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


def interval(rest: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Returns the ends between which further rests lie, and how surely: with the chance `LEVEL`, where there are transmitters
    enough for two tails; with fewer there is no lower end (scores as high as they may be), and with fewer still the level is
    the highest that exists."""
    tail = (1 - LEVEL) / 2
    if tail * (len(np.unique(tx_index)) + 1) >= 1 - 1e-9:
        return np.array([-upper_end(-rest, tx_index, tail), upper_end(rest, tx_index, tail)]), LEVEL
    level = exact_level(tx_index)
    return np.array([-np.inf, upper_end(rest, tx_index, 1 - level)]), level


def exact_level(tx_index: Int[np.ndarray, " n"]) -> float:
    """Returns the level of one-sided intervals: `LEVEL`, or what n transmitters allow, n / (n + 1)."""
    count = len(np.unique(tx_index))
    return min(LEVEL, count / (count + 1))


def upper_end(rest: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"], tail: float = 1 - LEVEL) -> float:
    """Returns what all but a share `tail` of further rests lie below.

    A new transmitter is exchangeable with those that were seen, its links are not with each other. Of one link of each of n
    transmitters the rank (1 - tail) (n + 1) is exact (split conformal prediction, Lei et al. 2018), whatever the distribution;
    between ranks it is interpolated, and it is the mean over many draws of these links (Dunn, Wasserman and Ramdas 2023). Of
    too few transmitters it is infinite.
    """
    owns = [rest[tx_index == tx] for tx in np.unique(tx_index)]
    rank = round((1 - tail) * (len(owns) + 1), 9)  # binary fractions would lose a place
    if rank > len(owns):
        return np.inf
    rng = np.random.default_rng(5)
    drawn = np.sort([rng.choice(own, DRAWS) for own in owns], axis=0)
    below = max(int(rank), 1)
    share, above = rank - below, min(below, len(owns) - 1)
    return float(np.mean((1 - share) * drawn[below - 1] + share * drawn[above]))
