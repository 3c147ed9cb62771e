"""How sure an answer is: the SSIM that is expected of it, and an interval that holds the true one nine times out of ten.

    log(1 + margin - SSIM) = w . x + r        x: of the answer alone (`features`),  r: what validation transmitters left

Which features help is found on the validation part, and the interval's ends are quantiles of what is left there (split
conformal prediction, Lei et al. 2018): it holds what it promises where transmitters are drawn as those were, not elsewhere.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax._util.arrays import read_tree, write_tree
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree
from wbgs_jax.radio.channel import beyond_free_space_db
from wbgs_jax.types import Query

MARGIN = 0.02
"""Keeps the logarithm of a perfect score finite."""
LEVEL = 0.9
"""Of the intervals."""
AT_ONCE = 16
"""Answers."""
FILE = "confidence.npz"
FEATURES = 6
BEYOND_FREE_SPACE_DB = -100.0, 30.0
"""What received powers beyond that of free space are cut to: without any path there is no telling how deep the shadow is."""


@pytree
class Confidence:
    """What has been learned about the scores of one receiver's answers."""

    rx_position: Float[Array, "3"]
    tx_position: Float[Array, "m 3"]
    """Of the transmitters that were trained, metres."""
    mean: Float[Array, "k"]
    """Of the features ..."""
    scale: Float[Array, "k"]
    """... and their standard deviations."""
    weights: Float[Array, "k+1"]
    """Of the scaled features and of 1; zero for those that do not help."""
    quantiles: Float[Array, "2"]
    """Lowest and highest r of the interval."""
    surplus: Float[Array, ""]
    """Mean of exp(r)."""


class Expected(NamedTuple):
    """What is expected of B answers."""

    ssim: Float[Array, "b"]
    low: Float[Array, "b"]
    """The interval's lower ..."""
    high: Float[Array, "b"]
    """... and upper end."""


def features(
    pas: Float[Array, "b 90 360"],
    query: Query,
    rx_position: Float[Array, "3"],
    tx_position: Float[Array, "m 3"],
    power_db: Float[Array, "b"] | None = None,
) -> Float[Array, "b k"]:
    """Returns what may tell how good answers are: the distance to the nearest trained transmitter, how much of the hemisphere
    is bright, which it is where many paths interfere, the frequency, and the received power beyond that of free space, which
    says how deep in the shadow a transmitter stands; 0 where it is not given."""
    offset = query.tx_position[:, None] - tx_position[None]
    distance = jnp.sqrt(jnp.min(jnp.sum(offset**2, -1), -1) + 1e-4)
    mean, spread = jnp.mean(pas, (-2, -1)), jnp.std(pas, (-2, -1))
    octave = jnp.log2(query.frequency_hz / 1e10)
    beyond = jnp.zeros_like(octave)
    if power_db is not None:
        excess = beyond_free_space_db(power_db, query.tx_position, rx_position, query.frequency_hz)
        beyond = jnp.clip(excess, *BEYOND_FREE_SPACE_DB)
    return jnp.stack([jnp.log(distance), jnp.log(mean + 1e-3), jnp.log(spread + 1e-3), octave, octave**2, beyond], -1)


def expected_ssim(
    confidence: Confidence, pas: Float[Array, "b 90 360"], query: Query, power_db: Float[Array, "b"] | None = None
) -> Expected:
    """Returns what is expected of answers `pas` to B queries.

    Args:
        confidence: what was learned.
        pas: the answers.
        query: what was asked.
        power_db: the received power that the field says beside them; where it is not given it counts as the usual one.
    """
    known = features(pas, query, confidence.rx_position, confidence.tx_position, power_db)
    scaled = (known - confidence.mean) / confidence.scale
    if power_db is None:
        scaled = scaled.at[:, -1].set(0)
    error = scaled @ confidence.weights[:-1] + confidence.weights[-1]
    low, high = confidence.quantiles
    return Expected(*(1 + MARGIN - jnp.exp(error) * factor for factor in (confidence.surplus, jnp.exp(high), jnp.exp(low))))


def expect_many(
    confidence: Confidence,
    pas: Float[np.ndarray, "n 90 360"],
    tx_position: Float[np.ndarray, "n 3"],
    frequency_hz: Float[np.ndarray, "n"],
    power_db: Float[np.ndarray, "n"] | None = None,
) -> Expected:
    """Returns what is expected of any number of answers, in blocks of one shape."""
    parts = []
    for start in range(0, len(pas), AT_ONCE):
        chosen = np.minimum(np.arange(start, start + AT_ONCE), len(pas) - 1)
        query = Query(jnp.asarray(tx_position[chosen], jnp.float32), jnp.asarray(frequency_hz[chosen], jnp.float32))
        power = None if power_db is None else jnp.asarray(power_db[chosen], jnp.float32)
        parts.append(jax.tree.map(np.asarray, _expected(confidence, jnp.asarray(pas[chosen]), query, power)))
    return jax.tree.map(lambda *blocks: np.concatenate(blocks)[: len(pas)], *parts)


_expected = jax.jit(expected_ssim)


def write_confidence(folder: Path, confidence: Confidence | None) -> None:
    """Leaves it in a run folder, or nothing."""
    write_tree(folder / FILE, confidence)


def read_confidence(folder: Path) -> Confidence | None:
    """Returns that of a run folder; None if it has none. A damaged file, or one of another version, is a `UserError`."""
    found = read_tree(folder / FILE, Confidence, "do without")
    if found is not None and found.mean.shape != (FEATURES,):
        raise UserError(f"{folder / FILE} is of another version; remove it to do without, or train again")
    return found
