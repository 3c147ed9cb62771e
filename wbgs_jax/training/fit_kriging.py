"""Selection of residual kriging, which corrects a trained field by measured spectra nearby, on the validation part (host).

Spectra of the training part are used to predict those of the validation part, which the field was not trained on. If the best
choice improves significantly and by a relevant amount, the smoothest choice is kept that gains no less by more than a standard
error (Breiman et al. 1984), because validation transmitters often lie closer to their neighbours than later queries do. The
result then uses the spectra of both parts.
"""

import itertools
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num, UInt8
from scipy.spatial import cKDTree

from wbgs_jax._util.statistics import standard_error
from wbgs_jax.data.dataset import Dataset, places_of, training_links
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params
from wbgs_jax.inference.kriging import SAME_FREQUENCY, Neighbours
from wbgs_jax.inference.predictor import as_observed, corrected, predict_spectra
from wbgs_jax.metrics import ssim

Kind = Literal["residuals", "spectra"]
FEWEST, MOST = 4, 20_000
"""Minimum number of validation transmitters for a decision, and maximum number of measured spectra that are stored (32 kB
each)."""
MOST_RESIDUALS = 1000
"""Number of measured spectra above which residuals are not tried: the field was trained on these spectra, and many of them are
fitted almost without residual."""
SCORED = 60
"""Maximum number of validation spectra that are scored."""
SURE, WORTH = 2.0, 0.005
"""Minimum gain of the best choice, in standard errors and in SSIM."""


@dataclass(frozen=True)
class Choice:
    """Settings of residual kriging."""

    kind: Kind
    """Whether residuals of the field or the spectra themselves are interpolated."""
    length: float
    """Correlation length, metres."""
    weight: float
    """Factor of the interpolated values."""
    together: bool = False
    """Whether spectra of all frequencies are used together."""


class Learned(NamedTuple):
    """Result of the selection."""

    neighbours: Neighbours | None = None
    """Residual kriging from the training and validation parts; None to use the field alone."""
    line: str = ""
    """Summary for the terminal."""
    of_training: Neighbours | None = None
    """The same from the training part only, for evaluations on the validation part."""


def learn_neighbours(field: Field, params: Params, dataset: Dataset) -> Learned:
    """Returns the residual kriging that improves a trained field, if any.

    It is not used for data of several receivers or of received powers, with fewer than `FEWEST` validation
    transmitters, or with more than `MOST` measured spectra.
    """
    links = training_links(dataset)
    if not dataset.has_spectra:
        return Learned()
    if why := _why_not(dataset, len(links)):
        return Learned(line=f"no residual kriging: {why}")
    queried = np.random.default_rng(0).permutation(dataset.validation)[:SCORED]
    truth, tx = np.asarray(dataset.pas(queried)), places_of(dataset)[queried]
    own = predict_spectra(field, params, dataset, queried)

    def alike(pas: Float[np.ndarray, "n 90 360"]) -> Float[np.ndarray, " n"]:
        return ssim(as_observed(field, params, pas), truth)

    alone, of_training = alike(own), _Known(field, params, dataset, dataset.train)

    def gains(choice: Choice) -> Float[np.ndarray, " n"]:
        return alike(corrected(of_training.neighbours(choice), own, dataset, queried)) - alone

    chosen, gain = choose({choice: gains(choice) for choice in choices(dataset, dataset.train)}, tx)
    if chosen is None:
        return Learned(line=f"residual kriging gains nothing significant on validation ({gain:+.3f} SSIM): not used")
    line = f"kriging of {chosen.kind} within about {chosen.length:.2g} m gains {gain:+.3f} SSIM on validation: used"
    return Learned(_Known(field, params, dataset, links).neighbours(chosen), line, of_training.neighbours(chosen))


def _why_not(dataset: Dataset, known: int) -> str:
    """Returns the reason why residual kriging cannot be used for a dataset; empty if it can."""
    if dataset.n_receivers > 1:
        return "the data have several receivers"
    held_out = len(np.unique(places_of(dataset)[dataset.validation]))
    if held_out < FEWEST:
        return f"{held_out} validation transmitters are too few to measure its gain"
    return f"{known:,} measured spectra are more than {MOST:,}" if known > MOST else ""


class _Known:
    """Measured links, whose images are computed once for all choices."""

    def __init__(self, field: Field, params: Params, dataset: Dataset, index: Int[np.ndarray, " m"]):
        self._made: dict[Kind, Num[Array, "m 90 360"]] = {}
        self._trained, self.dataset, self.index = (field, params), dataset, index

    def neighbours(self, choice: Choice) -> Neighbours:
        """Returns the residual kriging from these links with the settings of a choice."""
        if choice.kind not in self._made:
            spectra = self.dataset.eight_bit(self.index)
            self._made[choice.kind] = images_of(choice.kind, spectra, self._predicted() if choice.kind == "residuals" else None)
        return make_neighbours(choice, self.dataset, self.index, self._made[choice.kind])

    def _predicted(self) -> Float[np.ndarray, "m 90 360"]:
        return as_observed(*self._trained, predict_spectra(*self._trained, self.dataset, self.index))


def images_of(
    kind: Kind, spectra: UInt8[np.ndarray, "m 90 360"], predicted: Float[np.ndarray, "m 90 360"] | None
) -> Num[Array, "m 90 360"]:
    """Returns the stored form of measured spectra: the spectra in bytes, or the residuals of a field in half precision."""
    if kind == "spectra":
        return jnp.asarray(spectra)
    assert predicted is not None, "residuals need predictions"
    return jnp.asarray(spectra / 255 - predicted, jnp.float16)


def choices(dataset: Dataset, known: Int[np.ndarray, " n"]) -> list[Choice]:
    """Returns the choices that are tried for measured links, given by their indices; none for a single transmitter position."""
    positions = np.unique(dataset.tx_positions[known], axis=0)
    if len(positions) < 2:
        return []
    metres = spacing(positions)
    kinds: tuple[Kind, ...] = ("residuals", "spectra") if len(known) <= MOST_RESIDUALS else ("spectra",)
    # Correlation lengths that are tried, relative to the median distance between a training transmitter and the nearest other.
    spacings = (0.5, 1, 2, 4, 8, 16, 32)
    weights = (0.5, 1.0)  # weights of the kriged spectra that are tried
    together = (False, True) if scattered(dataset, known) else (False,)
    tried = itertools.product(kinds, spacings, weights, together)
    return [Choice(kind, scale * metres, weight, joined) for kind, scale, weight, joined in tried]


def scattered(dataset: Dataset, known: Int[np.ndarray, " n"]) -> bool:
    """Returns whether most of the measured links have a frequency at which at most half of the transmitters were measured."""
    hertz, which = np.unique(dataset.frequencies_hz[known], return_inverse=True)
    group = np.cumsum(np.diff(np.log(hertz), prepend=np.log(hertz[0])) >= SAME_FREQUENCY)[which]
    tx = np.unique(dataset.tx_index[known], return_inverse=True)[1]
    pairs = np.unique(np.stack([group, tx]), axis=1)
    share = np.bincount(pairs[0])[group] / (tx.max() + 1)
    return bool(np.median(share) <= 0.5)


def spacing(places: Float[np.ndarray, "n 3"]) -> float:
    """Returns the median distance (metres) between a place and the nearest other, of at least two different places; places
    within a centimetre count as one, unless all of them are."""
    same_m = 1e-2
    nearest = cKDTree(places).query(places, 2)[0][:, 1]
    if nearest.min() >= same_m:
        return float(np.median(nearest))
    _, first = np.unique(np.round(places / same_m), axis=0, return_index=True)
    most = 9  # one place may be rounded to eight
    away = cKDTree(places[first]).query(places[first], most)[0]
    others = np.where(away >= same_m, away, np.inf).min(1)
    return float(np.median(others if np.isfinite(others).all() else nearest))


def choose(tried: dict[Choice, Float[np.ndarray, " n"]], tx_index: Int[np.ndarray, " n"]) -> tuple[Choice | None, float]:
    """Returns the best choice and its mean gain; the choice is None if no gain is significant.

    Of two choices the smoother one is that with full weight, then that of spectra, then that with the longer length.

    Args:
        tried: gains (SSIM) of N links over the field alone, by choice.
        tx_index: transmitters of the links.
    """
    if not tried:
        return None, 0.0
    best = max(tried, key=lambda choice: float(tried[choice].mean()))
    gain, error = standard_error(tried[best], tx_index)
    if gain <= max(SURE * error, WORTH):
        return None, gain
    enough = [choice for choice, gains in tried.items() if standard_error(gains, tx_index)[0] >= gain - error]
    smoothest = max(enough, key=lambda choice: (choice.weight, choice.kind == "spectra", choice.length))
    return smoothest, standard_error(tried[smoothest], tx_index)[0]


def make_neighbours(
    choice: Choice, dataset: Dataset, index: Int[np.ndarray, " m"], images: Num[Array, "m 90 360"]
) -> Neighbours:
    """Returns the residual kriging from measured links.

    Args:
        choice: its settings.
        dataset: data of one receiver.
        index: indices of the links.
        images: result of `images_of` for these links.
    """
    spectra = choice.kind == "spectra"
    return Neighbours(
        rx_position=dataset.receiver().position,
        rx_orientation=dataset.receiver().orientation,
        tx_position=jnp.asarray(dataset.tx_positions[index], jnp.float32),
        frequency_hz=jnp.asarray(np.where(choice.together, np.nan, dataset.frequencies_hz[index]), jnp.float32),
        images=images,
        scale=jnp.float32(1 / 255 if spectra else 1.0),
        weight=jnp.float32(choice.weight),
        own=jnp.float32(spectra),
        length=jnp.float32(choice.length),
    )
