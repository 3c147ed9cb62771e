"""Prediction intervals: for a spectrum, the expected SSIM and a 90 % interval of the true SSIM; for a received power, the
expected absolute error and a 90 % bound on it, both in decibels.

    log(1 + margin - SSIM) = w . x + r        x: `features` of the prediction alone,  r: residual on validation transmitters
    log(margin + |error|)  = w . x + r        x: `power_features`

The features are selected on the validation part, and the ends of the interval are quantiles of the residuals there (split
conformal prediction, Lei et al. 2018). The coverage is therefore valid for transmitters drawn from the same distribution as
those of the validation part, not for others (`domain.Domain` excludes queries outside of the scene and of the band). An SSIM
below 0 counts as 0, so that all expected scores and ends of intervals lie between 0 and 1. The few mixture weights of a hybrid
field were learned on the same transmitters, for which its predictions are slightly too good.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from wbgs_jax._util.checks import check_array
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_tree, write_tree
from wbgs_jax._util.pytree import AnyArray, map_blocks, pytree
from wbgs_jax.inference.kriging import SAME_FREQUENCY, for_receiver
from wbgs_jax.radio.array import EXACT, PAS_SHAPE
from wbgs_jax.radio.channel import beyond_free_space_db
from wbgs_jax.types import Query, Receiver, Transmitter

MARGIN = 0.02
"""Keeps the logarithm of a perfect score finite."""
LEVEL = 0.9
"""Nominal coverage of the intervals."""
POWER_MARGIN_DB = 0.1
"""Keeps the logarithm of a zero error finite."""
FILE, POWER_FILE = "confidence.npz", "power_confidence.npz"
FEATURES, POWER_FEATURES = 6, 4


@pytree
class Confidence:
    """Regression of the SSIM of predicted spectra, common to all receivers of the data."""

    rx_position: Float[Array, "*r 3"]
    """Positions of the receivers, metres; of a single one for queries (`kriging.for_receiver`)."""
    tx_position: Float[Array, "m 3"]
    """Positions of the training transmitters, metres."""
    mean: Float[Array, " k"]
    """Means of the features ..."""
    scale: Float[Array, " k"]
    """... and their standard deviations, infinite for those that do not vary."""
    weights: Float[Array, " k+1"]
    """Weights of the scaled features, then the intercept; zero for features that do not improve the regression."""
    quantiles: Float[Array, "2"]
    """Quantiles of r that bound the interval."""
    surplus: Float[Array, ""]
    """Mean of exp(r)."""
    level: Float[Array, ""]
    """Probability that a score lies within the interval: `LEVEL`, or the highest level that the held-out transmitters allow."""
    frequency_hz: Float[Array, " f"]
    """Frequencies at which measured spectra correct the field, if they do: at others it answers alone, and there are no
    intervals. Empty if there is no correction."""


@pytree
class PowerConfidence:
    """Regression of the errors of predicted received powers, common to all receivers of the data."""

    tx_position: Float[Array, "m 3"]
    """Positions of the training transmitters, metres."""
    mean: Float[Array, " k"]
    """Means of the features ..."""
    scale: Float[Array, " k"]
    """... and their standard deviations, infinite for those that do not vary."""
    weights: Float[Array, " k+1"]
    """Weights of the scaled features, then the intercept; zero for features that do not improve the regression."""
    highest: Float[Array, ""]
    """Quantile of r that is the upper bound."""
    surplus: Float[Array, ""]
    """Mean of exp(r)."""
    level: Float[Array, ""]
    """Probability that r is below it: `LEVEL`, or the highest level that the held-out transmitters allow."""


C = TypeVar("C", Confidence, PowerConfidence)


class ExpectedPower(NamedTuple):
    """Expected errors of B received powers."""

    error_db: Float[Array, " b"]
    """Expected absolute error."""
    within_db: Float[Array, " b"]
    """Bound that 90 % of the absolute errors stay below (`PowerConfidence.level`)."""


class Expected(NamedTuple):
    """Expected SSIM of B predicted spectra, from 0 to 1."""

    ssim: Float[Array, " b"]
    low: Float[Array, " b"]
    """Lower end of the interval, ..."""
    high: Float[Array, " b"]
    """... and its upper end."""


def features(
    pas: Float[Array, "b 90 360"],
    query: Query,
    rx_position: Float[Array, "*#b 3"],
    tx_position: Float[Array, "m 3"],
    power_db: Float[Array, " b"] | None = None,
) -> Float[Array, "b k"]:
    """Returns features that may be correlated with the quality of predicted spectra: the distance to the nearest training
    transmitter; mean and standard deviation of the spectrum, more of which is bright where many paths interfere; the frequency;
    and the received power relative to free space, which indicates how deep in the shadow a transmitter is (0 if not passed)."""
    distance, octave = _distance(query, tx_position), _octave(query)
    mean, spread = jnp.mean(pas, (-2, -1)), jnp.std(pas, (-2, -1))
    beyond = jnp.zeros_like(octave) if power_db is None else _beyond(power_db, query, rx_position)
    return jnp.stack([jnp.log(distance), jnp.log(mean + 1e-3), jnp.log(spread + 1e-3), octave, octave**2, beyond], -1)


def power_features(
    power_db: Float[Array, " b"], query: Query, rx_position: Float[Array, "*#b 3"], tx_position: Float[Array, "m 3"]
) -> Float[Array, "b k"]:
    """Returns features that may be correlated with the errors of received powers: the distance to the nearest training
    transmitter, the power relative to free space, and the frequency."""
    octave = _octave(query)
    beyond = _beyond(power_db, query, rx_position)
    return jnp.stack([jnp.log(_distance(query, tx_position)), beyond, octave, octave**2], -1)


def _distance(query: Query, tx_position: Float[Array, "m 3"]) -> Float[Array, " b"]:
    """Returns the distance (metres) to the nearest training transmitter, which is always positive."""
    offset = query.tx_position[:, None] - tx_position[None]
    return jnp.sqrt(jnp.min(jnp.sum(offset**2, -1), -1) + 1e-4)


def _octave(query: Query) -> Float[Array, " b"]:
    return jnp.log2(query.frequency_hz / 1e10)


def _beyond(power_db: Float[Array, " b"], query: Query, rx_position: Float[Array, "*#b 3"]) -> Float[Array, " b"]:
    # Limits of the received power relative to free space: without any path, the depth of the shadow is undefined.
    limits_db = -100.0, 30.0
    return jnp.clip(beyond_free_space_db(power_db, query.tx_position, rx_position, query.frequency_hz), *limits_db)


def expected_ssim(
    confidence: Confidence,
    pas: Any,
    query: Query,
    power_db: Any = None,
    receiver: Receiver | None = None,
) -> Expected:
    """Returns the expected SSIM of predicted spectra, with intervals; NaN for a transmitter at the receiver, and where measured
    spectra correct the field at other frequencies only.

    Args:
        confidence: the regression.
        pas: the predicted spectra (b, 90, 360).
        query: the queries.
        power_db: the received powers (b,) predicted by the field; if omitted, the mean of the feature that depends on them is
            used.
        receiver: the queried receiver (host); it may be omitted if the regression is for a single one.

    Returns:
        Expected SSIM and the two ends of its prediction interval (b,).

    Raises:
        ValueError: there are several receivers and none is given, it is not one of them, or shapes do not match.
    """
    count = query.tx_position.shape[0]
    pas = jnp.asarray(pas)
    check_array("pas", pas, (count, *PAS_SHAPE))
    if power_db is not None:
        power_db = jnp.asarray(power_db, query.tx_position.dtype)
        check_array("power_db", power_db, (count,))
    if receiver is not None:
        confidence = for_receiver(confidence, receiver)
        if confidence is None:
            raise ValueError("receiver is not in the run's data, and only those that are have intervals; give one of them")
    elif confidence.rx_position.ndim > 1 and len(confidence.rx_position) > 1:
        raise ValueError(f"these intervals are for {len(confidence.rx_position)} receivers; give the queried one as receiver=")
    known = features(pas, query, confidence.rx_position, confidence.tx_position, power_db)
    if power_db is None:
        known = known.at[:, -1].set(confidence.mean[-1])
    error = _log_error(confidence, known)
    low, high = confidence.quantiles
    factors = confidence.surplus, jnp.exp(high), jnp.exp(low)
    valid = _apart(query, confidence.rx_position)
    if len(confidence.frequency_hz):
        apart = jnp.abs(jnp.log(query.frequency_hz[:, None] / confidence.frequency_hz))
        valid &= jnp.min(apart, -1) < SAME_FREQUENCY
    return Expected(*(jnp.where(valid, jnp.clip(1 + MARGIN - jnp.exp(error) * one, 0, 1), jnp.nan) for one in factors))


def expected_power(confidence: PowerConfidence, power_db: Any, query: Query, rx_position: Any) -> ExpectedPower:
    """Returns the expected errors of received powers (dB) that a field predicts for B queries; NaN for a transmitter at the
    receiver.

    Args:
        confidence: the regression.
        power_db: the predicted powers (b,).
        query: the queries.
        rx_position: position (3,) of the receiver, or one per query (b, 3), world frame, metres.

    Returns:
        Expected absolute error and the bound of the prediction interval (b,), dB.

    Raises:
        ValueError: there is not one power per query.
    """
    power_db, rx_position = (jnp.asarray(values, query.tx_position.dtype) for values in (power_db, rx_position))
    check_array("power_db", power_db, (query.tx_position.shape[0],))
    error = _log_error(confidence, power_features(power_db, query, rx_position, confidence.tx_position))
    bounds = (jnp.exp(error) * factor for factor in (confidence.surplus, jnp.exp(confidence.highest)))
    apart = _apart(query, rx_position)
    return ExpectedPower(*(jnp.where(apart, jnp.maximum(decibels - POWER_MARGIN_DB, 0), jnp.nan) for decibels in bounds))


def _apart(query: Query, rx_position: Float[Array, "*#b 3"]) -> Bool[Array, " b"]:
    """Returns which transmitters are not at the receiver."""
    at_receiver_m = 0.1  # up to this distance none can be measured and intervals do not hold
    return jnp.sum((query.tx_position - rx_position) ** 2, -1) > at_receiver_m**2


def _log_error(confidence: Confidence | PowerConfidence, known: Float[Array, "b k"]) -> Float[Array, " b"]:
    """Returns the logarithm of the error that the regression predicts."""
    scaled = scaled_features(known, confidence.mean, confidence.scale)
    return jnp.matmul(scaled, confidence.weights[:-1], precision=EXACT) + confidence.weights[-1]


def scaled_features(known: AnyArray, mean: AnyArray, scale: AnyArray) -> AnyArray:
    """Returns features (n, k) relative to their means (k,) in units of their standard deviations (k,), limited: the regression
    does not extrapolate."""
    most = 4.0  # standard deviations
    return ((known - mean) / scale).clip(-most, most)


def expect_many(
    confidence: Confidence,
    pas: Float[np.ndarray, "n 90 360"],
    tx_position: Float[np.ndarray, "n 3"],
    frequency_hz: Float[np.ndarray, " n"],
    power_db: Float[np.ndarray, " n"] | None = None,
) -> Expected:
    """Returns the expected SSIM of any number of predicted spectra, in blocks of one shape."""

    def of_block(block: Any) -> Expected:
        spectra, tx, hertz, power = jax.tree.map(jnp.asarray, block)
        return _expected(confidence, spectra, Query(Transmitter(tx), hertz), power)

    rows = (pas, tx_position, frequency_hz, power_db)
    rows = jax.tree.map(lambda values: np.asarray(values, np.float32), rows)
    at_once = 16  # number of predictions evaluated at a time
    found: Expected = map_blocks(of_block, rows, at_once, full=True)
    return found


_expected = jax.jit(expected_ssim)


def write_confidence(folder: Path, confidence: Confidence | None, of_powers: PowerConfidence | None = None) -> None:
    """Writes the regressions to a run folder; None writes no file."""
    write_tree(folder / FILE, confidence)
    write_tree(folder / POWER_FILE, of_powers)


def read_confidence(folder: Path) -> Confidence | None:
    """Returns the regression of a run folder, or None. A damaged file, or one of another version, is a `UserError`."""
    return _read(folder / FILE, Confidence, FEATURES, {"level": LEVEL, "frequency_hz": ()})


def read_power_confidence(folder: Path) -> PowerConfidence | None:
    """Returns the regression for powers; otherwise as `read_confidence`."""
    return _read(folder / POWER_FILE, PowerConfidence, POWER_FEATURES, {"level": LEVEL})


def _read(path: Path, cls: type[C], count: int, before: Mapping[str, Any]) -> C | None:
    found = read_tree(path, (cls,), "do without", before)
    if found is not None and found.mean.shape != (count,):
        raise UserError(f"{path} is of another version; remove it to work without prediction intervals, or train again")
    return found
