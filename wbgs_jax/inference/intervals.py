"""How sure an answer is: the SSIM that is expected of it, and an interval that holds the true one nine times out of ten; of a
received power, how many decibels it is expected to be off, and within how many it is right nine times out of ten.

    log(1 + margin - SSIM) = w . x + r        x: of the answer alone (`features`),  r: what validation transmitters left
    log(margin + |error|)  = w . x + r        x: `power_features`

Which features help is found on the validation part, and the interval's ends are quantiles of what is left there (split
conformal prediction, Lei et al. 2018): it holds what it promises where transmitters are drawn as those were, not elsewhere. A
hybrid field's shares, a few numbers, were learned on the same transmitters, for which its answers are a little better.
"""

from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax._util.arrays import read_tree, write_tree
from wbgs_jax._util.blocks import map_blocks
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree
from wbgs_jax.radio.array import EXACT
from wbgs_jax.radio.channel import beyond_free_space_db
from wbgs_jax.types import Query

MARGIN = 0.02
"""Keeps the logarithm of a perfect score finite."""
LEVEL = 0.9
"""Of the intervals."""
AT_ONCE = 16
"""Answers."""
POWER_MARGIN_DB = 0.1
"""Keeps the logarithm of a perfect power finite."""
FILE, POWER_FILE = "confidence.npz", "power_confidence.npz"
FEATURES, POWER_FEATURES = 6, 4
BEYOND_FREE_SPACE_DB = -100.0, 30.0
"""What received powers beyond that of free space are cut to: without any path there is no telling how deep the shadow is."""


@pytree
class Confidence:
    """What has been learned about the scores of answers, over all receivers of the data alike."""

    rx_position: Float[Array, "*r 3"]
    """Of the receivers, metres; of one alone where answers are asked for (`kriging.for_receiver`)."""
    tx_position: Float[Array, "m 3"]
    """Of the transmitters that were trained, metres."""
    mean: Float[Array, " k"]
    """Of the features ..."""
    scale: Float[Array, " k"]
    """... and their standard deviations."""
    weights: Float[Array, " k+1"]
    """Of the scaled features and of 1; zero for those that do not help."""
    quantiles: Float[Array, "2"]
    """Lowest and highest r of the interval."""
    surplus: Float[Array, ""]
    """Mean of exp(r)."""
    level: Float[Array, ""]
    """Chance that a score lies within the interval: `LEVEL`, or what exists of the transmitters that were held out."""


@pytree
class PowerConfidence:
    """What has been learned about the errors of received powers, over all receivers alike."""

    tx_position: Float[Array, "m 3"]
    """Of the transmitters that were trained, metres."""
    mean: Float[Array, " k"]
    """Of the features ..."""
    scale: Float[Array, " k"]
    """... and their standard deviations."""
    weights: Float[Array, " k+1"]
    """Of the scaled features and of 1; zero for those that do not help."""
    highest: Float[Array, ""]
    """What r is at most."""
    surplus: Float[Array, ""]
    """Mean of exp(r)."""
    level: Float[Array, ""]
    """Chance that it is: `LEVEL`, or what exists of the transmitters that were held out."""


C = TypeVar("C", Confidence, PowerConfidence)


class ExpectedPower(NamedTuple):
    """What is expected of B received powers."""

    error_db: Float[Array, " b"]
    """Mean absolute error."""
    within_db: Float[Array, " b"]
    """What the absolute error stays below nine times out of ten."""


class Expected(NamedTuple):
    """What is expected of B answers."""

    ssim: Float[Array, " b"]
    low: Float[Array, " b"]
    """The interval's lower ..."""
    high: Float[Array, " b"]
    """... and upper end."""


def features(
    pas: Float[Array, "b 90 360"],
    query: Query,
    rx_position: Float[Array, "*#b 3"],
    tx_position: Float[Array, "m 3"],
    power_db: Float[Array, " b"] | None = None,
) -> Float[Array, "b k"]:
    """Returns what may tell how good answers are: the distance to the nearest trained transmitter, how much of the hemisphere
    is bright, which it is where many paths interfere, the frequency, and the received power beyond that of free space, which
    says how deep in the shadow a transmitter stands; 0 where it is not given."""
    distance, octave = _distance(query, tx_position), _octave(query)
    mean, spread = jnp.mean(pas, (-2, -1)), jnp.std(pas, (-2, -1))
    beyond = jnp.zeros_like(octave) if power_db is None else _beyond(power_db, query, rx_position)
    return jnp.stack([jnp.log(distance), jnp.log(mean + 1e-3), jnp.log(spread + 1e-3), octave, octave**2, beyond], -1)


def power_features(
    power_db: Float[Array, " b"], query: Query, rx_position: Float[Array, "*#b 3"], tx_position: Float[Array, "m 3"]
) -> Float[Array, "b k"]:
    """Returns what may tell how good received powers are: the distance to the nearest trained transmitter, the power beyond
    that of free space, and the frequency."""
    octave = _octave(query)
    beyond = _beyond(power_db, query, rx_position)
    return jnp.stack([jnp.log(_distance(query, tx_position)), beyond, octave, octave**2], -1)


def _distance(query: Query, tx_position: Float[Array, "m 3"]) -> Float[Array, " b"]:
    """Returns how far (metres) the nearest trained transmitter is, never nothing."""
    offset = query.tx_position[:, None] - tx_position[None]
    return jnp.sqrt(jnp.min(jnp.sum(offset**2, -1), -1) + 1e-4)


def _octave(query: Query) -> Float[Array, " b"]:
    return jnp.log2(query.frequency_hz / 1e10)


def _beyond(power_db: Float[Array, " b"], query: Query, rx_position: Float[Array, "*#b 3"]) -> Float[Array, " b"]:
    return jnp.clip(beyond_free_space_db(power_db, query.tx_position, rx_position, query.frequency_hz), *BEYOND_FREE_SPACE_DB)


def expected_ssim(
    confidence: Confidence, pas: Float[Array, "b 90 360"], query: Query, power_db: Float[Array, " b"] | None = None
) -> Expected:
    """Returns what is expected of answers `pas` to B queries.

    Args:
        confidence: what was learned, of the receiver that was asked.
        pas: the answers.
        query: what was asked.
        power_db: the received power that the field says beside them; where it is not given it counts as the usual one.
    """
    known = features(pas, query, confidence.rx_position, confidence.tx_position, power_db)
    if power_db is None:
        known = known.at[:, -1].set(confidence.mean[-1])
    error = _log_error(confidence, known)
    low, high = confidence.quantiles
    return Expected(*(1 + MARGIN - jnp.exp(error) * factor for factor in (confidence.surplus, jnp.exp(high), jnp.exp(low))))


def expected_power(
    confidence: PowerConfidence, power_db: Float[Array, " b"], query: Query, rx_position: Float[Array, "*#b 3"]
) -> ExpectedPower:
    """Returns what is expected of the received powers (dB) that a field says of B queries.

    Args:
        confidence: what was learned.
        power_db: the answers.
        query: what was asked.
        rx_position: of the receiver, or of every query's own, world frame, metres.
    """
    error = _log_error(confidence, power_features(power_db, query, rx_position, confidence.tx_position))
    said = (jnp.exp(error) * factor for factor in (confidence.surplus, jnp.exp(confidence.highest)))
    return ExpectedPower(*(jnp.maximum(decibels - POWER_MARGIN_DB, 0) for decibels in said))


def _log_error(confidence: Confidence | PowerConfidence, known: Float[Array, "b k"]) -> Float[Array, " b"]:
    """Returns the logarithm of the error that features let expect."""
    scaled = (known - confidence.mean) / confidence.scale
    return jnp.matmul(scaled, confidence.weights[:-1], precision=EXACT) + confidence.weights[-1]


def expect_many(
    confidence: Confidence,
    pas: Float[np.ndarray, "n 90 360"],
    tx_position: Float[np.ndarray, "n 3"],
    frequency_hz: Float[np.ndarray, " n"],
    power_db: Float[np.ndarray, " n"] | None = None,
) -> Expected:
    """Returns what is expected of any number of answers, in blocks of one shape."""

    def of_block(block: Any) -> Expected:
        spectra, tx, hertz, power = jax.tree.map(jnp.asarray, block)
        return _expected(confidence, spectra, Query(tx, hertz), power)

    rows = (pas, tx_position, frequency_hz, power_db)
    found: Expected = map_blocks(of_block, jax.tree.map(lambda values: np.asarray(values, np.float32), rows), AT_ONCE)
    return found


_expected = jax.jit(expected_ssim)


def write_confidence(folder: Path, confidence: Confidence | None, of_powers: PowerConfidence | None = None) -> None:
    """Leaves it in a run folder, or nothing."""
    write_tree(folder / FILE, confidence)
    write_tree(folder / POWER_FILE, of_powers)


def read_confidence(folder: Path) -> Confidence | None:
    """Returns that of a run folder; None if it has none. A damaged file, or one of another version, is a `UserError`."""
    return _read(folder / FILE, Confidence, FEATURES)


def read_power_confidence(folder: Path) -> PowerConfidence | None:
    """Returns that of powers; otherwise as `read_confidence`."""
    return _read(folder / POWER_FILE, PowerConfidence, POWER_FEATURES)


def _read(path: Path, cls: type[C], count: int) -> C | None:
    found = read_tree(path, (cls,), "do without", {"level": LEVEL})
    if found is not None and found.mean.shape != (count,):
        raise UserError(f"{path} is of another version; remove it to do without, or train again")
    return found
