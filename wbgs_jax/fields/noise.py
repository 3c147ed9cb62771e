"""Noise of observations: what it does to their spectra, and how much of it fields have learned.

White noise n of an array of N elements makes the spectrum of y = h + n brighter than that of the channel h where that is dark:

    E |a^H y|^2 = |a^H h|^2 + N sigma^2

A field that is trained on such spectra learns this floor, one that adds up paths cannot. The floor is taken out of what the
one says, since the channel is asked for, and added where either is compared with observations to learn from that
(`as_observed`). How high it is nobody says, but both tell: spectra of paths are most like the observed ones if the right floor
is added, or a higher one if paths are missing; learned spectra are hardly anywhere darker than the floor, and less like them if
they are raised to a higher one.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from wbgs_jax._util.statistics import standard_error
from wbgs_jax.fields.losses import ssim
from wbgs_jax.fields.trust import Opinions, in_blocks

LEVELS = np.concatenate([[0], np.geomspace(1e-4, 0.1, 31)])
"""Floors that are tried, as shares of the largest square of a spectrum: of less, spectra show hardly anything."""
SURE = 2.0
"""Standard errors over transmitters that spectra have to be more alike with a floor ..."""
HARMLESS = 1.0
"""... and that they may be less so where learned ones are raised to it."""
DARKEST = 0.05
"""Share of the pixels of learned spectra that may be darker than the floor."""
FEWEST_TX = 10
"""Transmitters of which less is no evidence."""
COMPARED = 240
"""Spectra that are looked at."""


def with_floor(pas: Float[Array, "b 90 360"], floor: Float[Array, ""] | float) -> Float[Array, "b 90 360"]:
    """Returns spectra as noise lets them appear; `floor` is N sigma^2 / max |a^H h|^2."""
    return jnp.sqrt((pas**2 + floor) / (1 + floor))


def without_floor(pas: Float[Array, "b 90 360"], floor: Float[Array, ""] | float) -> Float[Array, "b 90 360"]:
    """Returns spectra without what noise has added; of what is darker than the floor nothing remains."""
    square = (1 + floor) * pas**2 - floor
    dark = square <= 0  # the root has no gradient at 0
    return jnp.where(dark, 0, jnp.sqrt(jnp.where(dark, 1, square)))


def at_least_floor(pas: Float[Array, "b 90 360"], floor: Float[Array, ""] | float) -> Float[Array, "b 90 360"]:
    """Returns spectra that are nowhere darker than the floor: what taking it out and adding it again comes to."""
    return jnp.maximum(pas, jnp.sqrt(floor / (1 + floor)))


def floor_of(said: Opinions, observed: Float[np.ndarray, "n 90 360"], tx_index: Int[np.ndarray, " n"]) -> float:
    """Returns the floor that noise puts under N observed spectra (host): the lowest of three accounts; 0 unless the coherent
    field's spectra, which know no noise, are surely more like the observed ones with it.

    Args:
        said: of the links, with the floor in what has been learned.
        observed: spectra.
        tx_index: their transmitters, which are what was drawn.
    """
    looked = np.random.default_rng(0).permutation(np.flatnonzero(_met(said)))[:COMPARED]
    unaware, learned, observed, tx_index = said.coherent[looked], said.informed[looked], observed[looked], tx_index[looked]
    if len(np.unique(tx_index)) < FEWEST_TX:
        return 0.0
    added = in_blocks(_added, unaware, observed)
    best = int(added.mean(0).argmax())
    gain, error = standard_error(added[:, best] - added[:, 0], tx_index)
    if gain <= SURE * error:
        return 0.0
    raised = in_blocks(_raised, learned, observed)
    losses = [standard_error(raised[:, 0] - with_level, tx_index) for with_level in raised.T]
    harmless = max(level for level, (loss, error) in zip(LEVELS, losses, strict=True) if loss <= HARMLESS * error)
    return float(min(LEVELS[best], harmless, np.quantile(learned**2, DARKEST)))


def observed_opinions(said: Opinions, floor: float) -> Opinions:
    """Returns opinions as they would be observed, had those that have learned the floor been without it (host)."""
    own, informed = (at_least_floor(jnp.asarray(learned), floor) for learned in said[1:])
    coherent = jnp.where(_met(said)[:, None, None], with_floor(jnp.asarray(said.coherent), floor), own)
    return Opinions(*(np.asarray(spectra) for spectra in (coherent, own, informed)))


def _met(said: Opinions) -> Bool[np.ndarray, " n"]:
    """Returns on which links the coherent field has an opinion of its own."""
    return np.asarray((said.coherent != said.own).any((-2, -1)))


def _alike(
    change: Callable[..., Array], said: Float[Array, "b 90 360"], observed: Float[Array, "b 90 360"]
) -> Float[Array, "b levels"]:
    """Returns how like the observed spectra others are when every floor has changed them."""
    return jax.lax.map(lambda floor: ssim(change(said, floor), observed), jnp.asarray(LEVELS, said.dtype)).T


_added, _raised = (jax.jit(partial(_alike, change)) for change in (with_floor, at_least_floor))
