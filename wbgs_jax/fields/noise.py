"""Noise of observations: what it does to their spectra, and how much of it fields have learned.

White noise n of an array of N elements makes the spectrum of y = h + n brighter than that of the channel h where that is dark:

    E |a^H y|^2 = |a^H h|^2 + N sigma^2

A field that is trained on such spectra learns this floor, one that adds up paths cannot. The floor is taken out of what the one
says, since the channel is asked for, and added wherever either is compared with observations. How high it is nobody says, but
both tell: spectra of paths are most like the observed ones if the right floor is added, or a higher one if paths are missing;
learned spectra, hardly ever darker than the floor, are less like them if they are raised to a higher one.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wbgs_jax._util.statistics import standard_error
from wbgs_jax.fields.losses import ssim

LEVELS = np.concatenate([[0], np.geomspace(1e-4, 0.1, 31)])
"""Floors that are tried, as shares of the largest square of a spectrum: of less, spectra show hardly anything."""
SURE = 2.0
"""Standard errors over transmitters that spectra have to be more alike with a floor."""
COMPARED = 240
"""Spectra that are looked at."""
BLOCK = 48
"""Spectra that are compared at once."""


def with_floor(pas: Float[Array, "b 90 360"], floor: Float[Array, ""] | float) -> Float[Array, "b 90 360"]:
    """Returns spectra as noise lets them appear; `floor` is N sigma^2 / max |a^H h|^2."""
    return jnp.sqrt((pas**2 + floor) / (1 + floor))


def without_floor(pas: Float[Array, "b 90 360"], floor: Float[Array, ""] | float) -> Float[Array, "b 90 360"]:
    """Returns spectra without what noise has added; of what is darker than the floor nothing remains."""
    square = jnp.maximum((1 + floor) * pas**2 - floor, 0)
    positive = square > 0  # the root has no gradient at 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)


def at_least_floor(pas: Float[Array, "b 90 360"], floor: Float[Array, ""] | float) -> Float[Array, "b 90 360"]:
    """Returns spectra that are nowhere darker than the floor: what taking it out and adding it again comes to."""
    return jnp.maximum(pas, jnp.sqrt(floor / (1 + floor)))


def floor_of(
    unaware: Float[np.ndarray, "n 90 360"],
    learned: Float[np.ndarray, "n 90 360"],
    observed: Float[np.ndarray, "n 90 360"],
    tx_index: Int[np.ndarray, " n"],
) -> float:
    """Returns the floor that noise puts under N observed spectra (host); 0 unless those of a field that knows no noise are
    surely more like them with it.

    Args:
        unaware: what a field says that cannot have learned it.
        learned: what a field says that was trained on such spectra.
        observed: spectra.
        tx_index: their transmitters, which are what was drawn.
    """
    looked = np.random.default_rng(0).permutation(len(observed))[:COMPARED]
    unaware, learned, observed = unaware[looked], learned[looked], observed[looked]
    added = np.concatenate([np.asarray(_added(*block)) for block in _blocks(unaware, observed)])
    highest = int(added.mean(0).argmax())
    gain, error = standard_error(added[:, highest] - added[:, 0], tx_index[looked])
    if gain <= SURE * error:
        return 0.0
    raised = np.concatenate([np.asarray(_raised(*block)) for block in _blocks(learned, observed)])
    return float(LEVELS[min(highest, int(raised.mean(0).argmax()))])


def _blocks(said: np.ndarray, observed: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    starts = range(0, len(said), BLOCK)
    return [(said[start : start + BLOCK], observed[start : start + BLOCK]) for start in starts]


def _alike(change: Any, said: Float[Array, "b 90 360"], observed: Float[Array, "b 90 360"]) -> Float[Array, "b levels"]:
    """Returns how like the observed spectra others are when every floor has changed them."""
    return jax.lax.map(lambda floor: ssim(change(said, floor), observed), jnp.asarray(LEVELS, said.dtype)).T


_added, _raised = (jax.jit(partial(_alike, change)) for change in (with_floor, at_least_floor))
