"""Mixture of three experts with weights for every query, fitted to links that were not used for training: the coherent field
("coherent"), the unconditioned splatting field ("own"), and the splatting field conditioned on the coherent one ("informed").

    first = a coherent + (1 - a) own        all = b first + (1 - b) informed

The coherent and the unconditioned expert err in different places; the conditioned expert has learned what the mesh lacks, but
errs where the coherent one does. Each weight is

    share = sigmoid(bias + weights . z)

with features z that are available without observations and indicate where phases fail: the frequency, the disagreement of the
two fields, the received power relative to free space (in deep shadow many weak paths add up, some of which are missing), and
the brightness of both spectra. The coefficients are those that fit validation links best; they are zero unless, in five-fold
cross-validation over transmitters, they improve on a common weight by more than a standard error.

This module also estimates the noise floor of observed spectra, and how much of it fields have learned.

White noise n of an array of N elements makes the spectrum of y = h + n brighter than that of the channel h where that is dark:

    E |a^H y|^2 = |a^H h|^2 + N sigma^2

A field that is trained on such spectra learns this floor; one that sums over paths cannot. The floor is removed from the
predictions of the former, since queries are for the channel, and added wherever predictions are compared with observations
(`as_observed`). Its level is unknown, but can be estimated from both: spectra of paths are most similar to the observed ones if
the right floor is added, or a higher one if paths are missing; learned spectra are hardly anywhere darker than the floor, and
become less similar if they are raised to a higher one.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from wbgs_jax._util.pytree import AnyArray, pytree
from wbgs_jax._util.statistics import lower_bound, standard_error
from wbgs_jax.fields.base import Observation, Params
from wbgs_jax.fields.losses import COARSE, ssim, ssim_of_mixtures
from wbgs_jax.radio.array import EXACT
from wbgs_jax.radio.channel import NO_PATH_DB, beyond_free_space_db
from wbgs_jax.types import Query

SHARES = np.linspace(0, 1, 21)
"""Weights of the first of two experts at which links are scored."""
USUAL_SPREAD = 0.1
"""Standard deviation over transmitters of the difference in SSIM of two methods, where few transmitters were measured."""
FEATURES = 7
"""Number of features z of a query."""


@pytree
class Share:
    """A mixture weight whose logit is linear in the features."""

    bias: Float[Array, ""]
    weights: Float[Array, " features"]
    mean: Float[Array, " features"]
    """Mean of the features over the links that it was fitted to."""
    scale: Float[Array, " features"]
    """Standard deviation of the features over these links."""


@pytree
class Shares:
    """Mixture weights of three experts."""

    coherent: Share
    """Weight of the coherent field; the remainder is that of the unconditioned splatting field."""
    uninformed: Share
    """Weight of these two together; the remainder is that of the conditioned splatting field."""


class ExpertPredictions(NamedTuple):
    """Predictions of three experts for B links: spectra, or received powers in decibels."""

    coherent: Any
    own: Any
    informed: Any


@runtime_checkable
class Mixing(Protocol):
    """A field that mixes three experts with weights that are fitted after its training."""

    def expert_predictions(
        self, params: Params, plan: Any, links: Query
    ) -> tuple[ExpertPredictions, ExpertPredictions, Float[Array, "b features"]]:
        """Returns the experts' spectra and received powers (dB) of B links, and the features that their weights depend on."""
        ...

    def with_shares(
        self, params: Params, spectra: Shares | None = None, power: Shares | None = None, floor: float = 0.0
    ) -> Any:
        """Returns parameters with other mixture weights, where given, and another noise floor of spectra."""
        ...


class Scored(NamedTuple):
    """Links with the scores of mixtures, to which weights are fitted."""

    features: Float[np.ndarray, "n features"]
    scores: Float[np.ndarray, "n shares"]
    """Score of every weight of `SHARES` on each link; larger is better."""
    tx_index: Int[np.ndarray, " n"]


def constant(share: float) -> Share:
    """Returns a weight that is the same for all queries, clipped to 0.001..0.999."""
    share = min(max(share, 1e-3), 1 - 1e-3)
    weights, mean = jnp.zeros(FEATURES), jnp.zeros(FEATURES)  # two arrays: training donates each of them once
    return Share(jnp.asarray(np.log(share / (1 - share)), jnp.float32), weights, mean, jnp.ones(FEATURES))


def at_first() -> Shares:
    """Returns the initial weights: 1/2 for the coherent field, 1/4 for each of the other experts."""
    return Shares(constant(2 / 3), constant(3 / 4))


def coherent_alone() -> Shares:
    """Returns weights of the coherent field alone, within a few thousandths."""
    return Shares(constant(1.0), constant(1.0))


def reported(shares: Shares, features: Float[np.ndarray, "n features"]) -> dict[str, Any]:
    """Returns, for reports, the mean weight of each expert over N links, and whether weights differ between queries."""
    first, both = (np.asarray(share_of(share, jnp.asarray(features))) for share in (shares.coherent, shares.uninformed))
    means = {"coherent": first * both, "own": (1 - first) * both, "informed": 1 - both}
    by_query = bool(np.any(shares.coherent.weights) or np.any(shares.uninformed.weights))
    return {name: round(float(share.mean()), 3) for name, share in means.items()} | {"by_query": by_query}


def share_of(share: Share, features: Float[Array, "b features"]) -> Float[Array, " b"]:
    """Returns the weight, 0 to 1, of the first of two experts for B queries."""
    scaled = (features - share.mean) / share.scale
    return jax.nn.sigmoid(share.bias + jnp.matmul(scaled, share.weights, precision=EXACT))


def mixed(shares: Shares, features: Float[Array, "b features"], predicted: ExpertPredictions) -> Any:
    """Returns the mixture of three experts for B queries."""
    first = _mix(share_of(shares.coherent, features), predicted.coherent, predicted.own)
    return _mix(share_of(shares.uninformed, features), first, predicted.informed)


def _mix(share: Float[AnyArray, " b"], one: Any, other: Any) -> Any:
    share = share.reshape(share.shape + (1,) * (one.ndim - 1))
    return share * one + (1 - share) * other


def features(
    query: Query, rx_position: Float[Array, "3"], coherent: Observation, own: Observation
) -> Float[Array, "b features"]:
    """Returns the features z of B queries, which indicate the accuracy of the coherent field relative to the unconditioned
    splatting field.

    Args:
        query: B queries.
        rx_position: world frame, metres.
        coherent, own: predictions of the two fields.
    """
    octave = jnp.log2(query.frequency_hz / 1e10)
    link = query.tx_position, rx_position, query.frequency_hz
    faintest_db = 60.0  # received powers are clipped at this number of decibels below free space
    beyond = [
        jnp.zeros_like(octave)
        if seen.power_db is None
        else jnp.clip(beyond_free_space_db(seen.power_db, *link), -faintest_db, 0.0)
        for seen in (coherent, own)
    ]
    brightness = [jnp.log(jnp.mean(seen.pas, (-2, -1)) + 1e-3) for seen in (coherent, own)]
    disagreement = jnp.log(jnp.mean(jnp.abs(coherent.pas - own.pas), (-2, -1)) + 1e-3)
    return jnp.stack([octave, octave**2, disagreement, *beyond, *brightness], -1)


def learn_shares(
    features: Float[np.ndarray, "n features"],
    tx_index: Int[np.ndarray, " n"],
    predicted: ExpertPredictions,
    worth: Callable[[Any, Any], Any],
    usual_spread: float = USUAL_SPREAD,
) -> Shares:
    """Returns the weights that fit N links best (host), fitted one after the other.

    Args:
        features: features of the links.
        tx_index: transmitters of the links.
        predicted: predictions of the experts.
        worth: returns the scores (n, shares) of the mixtures of two experts on each link, for all weights (`SHARES`) of the
            first.
        usual_spread: standard deviation over transmitters of the difference of two experts' scores, if few were measured.
    """
    coherent = learn_share(Scored(features, worth(predicted.coherent, predicted.own), tx_index), usual_spread)
    first = _mix(np.asarray(share_of(coherent, jnp.asarray(features))), predicted.coherent, predicted.own)
    return Shares(coherent, learn_share(Scored(features, worth(first, predicted.informed), tx_index), usual_spread))


def similarity(truth: Float[np.ndarray, "n 90 360"], one: Any, other: Any, stride: int = 1) -> Float[np.ndarray, "n shares"]:
    """Returns the SSIM, at every `stride`-th window, of the mixtures of two spectra with all weights of `SHARES`."""
    return in_blocks(partial(_ssim_of_mixtures, stride=stride), one, other, truth)


def in_blocks(score: Callable[..., Array], *spectra: Float[np.ndarray, "n 90 360"]) -> Float[np.ndarray, "n tried"]:
    """Returns the values of a function of N spectra, evaluated in blocks to limit device memory; several arrays of spectra are
    passed together."""
    block_size = 48  # number of spectra that are compared at once
    blocks = [slice(start, start + block_size) for start in range(0, len(spectra[0]), block_size)]
    return np.concatenate([np.asarray(score(*(each[block] for each in spectra))) for block in blocks])


@partial(jax.jit, static_argnames="stride")
def _ssim_of_mixtures(one: Any, other: Any, truth: Float[Array, "b 90 360"], stride: int) -> Float[Array, "b shares"]:
    return ssim_of_mixtures(jnp.asarray(one), jnp.asarray(other), truth, jnp.asarray(SHARES, jnp.float32), stride)


def nearness(measured_db: Float[np.ndarray, " n"], one: Any, other: Any) -> Float[np.ndarray, "n shares"]:
    """Returns the negative absolute error (dB) of the mixtures of two received powers with all weights of `SHARES`; 0 for links
    on which nothing was received."""
    mixtures = SHARES * one[:, None] + (1 - SHARES) * other[:, None]
    return np.where((measured_db > NO_PATH_DB)[:, None], -np.abs(mixtures - measured_db[:, None]), 0)


def learn_share(known: Scored, usual_spread: float = USUAL_SPREAD) -> Share:
    """Returns the weight that fits links best (host): the same for all, unless the features improve on it by more than a
    standard error in cross-validation. With few transmitters the first expert is used alone, unless another weight is better by
    more than a standard error."""
    best = _best(known.scores)
    common = constant(SHARES[best])
    number_of_folds = 5  # folds of the cross-validation over transmitters
    folds = np.unique(known.tx_index, return_inverse=True)[1] % number_of_folds
    if len(np.unique(known.tx_index)) < 2 * number_of_folds:
        gains, change = known.scores[:, best] - known.scores[:, -1], 1 - SHARES[best]
        return common if lower_bound(gains, known.tx_index, change * usual_spread, 1.0) > 0 else constant(1.0)
    gains = np.zeros(len(folds))
    for fold in range(number_of_folds):
        own, rest = (jax.tree.map(lambda a, keep=keep: a[keep], known) for keep in (folds == fold, folds != fold))
        by_features, by_all = _fit(rest), constant(SHARES[_best(rest.scores)])
        gains[folds == fold] = _worth(by_features, own) - _worth(by_all, own)
    gain, error = standard_error(gains, known.tx_index)
    return _fit(known) if gain > error else common


def _best(scores: Float[np.ndarray, "n shares"]) -> int:
    return int(np.argmax(scores.mean(0)))


def _worth(share: Share, known: Scored) -> Float[np.ndarray, " n"]:
    return np.asarray(_score_of(share, known.features, known.scores))


@jax.jit
def _score_of(share: Share, features: Float[Array, "n features"], scores: Float[Array, "n shares"]) -> Float[Array, " n"]:
    return jnp.asarray(score_at(scores, share_of(share, features)))


def score_at(scores: Float[AnyArray, "n shares"], share: Float[AnyArray, " n"]) -> Float[AnyArray, " n"]:
    """Returns the score at a weight, interpolated linearly between those of `SHARES`; on the host for NumPy arrays."""
    place = share * (len(SHARES) - 1)
    low = place.astype(np.int32).clip(0, len(SHARES) - 2)
    rows = np.arange(len(scores))
    left, right = scores[rows, low], scores[rows, low + 1]
    return left + (place - low) * (right - left)


def _fit(known: Scored) -> Share:
    """Returns the coefficients with the largest mean score, for standardised features and with a ridge penalty."""
    start = constant(min(max(SHARES[_best(known.scores)], 0.05), 0.95))
    mean, scale = known.features.mean(0), known.features.std(0)
    used = scale > 1e-6
    start = Share(start.bias, start.weights, jnp.asarray(mean), jnp.asarray(np.where(used, scale, 1)))
    unit = max(float(np.ptp(known.scores, 1).mean()), 1e-6)
    learned: Share = _ascend(start, jnp.asarray(known.features), jnp.asarray(known.scores / unit), jnp.asarray(used))
    return learned


@jax.jit
def _ascend(
    start: Share, features: Float[Array, "n features"], scores: Float[Array, "n shares"], used: Bool[Array, " features"]
) -> Share:
    """Maximises the mean score, a smooth function of eight numbers, by Adam."""

    def with_learned(learned: tuple[Array, Array]) -> Share:
        return Share(learned[0], learned[1] * used, start.mean, start.scale)

    ridge = 5e-3  # penalty on the squared coefficients, relative to the range of the scores over the weights

    def loss(learned: tuple[Array, Array]) -> Float[Array, ""]:
        worth = score_at(scores, share_of(with_learned(learned), features))
        return ridge * jnp.sum(learned[1] ** 2) - jnp.mean(worth)

    steps, rate = 400, 0.03  # steps and learning rate of Adam, which fits the coefficients

    def step(i: Int[Array, ""], carry: Any) -> Any:
        learned, first, second = carry
        gradient = jax.grad(loss)(learned)
        first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, gradient)
        second = jax.tree.map(lambda v, g: 0.99 * v + 0.01 * g**2, second, gradient)
        size = rate * jnp.sqrt(1 - 0.99 ** (i + 1.0)) / (1 - 0.9 ** (i + 1.0))
        learned = jax.tree.map(lambda p, m, v: p - size * m / (jnp.sqrt(v) + 1e-8), learned, first, second)
        return learned, first, second

    learned = start.bias, start.weights
    zeros = jax.tree.map(jnp.zeros_like, learned)
    return with_learned(jax.lax.fori_loop(0, steps, step, (learned, zeros, zeros))[0])


LEVELS = np.concatenate([[0], np.geomspace(1e-4, 0.1, 31)])
"""Floors that are tried, relative to the largest square of a spectrum; lower ones are hardly visible in spectra."""
SURE = 2.0
"""Improvement of the similarity by a floor that is significant, in standard errors over transmitters."""
FEWEST_TX = 10
"""Minimum number of transmitters for an estimate."""
COMPARED = 240
"""Maximum number of spectra that are compared."""


def with_floor(pas: Float[Array, "b 90 360"], floor: Float[Array, ""] | float) -> Float[Array, "b 90 360"]:
    """Returns spectra with a noise floor; `floor` is N sigma^2 / max |a^H h|^2."""
    return jnp.sqrt((pas**2 + floor) / (1 + floor))


def without_floor(pas: Float[Array, "b 90 360"], floor: Float[Array, ""] | float) -> Float[Array, "b 90 360"]:
    """Returns spectra without their noise floor; pixels darker than the floor become 0."""
    square = (1 + floor) * pas**2 - floor
    dark = square <= 0  # the root has no gradient at 0
    return jnp.where(dark, 0, jnp.sqrt(jnp.where(dark, 1, square)))


def at_least_floor(pas: Float[Array, "b 90 360"], floor: Float[Array, ""] | float) -> Float[Array, "b 90 360"]:
    """Returns spectra that are raised to the floor wherever they are darker, which is the result of removing the floor and
    adding it again."""
    return jnp.maximum(pas, jnp.sqrt(floor / (1 + floor)))


def floor_of(predicted: ExpertPredictions, observed: Float[np.ndarray, "n 90 360"], tx_index: Int[np.ndarray, " n"]) -> float:
    """Returns the noise floor of N observed spectra (host): the lowest of three estimates; 0 unless the spectra of the coherent
    field, which are free of noise, are significantly more similar to the observed ones with it.

    Args:
        predicted: predictions of the experts; those of the splatting field include the floor.
        observed: observed spectra.
        tx_index: their transmitters, which are the independent samples.
    """
    looked = np.random.default_rng(0).permutation(np.flatnonzero(_met(predicted)))[:COMPARED]
    unaware, learned, observed, tx_index = (
        predicted.coherent[looked],
        predicted.informed[looked],
        observed[looked],
        tx_index[looked],
    )
    if len(np.unique(tx_index)) < FEWEST_TX:
        return 0.0
    added = in_blocks(_added, unaware, observed)
    best = int(added.mean(0).argmax())
    gain, error = standard_error(added[:, best] - added[:, 0], tx_index)
    if gain <= SURE * error:
        return 0.0
    raised = in_blocks(_raised, learned, observed)
    losses = [standard_error(raised[:, 0] - with_level, tx_index) for with_level in raised.T]
    # Loss of similarity that is accepted when learned spectra are raised to the floor, in standard errors over transmitters.
    accepted = 1.0
    harmless = max(level for level, (loss, error) in zip(LEVELS, losses, strict=True) if loss <= accepted * error)
    darkest = 0.05  # fraction of the pixels of learned spectra that may be darker than the floor
    return float(min(LEVELS[best], harmless, np.quantile(learned**2, darkest)))


def observed_predictions(predicted: ExpertPredictions, floor: float) -> ExpertPredictions:
    """Returns spectra of the experts as they would be observed if the floor were first removed from those that have learned it
    and then added to all (host)."""
    own, informed = (at_least_floor(jnp.asarray(learned), floor) for learned in predicted[1:])
    coherent = jnp.where(_met(predicted)[:, None, None], with_floor(jnp.asarray(predicted.coherent), floor), own)
    return ExpertPredictions(*(np.asarray(spectra) for spectra in (coherent, own, informed)))


def _met(predicted: ExpertPredictions) -> Bool[np.ndarray, " n"]:
    """Returns the links for which the coherent field has a prediction of its own."""
    return np.asarray((predicted.coherent != predicted.own).any((-2, -1)))


def _alike(
    change: Callable[..., Array], predicted: Float[Array, "b 90 360"], observed: Float[Array, "b 90 360"]
) -> Float[Array, "b levels"]:
    """Returns the similarity (SSIM) to the observed spectra of others that are changed by each floor of `LEVELS`."""
    levels = jnp.asarray(LEVELS, predicted.dtype)
    return jax.lax.map(lambda floor: ssim(change(predicted, floor), observed, COARSE), levels).T


_added, _raised = (jax.jit(partial(_alike, change)) for change in (with_floor, at_least_floor))
