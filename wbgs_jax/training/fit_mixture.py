"""Mixture of simple methods with a trained field for small numbers of spectra, fitted by cross-validation (host).

The simple methods are part of the mixture from the start. Their weights are those that predict measured spectra best (SSIM)
from others at all distances: every spectrum is left out, alone and together with fractions of the other transmitters, the
nearest ones. This is stacking, with weights that are functions of one number. A field without paths receives a weight only if
it is better on spectra that it was not trained on: of all weights, the one whose gain over the simple methods has the largest
lower confidence bound. Without evidence its weight is zero. A field with paths uses more information than the spectra: without
evidence it is used alone, and simple methods receive a weight only if they improve on it.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, UInt8
from scipy.spatial.distance import pdist
from scipy.special import expit, logit

from wbgs_jax._util.statistics import lower_bound, standard_error
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.fields.mixture import SHARES, USUAL_SPREAD, score_at, similarity
from wbgs_jax.inference.kriging import LOG_METRE, MEMBERS, Mixture, member_spectra, member_weights, scaled_distance
from wbgs_jax.training.fit_kriging import scattered, spacing

STRIDE = 8
"""Stride, in pixels, of the SSIM windows with which mixtures are compared."""


class Moments(NamedTuple):
    """Moments of K spectra and their truth, window by window, from which the SSIM of any mixture follows."""

    means: Float[Array, "n windows k+1"]
    """Means; the truth comes last."""
    products: Float[Array, "n windows k+1 k+1"]
    """Covariances; the truth comes last."""


def moments_of(spectra: Float[np.ndarray, "n k 90 360"], truth: Float[np.ndarray, "n 90 360"]) -> Moments:
    """Returns the moments of windows of 7 x 7 pixels, as in scikit-image, at every `STRIDE`-th position along both axes."""
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
    """Returns the SSIM of mixtures with K weights each."""
    mean, truth = jnp.einsum("nwk,nk->nw", moments.means[..., :-1], weights), moments.means[..., -1]
    cross = moments.products[..., :-1, :]
    own = jnp.einsum("nwkl,nk,nl->nw", cross[..., :-1], weights, weights)
    both = jnp.einsum("nwk,nk->nw", cross[..., -1], weights)
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean * truth + c1) / (mean**2 + truth**2 + c1)
    structure = (2 * both + c2) / (own + moments.products[..., -1, -1] + c2)
    return jnp.mean(luminance * structure, -1)


@jax.jit
def fit_weights(
    moments: Moments, u: Float[Array, " n"], prior: Float[Array, "k 2"], ridge: Float[Array, "k 2"]
) -> Float[Array, "k 2"]:
    """Returns the logits of the weights with the largest mean SSIM.

    Args:
        moments: moments of spectra and truths.
        u: variable in which the logits are linear.
        prior: prior bias and slope of every logit.
        ridge: penalties, in SSIM, on their squared distances from the prior.
    """
    steps, rate = 200, 0.1  # steps and learning rate of Adam, which fits the weights
    optimizer = optax.adam(rate)

    def loss(logits: Float[Array, "k 2"]) -> Float[Array, ""]:
        weights = jax.nn.softmax(logits[:, 0] + logits[:, 1] * u[:, None], -1)
        return jnp.sum(ridge * (logits - prior) ** 2) - jnp.mean(ssim_of(moments, weights))

    def step(carry: Any, _: None) -> Any:
        logits, state = carry
        updates, state = optimizer.update(jax.grad(loss)(logits), state)
        return (optax.apply_updates(logits, updates), state), None

    (logits, _), _ = jax.lax.scan(step, (prior, optimizer.init(prior)), None, steps)
    return logits


LEFT_OUT = 160
"""Maximum number of cases in which a spectrum is left out, together with different numbers of other transmitters."""
LENGTHS, NUGGETS = 7, (1e-2, 0.1, 1.0)
"""Number of correlation lengths of the kriging that are tried, from the spacing of transmitters to their largest distance, and
nuggets that are tried."""
TRIED = 48
"""Maximum number of these cases that are used to choose length and nugget."""
PRIOR, RIDGE, RIDGE_SLOPE = (-1.0, 0.0, 0.0, 2.0, 0.0), (0.03, 0.03, 0.03, 0.03, 0.002), 0.05
"""Prior logits of the simple methods (kriging itself tends to a mean far from the data), and penalties, in SSIM of a single
transmitter, on the squared distances from these and on squared slopes. A line of sight becomes apparent from few transmitters;
the other methods differ little, and a few transmitters do not show which is best."""
ERRORS, ERRORS_WITH_PATHS = 2.0, 1.0
"""Distance of the bound below the mean gain, in standard errors: of a field over simple methods, and of these over a field with
paths."""


class Known(NamedTuple):
    """Measured spectra that simple methods may use."""

    links: Int[np.ndarray, " m"]
    """Indices of the links."""
    images: UInt8[np.ndarray, "m 90 360"]
    """Spectra, multiplied by 255."""


class HeldOut(NamedTuple):
    """Predictions of fields for links that they were not trained on."""

    links: Int[np.ndarray, " n"]
    pas: Float[np.ndarray, "n 90 360"]
    known: Bool[np.ndarray, "n m"]
    """Which of the measured spectra the field was trained on; simple methods use the same."""
    group: Int[np.ndarray, " n"]
    """Number of the group of links that were left out together, whose errors are correlated."""


@dataclass(frozen=True)
class Found:
    """Result of the fit."""

    mixture: Mixture
    scores: Float[np.ndarray, " n"]
    """SSIM of the mixture's predictions for held-out links."""
    answers: Float[np.ndarray, "n 90 360"]
    """These predictions."""
    distance: Float[np.ndarray, " n"]
    """Distances to the nearest measured transmitter, metres."""
    alone: bool
    """Whether the field alone is as good."""
    line: str
    """Summary for the terminal."""


def learn_mixture(dataset: Dataset, known: Known, held: HeldOut, with_paths: bool = False) -> Found:
    """Returns the mixture for a field.

    Args:
        dataset: data of one receiver.
        known: measured spectra.
        held: predictions of the field for links that it was not trained on, possibly none.
        with_paths: whether the field predicts paths.
    """
    mixture = learn_members(dataset, known)
    if not len(held.links):
        return Found(mixture, np.zeros(0), held.pas, np.zeros(0), False, "simple methods only: no links were held out")
    simple, distance = simple_answers(mixture, dataset, known, held)
    scores, u = share_scores(mixture, dataset, held, simple, distance)
    field, alone = choose_share(scores, u, held.group, with_paths)
    mixture = dataclasses.replace(mixture, field=jnp.asarray(field, jnp.float32))
    share = expit(field[0] + field[1] * u)
    answers = share[:, None, None] * held.pas + (1 - share[:, None, None]) * simple
    line = (
        f"mean SSIM on {len(held.links)} held-out spectra: simple methods {scores[:, 0].mean():.3f}, field "
        f"{scores[:, -1].mean():.3f}, mixture {_at(scores, share).mean():.3f}: "
        + ("the field is used alone" if alone else f"the field's weight is {share.mean():.2f}")
    )
    return Found(mixture, _at(scores, share), answers, distance, alone, line)


def share_scores(
    mixture: Mixture,
    dataset: Dataset,
    held: HeldOut,
    simple: Float[np.ndarray, "n 90 360"],
    distance: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n shares"], Float[np.ndarray, " n"]]:
    """Returns the SSIM of held-out links by the weight of the field (`fields.mixture.SHARES`), and the scaled logarithms of
    their distances to measured transmitters; `simple` and `distance` are results of `simple_answers`."""
    truth = np.asarray(dataset.pas(held.links))
    return similarity(truth, held.pas, simple), np.asarray(scaled_distance(mixture, jnp.asarray(distance)))


def simple_answers(
    mixture: Mixture, dataset: Dataset, known: Known, held: HeldOut
) -> tuple[Float[np.ndarray, "n 90 360"], Float[np.ndarray, " n"]]:
    """Returns the predictions of the simple methods for held-out links, and the distances (metres) to measured transmitters."""
    spectra, distance = predict_members(mixture, dataset, known, held.links, held.known)
    weights = np.asarray(member_weights(mixture, jnp.asarray(distance)))
    simple = np.clip(np.einsum("nm,nmij->nij", weights, spectra), 0, 1)
    return np.where(np.isfinite(distance)[:, None, None], simple, held.pas), distance


# The simple methods


def learn_members(dataset: Dataset, known: Known) -> Mixture:
    """Returns the mixture of simple methods that predicts measured spectra best from others, near and far; the weight of the
    field is zero. If few transmitters have a frequency in common, spectra of all frequencies are used together where that is
    better."""
    apart = _members(dataset, known, False)
    if not scattered(dataset, known.links):
        return apart
    together = _members(dataset, known, True)
    index, kept = left_out(dataset, known)
    # Of most transmitters nothing can be predicted at their own frequency alone, or it is predicted worse.
    few = 2 * len(np.unique(dataset.tx_index[index])) < len(np.unique(dataset.tx_index[known.links]))
    if few or _score(together, dataset, known, index, kept) > _score(apart, dataset, known, index, kept):
        return together
    return apart


def _score(
    mixture: Mixture, dataset: Dataset, known: Known, index: Int[np.ndarray, " n"], kept: Bool[np.ndarray, "n m"]
) -> float:
    """Returns the mean SSIM of the simple methods for links that are left out."""
    spectra, distance = predict_members(mixture, dataset, known, index, kept)
    moments = moments_of(spectra, np.asarray(dataset.pas(index)))
    found = np.asarray(ssim_of(moments, member_weights(mixture, jnp.asarray(distance))))
    return standard_error(found, dataset.tx_index[index])[0]


def _members(dataset: Dataset, known: Known, together: bool) -> Mixture:
    """Returns the mixture of simple methods that use only spectra of the same frequency, or of all frequencies together."""
    positions = dataset.tx_positions[known.links]
    mixture = start_mixture(dataset, known, _reach(positions)[0])
    if together:
        mixture = dataclasses.replace(mixture, frequency_hz=jnp.full_like(mixture.frequency_hz, jnp.nan))
    index, kept = left_out(dataset, known, together)
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
    logits = fit_weights(moments_of(spectra, truth), scaled_distance(mixture, jnp.asarray(distance)), prior, ridge)
    mixture = dataclasses.replace(mixture, members=logits)
    used = np.asarray(member_weights(mixture, jnp.asarray(distance)))[:, MEMBERS.index("line_of_sight")]
    unused = 0.02  # largest weight of the line of sight at which it is left out
    if used.max() < unused:
        nothing = logits.at[MEMBERS.index("line_of_sight")].set(jnp.array([-30.0, 0.0]))
        mixture = dataclasses.replace(mixture, members=nothing, elements=mixture.elements[:0])
    return mixture


def _kriged(
    mixture: Mixture, dataset: Dataset, known: Known, index: Int[np.ndarray, " n"], kept: Bool[np.ndarray, "n m"]
) -> Mixture:
    """Returns the mixture with the smoothest kriging whose score is lower than the best one by no more than its standard error
    (Breiman et al. 1984), because queries lie further away than transmitters of one track do from each other."""
    truth, scores = np.asarray(dataset.pas(index)), dict[tuple[float, float], np.ndarray]()
    local = dataclasses.replace(mixture, elements=mixture.elements[:0])  # the line of sight takes longer than all others
    for length in np.geomspace(*_reach(dataset.tx_positions[known.links]), LENGTHS).tolist():
        for nugget in NUGGETS:
            tried = dataclasses.replace(local, length=jnp.float32(length), nugget=jnp.float32(nugget))
            spectra, _ = predict_members(tried, dataset, known, index, kept, ("kriging",))
            scores[length, nugget] = np.asarray(ssim_of(moments_of(spectra, truth), jnp.ones((len(index), 1))))
    means = {one: standard_error(own, dataset.tx_index[index]) for one, own in scores.items()}
    best, error = max(means.values())
    enough = [one for one, (mean, _) in means.items() if mean >= best - error]
    length = max(length for length, _ in enough)
    nugget = max((nugget for own, nugget in enough if own == length), key=lambda one: means[length, one][0])
    return dataclasses.replace(mixture, length=jnp.float32(length), nugget=jnp.float32(nugget))


def left_out(dataset: Dataset, known: Known, together: bool = False) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, "n m"]]:
    """Returns measured links that are left out, and masks of the other links that may be used for each. Unless spectra of all
    frequencies are used together, links without others at their frequency are not left out."""
    rng = np.random.default_rng(2)
    positions, tx = dataset.tx_positions[known.links], dataset.tx_index[known.links]
    places = {number: positions[tx == number][0] for number in np.unique(tx)}
    chosen, kept = [], []
    # Fractions of the other transmitters, the nearest ones, that are left out together with a spectrum.
    shares_left_out = (0.0, 0.12, 0.25, 0.5)
    for place in _in_turn(tx, rng):
        others = sorted(places.keys() - {tx[place]}, key=lambda own: float(np.linalg.norm(places[own] - positions[place])))
        same = np.isclose(dataset.frequencies_hz[known.links], dataset.frequencies_hz[known.links[place]], rtol=1e-4)
        for count in sorted({int(share * len(others)) for share in shares_left_out}):
            use = np.isin(tx, others[count:])
            if (use & (same | together)).any():
                chosen.append(known.links[place])
                kept.append(use)
        if len(chosen) >= LEFT_OUT:
            break
    return np.array(chosen, int), np.array(kept, bool).reshape(len(chosen), len(known.links))


def _in_turn(tx: Int[np.ndarray, " m"], rng: np.random.Generator) -> Int[np.ndarray, " m"]:
    """Returns all indices in a random order in which every transmitter occurs once before any occurs twice."""
    order = rng.permutation(len(tx))
    seen: dict[int, int] = {}
    turn = np.empty(len(tx), int)
    for place in order:
        turn[place] = seen[tx[place]] = seen.get(tx[place], -1) + 1
    return order[np.argsort(turn[order], kind="stable")]


def _reach(positions: Float[np.ndarray, "m 3"]) -> tuple[float, float]:
    """Returns the median distance (metres) between a transmitter and the nearest other, and the largest between two."""
    places = np.unique(positions, axis=0)
    near = spacing(places) if len(places) > 1 else 1.0
    return max(near, LOG_METRE), float(max(pdist(places).max(initial=0), 2 * LOG_METRE))


def start_mixture(dataset: Dataset, known: Known, near: float) -> Mixture:
    """Returns a mixture with the prior weights, in which those of the line of sight and of the field are zero; `near` is the
    spacing of the transmitters, metres."""
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
    """Returns the predictions of simple methods for links, and the distances (metres) to the nearest transmitter in use.

    Args:
        mixture: mixture.
        dataset: data of one receiver.
        known: measured spectra.
        index: indices of N links.
        kept: masks of the measured spectra that are used for each link.
        members: names of K simple methods.
    """
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
    """Returns the means of N subsets of a limited number of the measured spectra."""
    averaged = 512  # maximum number of measured spectra over which the mean is computed
    sample = np.random.default_rng(3).permutation(len(known.links))[:averaged]
    pixels = known.images[sample].reshape(len(sample), -1).astype(np.float32) / 255
    means = kept[:, sample] @ pixels / np.maximum(kept[:, sample].sum(1), 1)[:, None].astype(np.float32)
    return means.reshape(len(kept), *known.images.shape[1:])


# The field's weight


def choose_share(
    scores: Float[np.ndarray, "n shares"], u: Float[np.ndarray, " n"], group: Int[np.ndarray, " n"], with_paths: bool = False
) -> tuple[tuple[float, float], bool]:
    """Returns bias and slope of the logit of the field's weight, and whether the field alone is as good.

    Args:
        scores: SSIM of held-out links by the weight of the field (`fields.mixture.SHARES`).
        u: scaled_distance logarithm of the distance to the nearest measured transmitter.
        group: groups of links with correlated errors.
        with_paths: whether the field predicts paths, so that its weight is one without evidence instead of zero.
    """
    errors = ERRORS_WITH_PATHS if with_paths else ERRORS

    def bound(gains: Float[np.ndarray, " n"], change: float) -> float:
        return lower_bound(gains, group, USUAL_SPREAD * change, errors)

    default = -1 if with_paths else 0
    best, found = 0.0, (30.0 if with_paths else -30.0, 0.0)
    slopes = (0.0, -1.0, 1.0)  # slopes of the logit of the field's weight that are tried
    least_gain = 0.005  # minimum gain (SSIM) of a slope other than 0, and of a mixture over the field alone
    for slope in slopes:
        for middle in np.delete(SHARES, default):
            bias = float(logit(np.clip(middle, 1e-4, 1 - 1e-4)))
            share = expit(bias + slope * u) if slope else np.full(len(u), middle)
            worth = bound(_at(scores, share) - scores[:, default], float(np.abs(share - SHARES[default]).mean()))
            if worth > best + (least_gain if slope and not found[1] else 0):
                best, found = worth, (bias, slope)
    chosen = expit(found[0] + found[1] * u)
    proven = with_paths or bound(scores[:, -1] - scores[:, 0], 1.0) > 0
    gain, _ = standard_error(_at(scores, chosen) - scores[:, -1], group)
    return found, bool(proven and gain < least_gain)


def _at(scores: Float[np.ndarray, "n shares"], share: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns the scores at weights, interpolated between those of `fields.mixture.SHARES`."""
    return np.asarray(score_at(scores.astype(np.float64), share))
