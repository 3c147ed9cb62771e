"""Noise on observed snapshots, and what it does to their spectra.

White noise n of an array of N elements makes the spectrum of y = h + n brighter than that of the channel h where that is dark:

    E |a^H y|^2 = |a^H h|^2 + N sigma^2

A field that is trained on such spectra has learned the second term, one that adds up paths has not. Whichever explains noisy
spectra better is then not the one that is nearer to the channel, unless the term is added to what lacks it. Nobody says how
strong the noise is; it is not more than what the best of many snapshots leave unexplained, and it is believed only if spectra
are explained better with it.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from wbgs_jax._util.statistics import standard_error
from wbgs_jax.fields.losses import ssim
from wbgs_jax.radio.array import cbf, pas_directions, steering_vector
from wbgs_jax.radio.channel import correlation, unit_snapshots

BEST = 0.02
"""Share of the snapshots: those that are explained best. All of what is left of these is taken for noise."""
LEAST = 2e-3
"""Share of the power: of less, spectra show hardly anything, and fields that are right leave as much."""
SURE = 2.0
"""Standard errors over transmitters that spectra have to be explained better by."""
BLOCK = 64
"""Spectra that are compared at once."""


@jax.jit
def unexplained(predicted: Complex[Array, "b elements"], observed: Complex[Array, "b elements"]) -> Float[Array, " b"]:
    """Returns the share of the power of B observed snapshots that is no multiple of the predicted ones, 0 to 1."""
    return 1 - correlation(predicted, observed) ** 2


@jax.jit
def floor_of(
    snapshots: Complex[Array, "b elements"], element_positions: Float[Array, "elements 3"] | Float[Array, "b elements 3"]
) -> Float[Array, " b"]:
    """Returns N sigma^2 / max |a^H y|^2 of B snapshots, were all of their power noise; of a silent one 0.

    Element positions are in wavelengths.
    """
    directions = jnp.asarray(pas_directions(), element_positions.dtype)

    def peak_of(unit: Complex[Array, " elements"], positions: Float[Array, "elements 3"]) -> Float[Array, ""]:
        return jnp.max(cbf(unit, steering_vector(positions, directions))) ** 2  # 1 or more, but for noise

    each = (0, 0 if element_positions.ndim == 3 else None)
    peak = jax.vmap(peak_of, each)(unit_snapshots(snapshots)[0], element_positions)
    return jnp.where(peak > 0, 1 / jnp.maximum(peak, 1), 0)


def with_noise(pas: Float[Array, "b 90 360"], floor: Float[Array, " b"]) -> Float[Array, "b 90 360"]:
    """Returns spectra as noise lets them appear in the mean of their squares; `floor` is N sigma^2 / max |a^H h|^2."""
    floor = floor[:, None, None]
    return jnp.sqrt((pas**2 + floor) / (1 + floor))


def noise_share(
    left: Float[np.ndarray, " n"],
    floor: Float[np.ndarray, " n"],
    predicted: Float[np.ndarray, "n 90 360"],
    observed: Float[np.ndarray, "n 90 360"],
    tx_index: Int[np.ndarray, " n"],
) -> float:
    """Returns which share of the power of N observed snapshots is noise (host): 0 unless spectra that were predicted without
    any are surely more like the observed ones with it.

    Args:
        left: `unexplained` of the snapshots.
        floor: `floor_of` them.
        predicted: spectra without noise.
        observed: spectra.
        tx_index: their transmitters, which are what was drawn.
    """
    heard = floor > 0
    share = float(np.quantile(left[heard], BEST)) if heard.any() else 0.0
    if share < LEAST:
        return 0.0
    gains = np.concatenate(
        [
            np.asarray(_gains(predicted[own], observed[own], share * floor[own]))
            for own in (slice(start, start + BLOCK) for start in range(0, len(left), BLOCK))
        ]
    )
    gain, error = standard_error(gains, tx_index)
    return share if gain > SURE * error else 0.0


@jax.jit
def _gains(predicted: Array, observed: Array, floor: Array) -> Float[Array, " b"]:
    return ssim(with_noise(predicted, floor), observed) - ssim(predicted, observed)
