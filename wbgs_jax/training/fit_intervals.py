"""Fit of prediction intervals to the validation part of a trained field (host).

Every transmitter is left out in turn, so that residuals of the scores are those of transmitters that were not used in the
regression. Of several nested sets of features, the largest is chosen that lowers the mean squared residual by more than a
standard error; small validation parts support only few features.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wbgs_jax._util.statistics import standard_error
from wbgs_jax.data.dataset import Dataset, places_of
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
    scaled_features,
)
from wbgs_jax.inference.kriging import Neighbours, correct
from wbgs_jax.inference.predictor import as_observed, observe_links
from wbgs_jax.metrics import ssim
from wbgs_jax.radio.channel import NO_PATH_DB

FEWEST, MOST = 8, 1000
"""Minimum number of validation spectra for prediction intervals, and maximum number that is used."""
SETS = (0, 1, 3, 5, FEATURES)
"""Numbers of features that are tried: none; the distance; also the brightness of the prediction; also the frequency; also the
power."""
POWER_SETS = (0, 1, 2, POWER_FEATURES)
"""Numbers of features that are tried for received powers: none; the distance; also the power itself; also the frequency."""
_features, _power_features = jax.jit(features), jax.jit(power_features)


def learn_confidence(
    field: Field, params: Params, dataset: Dataset, neighbours: Neighbours | None
) -> tuple[Confidence | None, PowerConfidence | None]:
    """Returns the prediction intervals of spectra and of received powers; None if the field or the data do not contain them, or
    for too few validation links.

    Args:
        field: trained field.
        params: its parameters.
        dataset: data that it was trained on.
        neighbours: residual kriging from the training part alone, if it is used.
    """
    if len(dataset.validation) < FEWEST or len(np.unique(places_of(dataset)[dataset.validation])) < 2:
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
    known_hz = np.zeros(0) if neighbours is None else np.asarray(neighbours.frequency_hz)
    corrected_hz = np.unique(known_hz[np.isfinite(known_hz)])  # NaN corrects at all frequencies
    return confidence_of(known, alike, places_of(dataset)[index], places, trained, corrected_hz)


def confidence_of(
    known: Float[np.ndarray, "n k"],
    scores: Float[np.ndarray, " n"],
    tx_index: Int[np.ndarray, " n"],
    rx_position: Float[Array, "*r 3"],
    tx_position: Float[Array, "m 3"],
    corrected_hz: Sequence[float] | Float[np.ndarray, " f"] = (),
) -> Confidence:
    """Returns prediction intervals of the SSIM, fitted to the features and scores of N predictions.

    Args:
        known: features of the predictions (`inference.intervals.features`).
        scores: their SSIM.
        tx_index: their transmitters.
        rx_position: positions of the receivers, metres.
        tx_position: positions of the trained transmitters, metres.
        corrected_hz: frequencies at which measured spectra correct the predictions; none if they do not.
    """
    *learned, rest = fit(known, np.log(1 + MARGIN - np.clip(scores, 0, 1)), tx_index, SETS)
    quantiles, level = interval(rest, tx_index)
    arrays = *learned, quantiles, np.exp(rest).mean(), level, np.asarray(corrected_hz)
    return Confidence(rx_position, tx_position, *(jnp.asarray(array, jnp.float32) for array in arrays))


def _of_powers(seen: Observation, dataset: Dataset, index: Int[np.ndarray, " n"]) -> PowerConfidence | None:
    truth = dataset.received_db(index)
    if truth is None or seen.power_db is None:
        return None
    received = np.flatnonzero(truth > NO_PATH_DB)
    if len(received) < FEWEST or len(np.unique(places_of(dataset)[index[received]])) < 2:
        return None
    index, predicted = index[received], np.asarray(seen.power_db)[received]
    receivers = jnp.asarray(dataset.rx_positions(index), jnp.float32)
    trained = _trained(dataset)
    known = np.asarray(_power_features(jnp.asarray(predicted), dataset.query(index), receivers, trained), np.float64)
    error = np.log(POWER_MARGIN_DB + np.abs(predicted.astype(np.float64) - truth[received]))
    places = places_of(dataset)[index]
    *learned, rest = fit(known, error, places, POWER_SETS)
    level = exact_level(places)
    arrays = *learned, upper_end(rest, places, 1 - level), np.exp(rest).mean(), level
    return PowerConfidence(trained, *(jnp.asarray(array, jnp.float32) for array in arrays))


def _trained(dataset: Dataset) -> Float[Array, "m 3"]:
    """Returns the positions of the trained transmitters, metres."""
    return jnp.asarray(np.unique(dataset.tx_positions[dataset.train], axis=0), jnp.float32)


def fit(
    known: Float[np.ndarray, "n k"], error: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"], sets: tuple[int, ...]
) -> tuple[np.ndarray, ...]:
    """Returns mean and scale of the features, the weights of a `Confidence`, and the residuals of left-out transmitters.

    Args:
        known: features of N predictions.
        error: logarithms of their errors.
        tx_index: their transmitters.
        sets: numbers of features that are tried.
    """
    mean, spread = known.mean(0), known.std(0)
    # Of a feature that does not vary, such as the distance to the next transmitter of a grid, only rounding would be scaled: an
    # infinite scale leaves it out.
    least = 0.01  # natural logarithms, octaves or decibels
    scale = np.where(spread > least, spread, np.inf)
    scaled = np.asarray(scaled_features(known, mean, scale))
    enough = 5  # minimum number of transmitters per feature; with fewer the regression overfits
    sets = tuple(size for size in sets if enough * size <= len(np.unique(tx_index)))
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
    """Returns the coefficients of the features and of the constant 1 (ridge regression; the constant is not penalised)."""
    columns = np.column_stack([scaled, np.ones(len(scaled))])
    ridge = 1.0  # ridge penalty on the coefficients of scaled features, in units of the weight of one spectrum
    penalty = np.diag([ridge] * scaled.shape[1] + [0.0])
    weights: np.ndarray = np.linalg.solve(columns.T @ columns + penalty, columns.T @ error)
    return weights


def left_out(
    scaled: Float[np.ndarray, "n k"], error: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Returns the residual of every error from a regression on all other transmitters."""
    rest = np.zeros(len(error))
    for tx in np.unique(tx_index):
        own = tx_index == tx
        weights = regress(scaled[~own], error[~own]) if not own.all() else np.append(np.zeros(scaled.shape[1]), error.mean())
        rest[own] = error[own] - scaled[own] @ weights[:-1] - weights[-1]
    return rest


def interval(rest: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Returns the ends of the interval of further residuals, and its level: `LEVEL` if there are enough transmitters for two
    tails. With fewer transmitters the interval has no lower end (no upper bound of the score), and with still fewer the level
    is the highest that exists."""
    tail = (1 - LEVEL) / 2
    if tail * (len(np.unique(tx_index)) + 1) >= 1 - 1e-9:
        return np.array([-upper_end(-rest, tx_index, tail), upper_end(rest, tx_index, tail)]), LEVEL
    level = exact_level(tx_index)
    return np.array([-np.inf, upper_end(rest, tx_index, 1 - level)]), level


def exact_level(tx_index: Int[np.ndarray, " n"]) -> float:
    """Returns the level of one-sided intervals: `LEVEL`, or the highest that n transmitters allow, n / (n + 1)."""
    count = len(np.unique(tx_index))
    return min(LEVEL, count / (count + 1))


def upper_end(rest: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"], tail: float = 1 - LEVEL) -> float:
    """Returns the bound that further residuals exceed with probability `tail`; infinite for too few transmitters.

    A new transmitter is exchangeable with the observed ones, but its links are not exchangeable with each other. For one link
    of each of n transmitters, the rank (1 - tail) (n + 1) is exact for any distribution (split conformal prediction, Lei et al.
    2018). The bound is interpolated between ranks, and averaged over many draws of these links (Dunn, Wasserman and Ramdas
    2023).
    """
    owns = [rest[tx_index == tx] for tx in np.unique(tx_index)]
    rank = round((1 - tail) * (len(owns) + 1), 9)  # rounded, since binary fractions could lose a rank
    if rank > len(owns):
        return np.inf
    rng = np.random.default_rng(5)
    draws = 400  # number of draws of one link per transmitter
    drawn = np.sort([rng.choice(own, draws) for own in owns], axis=0)
    below = max(int(rank), 1)
    share, above = rank - below, min(below, len(owns) - 1)
    return float(np.mean((1 - share) * drawn[below - 1] + share * drawn[above]))
