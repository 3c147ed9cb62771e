"""Scores of candidate parameters of a field on training spectra, and the test whether one candidate is significantly better,
for calibration before training and selections after it. Lower scores are better.

`search_placement` finds the first estimate of position_std, common to all surfaces and the transmitters. A surface that is
displaced by more than a tenth of a wavelength contains no information about phases, and a field that takes its position as
exact is less accurate than one that adds powers. The estimate fits spectra best; training refines it for each rigid body.
"""

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num
from scipy.stats import norm, permutation_test

from wbgs_jax._util.pytree import AnyArray
from wbgs_jax._util.statistics import by_transmitter, standard_error
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import (
    PreparedPaths,
    WaveParams,
    path_arrivals,
    path_covariances,
    phase_blind_pas,
    snapshots_of,
    spectra_of,
)
from wbgs_jax.fields.losses import log_decorrelation, surprise
from wbgs_jax.radio.channel import decibels
from wbgs_jax.training.batches import TrainingData
from wbgs_jax.types import Batch, Links

AT_ONCE = 8
"""Number of spectra that are scored together."""
MOST = 32
"""Maximum number of candidates that one call of a program scores."""
FEWEST_SURE = 5
"""Minimum number of transmitters for significance: the signs of three are all positive by chance in one of eight cases."""
Compared = Literal["snapshots", "covariances", "spectra", "powers"]
"""The compared quantity: "snapshots" with exact phases (log decorrelation); "covariances" for the negative log-likelihood of
snapshots given the uncertainty of phases (`losses.surprise`); "spectra" (log mean absolute error), which is also used if there
are no snapshots; "powers" (log absolute error in dB), which is always used if there is nothing else. A link on which nothing
was received has the same score for every candidate."""


Predicted = Literal["snapshots", "power_db"]
"""A quantity of `fields.base.Observation` that `predicted` returns."""


@runtime_checkable
class Scores(Protocol):
    """Function that scores candidate parameters on spectra."""

    def __call__(self, candidates: Sequence[WaveParams], first: int | None = None) -> Float[np.ndarray, "k n"]:
        """Returns the scores of K candidates on all of the spectra, or on the `first` ones; lower is better."""
        ...


def make_scores(
    field: Calibratable,
    prepared: PreparedPaths,
    data: TrainingData,
    spectra: Int[AnyArray, " n"],
    compared: Compared = "snapshots",
) -> Scores:
    """Returns the function that scores candidates on spectra.

    Args:
        field: field.
        prepared: its paths.
        data: training data.
        spectra: indices of the links.
        compared: the compared quantity.
    """
    quantity, spectra = comparable(compared, data), np.asarray(spectra, np.int32)
    assert quantity != "powers" or field.config.coherent, "a field without phases predicts no power"
    by = np.int32(get_args(Compared).index(quantity))

    @functools.cache
    def common() -> tuple[Calibratable, PreparedPaths]:
        return field.in_common_shapes(prepared, data.receivers.element_positions.shape[-2])

    @functools.cache
    def block(start: int) -> tuple[PreparedPaths, Batch]:
        """Returns the data of the block of spectra from `start` on; the last block is padded by repeating the last spectrum."""
        own = spectra[np.minimum(np.arange(start, start + AT_ONCE), len(spectra) - 1)]
        return _looked_at(common()[1], data, own)

    def score(candidates: Sequence[WaveParams], first: int | None = None) -> Float[np.ndarray, "k n"]:
        if len(candidates) > MOST:
            return np.concatenate([score(candidates[:MOST], first), score(candidates[MOST:], first)])
        structure, count = jax.tree.structure(candidates[0]), len(spectra[:first])
        columns = list(zip(*(jax.tree.leaves(candidate) for candidate in candidates), strict=True))
        own = tuple(np.ndim(column[0]) < 2 or any(leaf is not column[0] for leaf in column) for column in columns)
        # On the host: operations of JAX would each be compiled, behind large programs that are compiled in the background.
        leaves = tuple(_rows(column) if varies else np.asarray(column[0]) for varies, column in zip(own, columns, strict=True))
        leaves = tuple(jax.tree.leaves(field.params_in_common_shapes(jax.tree.unflatten(structure, leaves))))
        slim, some = common()[0], np.int32(len(candidates))
        found = [_score(slim, structure, own, leaves, some, *block(start), by) for start in range(0, count, AT_ONCE)]
        return np.concatenate([np.asarray(part) for part in found], 1)[: len(candidates), :count]

    return score


@dataclass(frozen=True)
class CalibrationProblem:
    """Training spectra on which candidates are scored, with a field and the paths of their transmitters."""

    field: Calibratable
    prepared: PreparedPaths
    data: TrainingData
    spectra: Int[np.ndarray, " n"]
    """Indices of the links, in the order of use."""

    def scores(self, count: int | None = None, compared: Compared = "snapshots", highest_hz: float = np.inf) -> Scores:
        """Returns the function that scores candidates on the first `count` of the spectra up to a frequency."""
        own = self.spectra[self.frequency_hz() <= highest_hz * (1 + 1e-6)][:count]
        return make_scores(self.field, self.prepared, self.data, own, compared)

    def frequency_hz(self) -> Float[np.ndarray, " n"]:
        """Returns the frequencies of the spectra."""
        return np.asarray(self.data.links.frequency_hz)[self.spectra]

    def tx_index(self, count: int | None = None) -> Int[np.ndarray, " k"]:
        """Returns the transmitters of the first `count` spectra."""
        return np.asarray(self.data.links.tx_index)[self.spectra[:count]]


def predicted(problem: CalibrationProblem, params: WaveParams, quantity: Predicted) -> Num[np.ndarray, "n ..."]:
    """Returns the snapshots (n, elements) or the received powers (n,), dB, that a field predicts for the spectra of a problem
    (host)."""
    spectra = problem.spectra
    padded = jnp.asarray(np.resize(spectra, -(-len(spectra) // AT_ONCE) * AT_ONCE), jnp.int32)  # repeated to whole blocks
    return np.asarray(_predicted(problem.field, params, problem.prepared, problem.data, padded, quantity))[: len(spectra)]


@functools.partial(jax.jit, static_argnames="quantity")
def _predicted(
    field: Calibratable,
    params: WaveParams,
    prepared: PreparedPaths,
    data: TrainingData,
    spectra: Int[Array, " n"],
    quantity: Predicted,
) -> Num[Array, "n ..."]:
    def one(link: Int[Array, ""]) -> Array:
        batch = data.batch(link[None], jax.random.key(0))
        seen = field.render(params, field.plan(params, batch.receiver, prepared), batch.links)
        found: Array = getattr(seen, quantity)
        return found[0]

    found: Num[Array, "n ..."] = jax.lax.map(one, spectra, batch_size=AT_ONCE)
    return found


def comparable(compared: Compared, data: TrainingData) -> Compared:
    """Returns what is compared instead if data do not contain it."""
    elements = 0 if data.snapshots is None else data.snapshots.shape[-1]
    if elements == 1 or not data.has_spectra:  # the snapshot of a single element contains its power only
        return "powers"
    return compared if elements or compared == "powers" else "spectra"


def _rows(column: Sequence[Array]) -> Float[np.ndarray, "..."]:
    """Returns a leaf of all candidates, padded with zeros to `MOST` rows."""
    rows = np.zeros((MOST, *np.shape(column[0])), np.float32)
    rows[: len(column)] = column[0] if all(leaf is column[0] for leaf in column) else [np.asarray(leaf) for leaf in column]
    return rows


@jax.jit
def _looked_at(prepared: PreparedPaths, data: TrainingData, spectra: Int[Array, " m"]) -> tuple[PreparedPaths, Batch]:
    """Returns the prepared paths of a block of spectra, and their observations: a batch of one link each."""
    links: Links = jax.tree.map(lambda leaf: leaf[spectra], data.links)
    return prepared.subset(links), jax.vmap(lambda link: data.batch(link[None], jax.random.key(0)))(spectra)


@functools.partial(jax.jit, static_argnames=("structure", "own"))
def _score(
    field: Calibratable,
    structure: jax.tree_util.PyTreeDef,
    own: tuple[bool, ...],
    leaves: tuple[Any, ...],
    count: Int[Any, ""],
    prepared: PreparedPaths,
    batches: Batch,
    compared: Int[Any, ""],
) -> Float[Array, "most m"]:
    """Returns the scores of the first `count` candidates; the other rows are zero.

    The program is the same whatever differs between candidates and whatever is compared: compiling one takes as long as scoring
    ten thousand candidates, and most of it is the field along paths, which all comparisons have in common. On a CPU it scores
    one candidate after the other, which is the smallest program; elsewhere it scores many side by side.

    Args:
        own: whether a leaf of the parameters has a row for each candidate; static.
        leaves: leaves of the parameters.
        compared: index of the compared quantity in `Compared`, which the data contain (`comparable`).
    """
    side_by_side = 1 if jax.default_backend() == "cpu" else MOST

    def candidate(number: Int[Array, ""]) -> Float[Array, " m"]:
        rows = (leaf[number] if of_candidate else leaf for leaf, of_candidate in zip(leaves, own, strict=True))
        params = jax.tree.unflatten(structure, rows)
        scores: Float[Array, " m"] = jax.vmap(lambda batch: _compare(field, params, prepared, batch, compared))(batches)
        return scores

    def some(block: Int[Array, ""], scores: Float[Array, "most m"]) -> Float[Array, "most m"]:
        first = block * side_by_side
        found = jax.vmap(candidate)(first + jnp.arange(side_by_side))
        return jax.lax.dynamic_update_slice_in_dim(scores, found, first, 0)

    leaves = tuple(map(jnp.asarray, leaves))
    return jax.lax.fori_loop(0, -(-count // side_by_side), some, jnp.zeros((MOST, AT_ONCE), jnp.float32))


def _compare(
    field: Calibratable, params: WaveParams, prepared: PreparedPaths, batch: Batch, compared: Int[Any, ""]
) -> Float[Array, ""]:
    """Returns the score of a batch of one link. Of the quantities that are derived from its arrivals, only the compared one is
    computed when the program runs."""
    plan, links, frequency_hz = field.plan(params, batch.receiver, prepared), batch.links, batch.links.frequency_hz
    paths, plan = plan.paths_of(links), dataclasses.replace(plan, prepared=None)
    arrived = path_arrivals(params, plan, paths, links)

    def by_snapshots() -> Float[Array, ""]:
        return log_decorrelation(snapshots_of(plan, arrived, frequency_hz), batch.snapshots)[0]

    alike = 1e-6  # mean absolute error of spectra below which all candidates are equally good

    def by_spectra(pas: Float[Array, "1 90 360"]) -> Float[Array, ""]:
        assert batch.pas is not None, "data without spectra are compared by powers"
        unlike = jnp.log(jnp.maximum(jnp.mean(jnp.abs(pas - batch.pas)), alike))
        return jnp.where(jnp.max(batch.pas) > 0, unlike, 0)

    # Error of received power that is added before the logarithm, so that accidental agreement has little effect
    power_margin_db = 1.0

    def by_powers(power: Float[Array, " 1"]) -> Float[Array, ""]:
        assert batch.received_db is not None, "data without powers are compared by spectra"
        unlike = jnp.log(power_margin_db + jnp.abs(decibels(power) - batch.received_db)[0])
        return unlike if batch.snapshots is None else jnp.where(jnp.any(batch.snapshots != 0), unlike, 0)

    def by_second_moments() -> Float[Array, ""]:
        covariance, power = path_covariances(params, plan, paths, arrived, frequency_hz)
        following = (  # in the order of `Compared`; data that lack a quantity are never compared by it
            (lambda: surprise(covariance, batch.snapshots)[0]) if batch.snapshots is not None else _nothing,
            (lambda: by_spectra(spectra_of(plan, covariance, frequency_hz))) if batch.pas is not None else _nothing,
            (lambda: by_powers(power)) if batch.received_db is not None else _nothing,
        )
        score: Float[Array, ""] = jax.lax.switch(compared - 1, following)
        return score

    if not plan.config.coherent:
        return by_spectra(phase_blind_pas(params, plan, paths, links))
    if batch.snapshots is None:
        return by_second_moments()
    score: Float[Array, ""] = jax.lax.cond(compared == 0, by_snapshots, by_second_moments)
    return score


def _nothing() -> Float[Array, ""]:
    return jnp.zeros(())


def surely_better(gains: Float[np.ndarray, " n"], tx_index: Int[np.ndarray, " n"], errors: float) -> bool:
    """Returns whether the mean gain over transmitters is significantly positive.

    Signs are flipped transmitter by transmitter (Fisher's randomisation test): gains of logarithms have long tails, and a
    t statistic would reject 20 gains that are all positive because one of them is large. Fewer than 10 transmitters are never
    significant at three standard errors, and fewer than `FEWEST_SURE` at none; neither are gains that are not finite. If the
    required probability is below one in ten thousand, which random flips cannot resolve, standard errors are compared instead.

    Args:
        gains: gains of N spectra.
        tx_index: their transmitters.
        errors: n_sigma, the required significance in standard errors of a normal mean.
    """
    by_tx = by_transmitter(gains, tx_index)
    if len(by_tx) < FEWEST_SURE or not np.isfinite(by_tx).all():
        return False
    rarest = 1e-4  # smallest probability that SciPy's 9,999 random sign flips can resolve
    if norm.sf(errors) < rarest:
        gain, error = standard_error(gains, tx_index)
        return gain > errors * error
    chance = permutation_test((by_tx,), np.mean, permutation_type="samples", alternative="greater", random_state=0).pvalue
    return bool(chance <= norm.sf(errors))


SPREADS_M = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
"""Standard deviations that are tried, metres."""


@dataclass(frozen=True)
class PlacementReport:
    """Result of the calibration of position_std."""

    spread_mm: float
    """Estimated standard deviation along each axis, mm."""
    certain: float
    """Mean score of spectra with practically exact positions (the smallest of `SPREADS_M`)."""
    uncertain: float
    """Mean score of spectra with the estimated standard deviation."""


def search_placement(params: WaveParams, score: Scores) -> tuple[WaveParams, PlacementReport]:
    """Returns parameters with the standard deviation of all positions that fits spectra best."""
    candidates = [
        dataclasses.replace(params, placement=jnp.full_like(params.placement, np.log(spread))) for spread in SPREADS_M
    ]
    scores = score(candidates).mean(1)
    best = int(np.argmin(scores))
    return candidates[best], PlacementReport(1e3 * SPREADS_M[best], float(scores[0]), float(scores[best]))
