"""How simple methods and a trained field share an answer where spectra are few: found by cross-validation, on the host.

The simple methods are members from the start. Their weights are those by which known spectra are explained best from others
at all distances: every one is left out, alone and with shares of the other transmitters, the nearest ones. The field gains
a share as far as spectra that it was not trained on prove that it is better: of all shares the one whose gain over the simple
methods has the largest lower confidence bound. Without evidence that is none.

Stacking: the weights of a mixture of spectra, functions of one number, by which known spectra are explained best (SSIM).
"""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, UInt8
from scipy.spatial.distance import pdist
from scipy.special import expit, logit

from wbgs_jax._util.statistics import by_transmitter, standard_error
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.fields.mixture import SHARES, score_at, similarity
from wbgs_jax.inference.mixture import LOG_METRE, MEMBERS, Mixture, member_spectra, member_weights, scaled
from wbgs_jax.training.fit_kriging import spacing

STRIDE = 8
"""Pixels between the windows by which mixtures are compared."""
STEPS, RATE = 200, 0.1
"""Of Adam, which finds the weights."""
_C1, _C2 = 0.01**2, 0.03**2


class Moments(NamedTuple):
    """What the SSIM of any mixture of K spectra with their truth follows from, window by window."""

    means: Float[Array, "n windows k+1"]
    products: Float[Array, "n windows k+1 k+1"]
    """Covariances; the truth comes last."""


def moments_of(spectra: Float[np.ndarray, "n k 90 360"], truth: Float[np.ndarray, "n 90 360"]) -> Moments:
    """Returns the moments of scikit-image's windows of 7 x 7 pixels, some of them."""
    means, products = [], []
    for own, observed in zip(spectra, truth, strict=True):
        together = np.concatenate([own, observed[None]])
        windows = np.lib.stride_tricks.sliding_window_view(together, (7, 7), (1, 2))[:, ::STRIDE, ::STRIDE]
        windows = windows.reshape(len(together), -1, 49)
        mean = windows.mean(-1)
        centred = windows - mean[..., None]
        means.append(mean.T)
        products.append(np.einsum("awp,bwp->wab", centred, centred) / 48)
    return Moments(jnp.asarray(np.stack(means)), jnp.asarray(np.stack(products)))


def ssim_of(moments: Moments, weights: Float[Array, "n k"]) -> Float[Array, " n"]:
    """Returns the SSIM of mixtures."""
    mean, truth = jnp.einsum("nwk,nk->nw", moments.means[..., :-1], weights), moments.means[..., -1]
    cross = moments.products[..., :-1, :]
    own = jnp.einsum("nwkl,nk,nl->nw", cross[..., :-1], weights, weights)
    both = jnp.einsum("nwk,nk->nw", cross[..., -1], weights)
    luminance = (2 * mean * truth + _C1) / (mean**2 + truth**2 + _C1)
    structure = (2 * both + _C2) / (own + moments.products[..., -1, -1] + _C2)
    return jnp.mean(luminance * structure, -1)


@jax.jit
def fit_weights(
    moments: Moments, u: Float[Array, " n"], prior: Float[Array, "k 2"], ridge: Float[Array, "k 2"]
) -> Float[Array, "k 2"]:
    """Returns the logits of the weights by which spectra are explained best.

    Args:
        moments: of spectra and truths.
        u: what the logits are linear in.
        prior: bias and slope of every logit as long as nothing contradicts.
        ridge: penalties, in SSIM, on the squared distance of each from it.
    """
    optimizer = optax.adam(RATE)

    def loss(logits: Float[Array, "k 2"]) -> Float[Array, ""]:
        weights = jax.nn.softmax(logits[:, 0] + logits[:, 1] * u[:, None], -1)
        return jnp.sum(ridge * (logits - prior) ** 2) - jnp.mean(ssim_of(moments, weights))

    def step(carry: Any, _: None) -> Any:
        logits, state = carry
        updates, state = optimizer.update(jax.grad(loss)(logits), state)
        return (optax.apply_updates(logits, updates), state), None

    (logits, _), _ = jax.lax.scan(step, (prior, optimizer.init(prior)), None, STEPS)
    return logits


LEFT_OUT = 160
"""Spectra that are left out, each with several numbers of other transmitters, at most."""
SHARES_LEFT_OUT = (0.0, 0.12, 0.25, 0.5)
"""Of the transmitters, the nearest ones, that are left out with a spectrum."""
LENGTHS, NUGGETS = 7, (1e-2, 0.1, 1.0)
"""Number of lengths of the kriging that are tried, from the distance of a transmitter to the next one to that of the furthest,
and nuggets ..."""
TRIED = 48
"""... by so many of the spectra that are left out."""
PRIOR, RIDGE, RIDGE_SLOPE = (-1.0, 0.0, 0.0, 2.0, 0.0), (0.03, 0.03, 0.03, 0.03, 0.002), 0.05
"""Logits of the simple methods as long as nothing contradicts (kriging itself comes to a mean far away), and penalties, in SSIM
of a single transmitter, on the squared distance from these and on squared slopes. Whether there is a line of sight is soon
plain; the others differ little, and a few transmitters say nothing of which is best."""
AVERAGED = 512
"""Known spectra whose mean stands for that of all."""
ERRORS, ERRORS_WITH_PATHS = 2.0, 1.0
"""Standard errors below the mean gain at which the bound lies; fields that follow paths know more than spectra."""
USUAL_SPREAD, USUAL_WEIGHT = 0.1, 2.0
"""What gains of a field (SSIM) usually spread by over transmitters, and how many of them that counts for."""
SLOPES = (0.0, -1.0, 1.0)
"""Of the logit of the field's share that are tried; others than none have to be worth ..."""
WORTH = 0.005
"""... so much SSIM, and so has any mixture beside the field alone."""
UNUSED = 0.02
"""Weight of line of sight below which it is left out."""


class Known(NamedTuple):
    """Spectra that simple methods may look at."""

    links: Int[np.ndarray, " m"]
    images: UInt8[np.ndarray, "m 90 360"]


class HeldOut(NamedTuple):
    """Answers of fields to links that they were not trained on."""

    links: Int[np.ndarray, " n"]
    pas: Float[np.ndarray, "n 90 360"]
    known: Bool[np.ndarray, "n m"]
    """Which of the known spectra a field was trained on: simple methods may use the same."""
    group: Int[np.ndarray, " n"]
    """What was left out together, numbered: links of one are alike."""


@dataclass(frozen=True)
class Found:
    """What was found."""

    mixture: Mixture
    scores: Float[np.ndarray, " n"]
    """SSIM of the mixture's answers to what was held out, ..."""
    answers: Float[np.ndarray, "n 90 360"]
    """... these answers ..."""
    distance: Float[np.ndarray, " n"]
    """... and how far (metres) the nearest known transmitter was."""
    alone: bool
    """Whether the field by itself is as good."""
    line: str
    """In words."""


def learn_mixture(dataset: Dataset, known: Known, held: HeldOut, errors: float = ERRORS) -> Found:
    """Returns the mixture for a field.

    Args:
        dataset: of one receiver.
        known: its spectra.
        held: what the field answered to links that it was not trained on; there may be none.
        errors: standard errors by which the field has to be better.
    """
    mixture = learn_members(dataset, known)
    if not len(held.links):
        return Found(mixture, np.zeros(0), held.pas, np.zeros(0), False, "simple methods answer: nothing was held out")
    simple, distance = simple_answers(mixture, dataset, known, held)
    scores, u = share_scores(mixture, dataset, held, simple, distance)
    field, alone = choose_share(scores, u, held.group, errors)
    mixture = dataclasses.replace(mixture, field=jnp.asarray(field, jnp.float32))
    share = expit(field[0] + field[1] * u)
    answers = share[:, None, None] * held.pas + (1 - share[:, None, None]) * simple
    line = (
        f"on {len(held.links)} spectra that were held out the simple methods score {scores[:, 0].mean():.3f} (mean SSIM), the "
        f"field {scores[:, -1].mean():.3f}, both {_at(scores, share).mean():.3f}: "
        + ("the field answers alone" if alone else f"the field's share is {share.mean():.2f}")
    )
    return Found(mixture, _at(scores, share), answers, distance, alone, line)


def share_scores(
    mixture: Mixture,
    dataset: Dataset,
    held: HeldOut,
    simple: Float[np.ndarray, "n 90 360"],
    distance: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n shares"], Float[np.ndarray, " n"]]:
    """Returns the SSIM of what was held out, by the share of the field (`fields.mixture.SHARES`), and the scaled logarithms of
    its distances to what was known; `simple` and `distance` are `simple_answers`."""
    truth = np.asarray(dataset.pas(held.links))
    return similarity(truth, held.pas, simple), np.asarray(scaled(mixture, jnp.asarray(distance)))


def simple_answers(
    mixture: Mixture, dataset: Dataset, known: Known, held: HeldOut
) -> tuple[Float[np.ndarray, "n 90 360"], Float[np.ndarray, " n"]]:
    """Returns what the simple methods answer to what was held out, and the distances (metres) to what was known."""
    spectra, distance = predict_members(mixture, dataset, known, held.links, held.known)
    weights = np.asarray(member_weights(mixture, jnp.asarray(distance)))
    simple = np.clip(np.einsum("nm,nmij->nij", weights, spectra), 0, 1)
    return np.where(np.isfinite(distance)[:, None, None], simple, held.pas), distance


# The simple methods


def learn_members(dataset: Dataset, known: Known) -> Mixture:
    """Returns the mixture of simple methods that explains known spectra best from others, near and far; the field has no
    share."""
    positions = dataset.tx_positions[known.links]
    mixture = start_mixture(dataset, known, _reach(positions)[0])
    index, kept = left_out(dataset, known)
    if not len(index):
        return mixture
    truth = np.asarray(dataset.pas(index))
    chosen = _kriged(mixture, dataset, known, index[:TRIED], kept[:TRIED])
    spectra, distance = predict_members(chosen, dataset, known, index, kept)
    logs = np.log(np.maximum(distance, LOG_METRE))
    range_ = jnp.asarray([logs.mean(), max(logs.std(), 1e-3), logs.min(), logs.max()], jnp.float32)
    mixture = dataclasses.replace(chosen, log_distance=range_)
    prior = jnp.asarray([[bias, 0.0] for bias in PRIOR], jnp.float32)
    ridge = jnp.asarray([[penalty, RIDGE_SLOPE] for penalty in RIDGE], jnp.float32) / len(np.unique(dataset.tx_index[index]))
    logits = fit_weights(moments_of(spectra, truth), scaled(mixture, jnp.asarray(distance)), prior, ridge)
    mixture = dataclasses.replace(mixture, members=logits)
    used = np.asarray(member_weights(mixture, jnp.asarray(distance)))[:, MEMBERS.index("line_of_sight")]
    if used.max() < UNUSED:
        nothing = logits.at[MEMBERS.index("line_of_sight")].set(jnp.array([-30.0, 0.0]))
        mixture = dataclasses.replace(mixture, members=nothing, elements=mixture.elements[:0])
    return mixture


def _kriged(
    mixture: Mixture, dataset: Dataset, known: Known, index: Int[np.ndarray, " n"], kept: Bool[np.ndarray, "n m"]
) -> Mixture:
    """Returns the mixture with the smoothest kriging whose score is no lower than the best one by more than the standard error
    of that (Breiman et al. 1984): queries lie further away than transmitters of one track do from each other."""
    truth, scores = np.asarray(dataset.pas(index)), dict[tuple[float, float], np.ndarray]()
    local = dataclasses.replace(mixture, elements=mixture.elements[:0])  # line of sight takes longer than all others
    for length in np.geomspace(*_reach(dataset.tx_positions[known.links]), LENGTHS):
        for nugget in NUGGETS:
            tried = dataclasses.replace(local, length=jnp.float32(length), nugget=jnp.float32(nugget))
            spectra, _ = predict_members(tried, dataset, known, index, kept, ("kriging",))
            scores[length, nugget] = np.asarray(ssim_of(moments_of(spectra, truth), jnp.ones((len(index), 1))))
    best, error = standard_error(max(scores.values(), key=np.mean), dataset.tx_index[index])
    enough = [one for one, own in scores.items() if own.mean() >= best - error]
    length = max(length for length, _ in enough)
    nugget = max((nugget for own, nugget in enough if own == length), key=lambda one: float(scores[length, one].mean()))
    return dataclasses.replace(mixture, length=jnp.float32(length), nugget=jnp.float32(nugget))


def left_out(dataset: Dataset, known: Known) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, "n m"]]:
    """Returns known links that are left out, and which others may be used for each."""
    rng = np.random.default_rng(2)
    positions, tx = dataset.tx_positions[known.links], dataset.tx_index[known.links]
    places = {number: positions[tx == number][0] for number in np.unique(tx)}
    chosen, kept = [], []
    for place in _in_turn(tx, rng):
        others = sorted(places.keys() - {tx[place]}, key=lambda own: float(np.linalg.norm(places[own] - positions[place])))
        same = np.isclose(dataset.frequencies_hz[known.links], dataset.frequencies_hz[known.links[place]], rtol=1e-4)
        for count in sorted({int(share * len(others)) for share in SHARES_LEFT_OUT}):
            use = np.isin(tx, others[count:])
            if (use & same).any():
                chosen.append(known.links[place])
                kept.append(use)
        if len(chosen) >= LEFT_OUT:
            break
    return np.array(chosen, int), np.array(kept, bool).reshape(len(chosen), len(known.links))


def _in_turn(tx: Int[np.ndarray, " m"], rng: np.random.Generator) -> Int[np.ndarray, " m"]:
    """Returns all places in a random order in which every transmitter comes once before any comes twice."""
    order = rng.permutation(len(tx))
    seen: dict[int, int] = {}
    turn = np.empty(len(tx), int)
    for place in order:
        turn[place] = seen[tx[place]] = seen.get(tx[place], -1) + 1
    return order[np.argsort(turn[order], kind="stable")]


def _reach(positions: Float[np.ndarray, "m 3"]) -> tuple[float, float]:
    """Returns the median distance (metres) of a transmitter to the next one, and the largest between two."""
    places = np.unique(positions, axis=0)
    near = spacing(places) if len(places) > 1 else 1.0
    return max(near, LOG_METRE), float(max(pdist(places).max(initial=0), 2 * LOG_METRE))


def start_mixture(dataset: Dataset, known: Known, near: float) -> Mixture:
    """Returns a mixture that knows of nothing but the prior, in which neither line of sight nor the field has a share;
    `near` is the distance (metres) of a transmitter to the next one."""
    receiver = dataset.receiver()
    logits = [[bias, 0.0] for bias in PRIOR[:-1]] + [[-30.0, 0.0]]
    return Mixture(
        rx_position=receiver.position,
        rx_orientation=receiver.orientation,
        elements=receiver.element_positions,
        metres=jnp.float32(receiver.unit != "wavelengths"),
        tx_position=jnp.asarray(dataset.tx_positions[known.links], jnp.float32),
        frequency_hz=jnp.asarray(dataset.frequencies_hz[known.links], jnp.float32),
        images=jnp.asarray(known.images),
        mean=jnp.asarray(known.images.mean(0) / 255, jnp.float32),
        length=jnp.float32(4 * near),
        nugget=jnp.float32(0.1),
        log_distance=jnp.asarray([np.log(near), 1.0, np.log(near), np.log(near)], jnp.float32),
        members=jnp.asarray(logits, jnp.float32),
        field=jnp.asarray([-30.0, 0.0], jnp.float32),
    )


def predict_members(
    mixture: Mixture,
    dataset: Dataset,
    known: Known,
    index: Int[np.ndarray, " n"],
    kept: Bool[np.ndarray, "n m"],
    members: tuple[str, ...] = MEMBERS,
) -> tuple[Float[np.ndarray, "n k 90 360"], Float[np.ndarray, " n"]]:
    """Returns what simple methods give for links, each from some known spectra alone, and how far (metres) the nearest known
    transmitter is."""
    means = _means(known, kept) if "mean" in members else np.zeros((len(index), *known.images.shape[1:]), np.float32)
    query = dataset.query(index)
    numbers = [MEMBERS.index(name) for name in members]
    found = [
        _member_spectra(mixture, jnp.asarray(mean), position, frequency, jnp.asarray(use))
        for mean, position, frequency, use in zip(means, query.tx_position, query.frequency_hz, kept, strict=True)
    ]
    spectra = np.stack([np.asarray(own)[numbers] for own, _ in found])
    return spectra, np.array([float(distance) for _, distance in found])


_member_spectra = jax.jit(member_spectra)


def _means(known: Known, kept: Bool[np.ndarray, "n m"]) -> Float[np.ndarray, "n 90 360"]:
    """Returns the means of N parts of the known spectra, of `AVERAGED` of them at most."""
    sample = np.random.default_rng(3).permutation(len(known.links))[:AVERAGED]
    pixels = known.images[sample].reshape(len(sample), -1).astype(np.float32) / 255
    means = kept[:, sample] @ pixels / np.maximum(kept[:, sample].sum(1), 1)[:, None].astype(np.float32)
    return means.reshape(len(kept), *known.images.shape[1:])


# The field's share


def choose_share(
    scores: Float[np.ndarray, "n shares"], u: Float[np.ndarray, " n"], group: Int[np.ndarray, " n"], errors: float = ERRORS
) -> tuple[tuple[float, float], bool]:
    """Returns bias and slope of the logit of the field's share, and whether the field is as good by itself.

    Args:
        scores: SSIM of held-out links by the share of the field (`fields.mixture.SHARES`).
        u: scaled logarithm of the distance to the nearest known transmitter.
        group: links of one are alike.
        errors: standard errors below the mean gain at which the bound lies.
    """
    bound = functools.partial(lower_bound, group=group, errors=errors)
    best, found = 0.0, (-30.0, 0.0)
    for slope in SLOPES:
        for middle in SHARES[1:]:
            bias = float(logit(np.clip(middle, 1e-4, 1 - 1e-4)))
            share = expit(bias + slope * u) if slope else np.full(len(u), middle)
            worth = bound(_at(scores, share) - scores[:, 0], share=float(share.mean()))
            if worth > best + (WORTH if slope and not found[1] else 0):
                best, found = worth, (bias, slope)
    chosen = expit(found[0] + found[1] * u)
    alone = (
        bound(scores[:, -1] - scores[:, 0], share=1.0) > 0
        and standard_error(_at(scores, chosen) - scores[:, -1], group)[0] < WORTH
    )
    return found, bool(alone)


def lower_bound(gains: Float[np.ndarray, " n"], share: float, group: Int[np.ndarray, " n"], errors: float = ERRORS) -> float:
    """Returns the lower confidence bound of a mean gain over groups: their spread is what was seen and what is usual, which
    counts for `USUAL_WEIGHT` groups, so that a few groups that happen to agree prove little."""
    by_group = by_transmitter(gains, group)
    n = len(by_group)
    usual = (USUAL_SPREAD * share) ** 2
    variance = (USUAL_WEIGHT * usual + np.sum((by_group - by_group.mean()) ** 2)) / (USUAL_WEIGHT + n - 1)
    return float(by_group.mean() - errors * np.sqrt(variance / n))


def _at(scores: Float[np.ndarray, "n shares"], share: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns the scores at shares between those that were tried."""
    return np.asarray(score_at(jnp.asarray(scores), jnp.asarray(share)), np.float64)
