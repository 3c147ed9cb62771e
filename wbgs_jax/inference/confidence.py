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
from wbgs_jax._util.pytree import pytree
from wbgs_jax.types import Query

MARGIN = 0.02
"""Keeps the logarithm of a perfect score finite."""
LEVEL = 0.9
"""Of the intervals."""
AT_ONCE = 16
"""Answers."""
FILE = "confidence.npz"


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


def features(pas: Float[Array, "b 90 360"], query: Query, tx_position: Float[Array, "m 3"]) -> Float[Array, "b k"]:
    """Returns what may tell how good answers are: the distance to the nearest trained transmitter, the frequency, and how much
    of the hemisphere is bright, which it is where many paths interfere."""
    offset = query.tx_position[:, None] - tx_position[None]
    distance = jnp.sqrt(jnp.min(jnp.sum(offset**2, -1), -1) + 1e-4)
    mean, spread = jnp.mean(pas, (-2, -1)), jnp.std(pas, (-2, -1))
    octave = jnp.log2(query.frequency_hz / 1e10)
    return jnp.stack([jnp.log(distance), jnp.log(mean + 1e-3), jnp.log(spread + 1e-3), octave, octave**2], -1)


def expected_ssim(confidence: Confidence, pas: Float[Array, "b 90 360"], query: Query) -> Expected:
    """Returns what is expected of answers `pas` to B queries."""
    scaled = (features(pas, query, confidence.tx_position) - confidence.mean) / confidence.scale
    error = scaled @ confidence.weights[:-1] + confidence.weights[-1]
    low, high = confidence.quantiles
    return Expected(*(1 + MARGIN - jnp.exp(error) * factor for factor in (confidence.surplus, jnp.exp(high), jnp.exp(low))))


def expect_many(
    confidence: Confidence,
    pas: Float[np.ndarray, "n 90 360"],
    tx_position: Float[np.ndarray, "n 3"],
    frequency_hz: Float[np.ndarray, "n"],
) -> Expected:
    """Returns what is expected of any number of answers, in blocks of one shape."""
    parts = []
    for start in range(0, len(pas), AT_ONCE):
        chosen = np.minimum(np.arange(start, start + AT_ONCE), len(pas) - 1)
        query = Query(jnp.asarray(tx_position[chosen], jnp.float32), jnp.asarray(frequency_hz[chosen], jnp.float32))
        parts.append(jax.tree.map(np.asarray, _expected(confidence, jnp.asarray(pas[chosen]), query)))
    return jax.tree.map(lambda *blocks: np.concatenate(blocks)[: len(pas)], *parts)


_expected = jax.jit(expected_ssim)


def write_confidence(folder: Path, confidence: Confidence | None) -> None:
    """Leaves it in a run folder, or nothing."""
    write_tree(folder / FILE, confidence)


def read_confidence(folder: Path) -> Confidence | None:
    """Returns that of a run folder; None if it has none. A damaged file is a `UserError`."""
    return read_tree(folder / FILE, Confidence, "do without")
