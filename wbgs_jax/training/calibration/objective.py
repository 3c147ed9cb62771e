"""How badly candidates for a field's parameters explain some training spectra, and whether one is surely better: what the
searches before a training, and the choices after it, compare."""

import functools
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.stats import norm, permutation_test

from wbgs_jax._util.statistics import by_transmitter, standard_error
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import PreparedPaths, WaveParams
from wbgs_jax.fields.losses import log_decorrelation, surprise
from wbgs_jax.training.batches import TrainingData
from wbgs_jax.types import Batch, Links

AT_ONCE = 8
"""Spectra."""
SIDE_BY_SIDE = 32, 6
"""Candidates. Compiling a program takes as long as scoring ten thousand, so that there are two for all numbers of them."""
POWER_MARGIN_DB = 1.0
"""What powers are not expected to be nearer than, so that the logarithm of a lucky hit says little."""
RAREST = 1e-4
"""Chance that SciPy's 9,999 random flips can tell from none."""
FEWEST_SURE = 5
"""Transmitters of which less proves nothing: the signs of three agree by chance once in eight times."""
ALIKE = 1e-6
"""Mean absolute error of spectra below which none is better than another."""
Compared = Literal["snapshots", "covariances", "spectra", "powers"]
"""What is compared: snapshots as if every phase were known (log decorrelation), snapshots as far as candidates know phases
(`losses.surprise`), spectra (log mean absolute error), as also where nothing else is known, or powers (log absolute error in
dB), as always where they are all that is known. A link on which nothing was heard scores the same, whatever the candidate."""


@runtime_checkable
class Scores(Protocol):
    """How badly candidates for all parameters explain some spectra."""

    def __call__(self, candidates: Sequence[WaveParams], first: int | None = None) -> Float[np.ndarray, "k n"]:
        """Returns the scores of K candidates on all of the spectra, or on the first so many."""
        ...


def make_scores(
    field: Calibratable,
    prepared: PreparedPaths,
    data: TrainingData,
    spectra: Int[Array, " n"],
    compared: Compared = "snapshots",
) -> Scores:
    """Returns the function that scores candidates on some spectra. What leaves say that all candidates share
    (the very same arrays) is computed once for all of them."""

    @functools.cache
    def block(start: int) -> tuple[PreparedPaths, Batch]:
        """Returns what is looked at of so many spectra; the last block repeats its last."""
        own = spectra[np.minimum(np.arange(start, start + AT_ONCE), len(spectra) - 1)]
        return _looked_at(field, prepared, data, own)

    def score(candidates: Sequence[WaveParams], first: int | None = None) -> Float[np.ndarray, "k n"]:
        room = next((room for room in SIDE_BY_SIDE if room <= len(candidates)), SIDE_BY_SIDE[-1])
        if len(candidates) > room:
            return np.concatenate([score(candidates[:room], first), score(candidates[room:], first)])
        structure, asked = jax.tree.structure(candidates[0]), len(spectra[:first])
        columns = list(zip(*(jax.tree.leaves(candidate) for candidate in candidates), strict=True))
        differ = tuple(any(leaf is not column[0] for leaf in column) for column in columns)
        differ = _as_compiled(differ, compared, candidates[0], field, block(0))
        padded = [column + column[-1:] * (room - len(candidates)) for column in columns]
        leaves = tuple(jnp.stack(column) if own else column[0] for own, column in zip(differ, padded, strict=True))
        found = [_score(field, structure, differ, leaves, *block(start), compared) for start in range(0, asked, AT_ONCE)]
        together = np.concatenate([np.asarray(own) for own in found], 1)[: len(candidates), :asked]
        return together if any(differ) else np.repeat(together, len(candidates), 0)

    return score


@dataclass(frozen=True)
class Told:
    """Some training spectra, and what they say of a field with the paths of their transmitters."""

    field: Calibratable
    prepared: PreparedPaths
    data: TrainingData
    spectra: Int[np.ndarray, " n"]
    """In the order in which they are looked at."""

    def scores(self, count: int | None = None, compared: Compared = "snapshots", highest_hz: float = np.inf) -> Scores:
        """Returns the function that scores candidates on the first of those up to a frequency."""
        own = self.spectra[self.frequency_hz() <= highest_hz * (1 + 1e-6)][:count]
        return make_scores(self.field, self.prepared, self.data, jnp.asarray(own, jnp.int32), compared)

    def frequency_hz(self) -> Float[np.ndarray, " n"]:
        """Returns their frequencies."""
        return np.asarray(self.data.links.query.frequency_hz)[self.spectra]

    def tx_index(self, count: int | None = None) -> Int[np.ndarray, " k"]:
        """Returns the transmitters of the first of them."""
        return np.asarray(self.data.links.tx_index)[self.spectra[:count]]


_programs: dict[Hashable, list[tuple[bool, ...]]] = {}
"""Which leaves differ between the candidates that programs score, by all else that these depend on."""


def _as_compiled(differ: tuple[bool, ...], compared: Compared, *trees: Any) -> tuple[bool, ...]:
    """Returns which leaves to take for different: those that are, or more of them, where there is a program for these."""
    shapes = ((jax.tree.structure(tree), *map(np.shape, jax.tree.leaves(tree))) for tree in trees)
    known = _programs.setdefault((compared, *shapes), [])
    wider = [one for one in known if all(own or not needed for own, needed in zip(one, differ, strict=True))]
    if not wider:
        known.append(differ)
    return min(wider, key=sum, default=differ)


@jax.jit
def _looked_at(
    field: Calibratable, prepared: PreparedPaths, data: TrainingData, spectra: Int[Array, " m"]
) -> tuple[PreparedPaths, Batch]:
    """Returns what is prepared of a block of spectra, and what was observed: a batch of one link each."""
    links: Links = jax.tree.map(lambda leaf: leaf[spectra], data.links)
    return prepared.subset(links), jax.vmap(lambda link: data.batch(link[None], jax.random.key(0)))(spectra)


@functools.partial(jax.jit, static_argnames=("structure", "differ", "compared"))
def _score(
    field: Calibratable,
    structure: jax.tree_util.PyTreeDef,
    differ: tuple[bool, ...],
    leaves: tuple[Array, ...],
    prepared: PreparedPaths,
    batches: Batch,
    compared: Compared,
) -> Float[Array, "k m"]:
    """Returns the scores of K candidates whose leaves that differ have a leading axis; of one, where none does."""

    def compare(batch: Batch, leaves: tuple[Array, ...]) -> Float[Array, ""]:
        params = jax.tree.unflatten(structure, leaves)
        seen = field.render(params, field.plan(params, batch.receiver, prepared), batch.links)
        elements = 0 if batch.snapshots is None else batch.snapshots.shape[-1]
        several = batch.snapshots if elements > 1 else None  # that of a single element tells its power only
        if several is not None and compared == "snapshots" and seen.snapshots is not None:
            return log_decorrelation(seen.snapshots, several)[0]
        if several is not None and compared == "covariances" and seen.covariance is not None:
            return surprise(seen.covariance, several)[0]
        if batch.pas is None or compared == "powers" or elements == 1:
            received = batch.received_db
            assert received is not None and seen.power_db is not None, "images are searched by spectra"
            unlike = jnp.log(POWER_MARGIN_DB + jnp.abs(seen.power_db - received)[0])
            return unlike if batch.snapshots is None else jnp.where(jnp.any(batch.snapshots != 0), unlike, 0)
        unlike = jnp.log(jnp.maximum(jnp.mean(jnp.abs(seen.pas - batch.pas)), ALIKE))
        return jnp.where(jnp.max(batch.pas) > 0, unlike, 0)

    def one(batch: Batch) -> Float[Array, " k"]:
        if not any(differ):
            return compare(batch, leaves)[None]
        axes = tuple(0 if own else None for own in differ)
        return jax.vmap(lambda *leaves: compare(batch, leaves), axes)(*leaves)

    return jax.vmap(one)(batches).T


def surely_better(gains: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"], errors: float) -> bool:
    """Returns whether the mean gain over transmitters is positive, as surely as so many standard errors of a normal mean say.

    Signs are flipped transmitter by transmitter (Fisher's randomisation test): gains of logarithms have long tails, and a
    t statistic doubts 20 gains that are all positive because one of them is large. Fewer than 10 transmitters are never sure at
    three errors, fewer than `FEWEST_SURE` at none. Gains that are not finite are not sure. Where so many errors mean less than
    one chance in ten thousand, which is as few as random flips can tell, the errors themselves are counted.
    """
    by_tx = by_transmitter(gains, tx_index)
    if len(by_tx) < FEWEST_SURE or not np.isfinite(by_tx).all():
        return False
    if norm.sf(errors) < RAREST:
        gain, error = standard_error(gains, tx_index)
        return gain > errors * error
    chance = permutation_test((by_tx,), np.mean, permutation_type="samples", alternative="greater", random_state=0).pvalue
    return bool(chance <= norm.sf(errors))
