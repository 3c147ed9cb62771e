"""Whether known spectra nearby are to be asked beside a trained field, and how: found on the validation part, on the host.

The training part is what is asked, at transmitters of the validation part, which the field has not seen. If the best way
surely gains something that is worth it, the smoothest one is kept that gains no less by more than a standard error (Breiman
et al. 1984): validation transmitters often lie closer to their neighbours than those that are asked for later. Afterwards both
parts are asked.
"""

import itertools
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num, UInt8
from scipy.spatial import cKDTree

from wbgs_jax._util.statistics import standard_error
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.splits import training_links
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params
from wbgs_jax.inference.kriging import Neighbours
from wbgs_jax.inference.predictor import as_observed, corrected, predict_spectra
from wbgs_jax.metrics import ssim

Kind = Literal["residuals", "spectra"]
FEWEST, MOST = 4, 20_000
"""Validation spectra below which nothing is decided; known spectra above which nothing is kept (32 kB each)."""
MOST_RESIDUALS = 1000
"""Known spectra above which residuals are not tried: they are those of spectra that the field was trained on, and of many of
them it leaves none."""
SCORED = 60
"""Validation spectra that are looked at."""
SPACINGS = (0.5, 1, 2, 4, 8, 16, 32)
"""Lengths that are tried, in median distances of a training transmitter to the next one."""
WEIGHTS = (0.5, 1.0)
SURE, WORTH = 2.0, 0.005
"""Standard errors, and SSIM, that the best of them has to gain."""


@dataclass(frozen=True)
class Choice:
    """How neighbours are asked."""

    kind: Kind
    length: float
    """Metres."""
    weight: float


class Learned(NamedTuple):
    """What was found."""

    neighbours: Neighbours | None = None
    """None: the field is better by itself."""
    line: str = ""
    """What was found, in words."""
    of_training: Neighbours | None = None
    """The same of the training part alone, for whoever looks at the validation part."""


def learn_neighbours(field: Field, params: Params, dataset: Dataset) -> Learned:
    """Returns the neighbours that improve a trained field.

    Data of several receivers, of received powers, with fewer than `FEWEST` validation or more than `MOST` known spectra have
    none.
    """
    links = training_links(dataset)
    if not dataset.has_spectra:
        return Learned()
    if why := _why_not(dataset, len(links)):
        return Learned(line=f"neighbours are not asked: {why}")
    asked = np.random.default_rng(0).permutation(dataset.validation)[:SCORED]
    truth, tx = np.asarray(dataset.pas(asked)), dataset.tx_index[asked]
    own = predict_spectra(field, params, dataset, asked)

    def alike(pas: Float[np.ndarray, "n 90 360"]) -> Float[np.ndarray, " n"]:
        return ssim(as_observed(field, params, pas), truth)

    alone, of_training = alike(own), _Known(field, params, dataset, dataset.train)

    def gains(choice: Choice) -> Float[np.ndarray, " n"]:
        return alike(corrected(of_training.neighbours(choice), own, dataset, asked)) - alone

    chosen, gain = choose({choice: gains(choice) for choice in choices(dataset, dataset.train)}, tx)
    if chosen is None:
        return Learned(line=f"neighbours gain nothing sure on validation ({gain:+.3f} SSIM): the field answers alone")
    line = f"{chosen.kind} of neighbours within about {chosen.length:.2g} m, asked too, gain {gain:+.3f} SSIM on validation"
    return Learned(_Known(field, params, dataset, links).neighbours(chosen), line, of_training.neighbours(chosen))


def _why_not(dataset: Dataset, known: int) -> str:
    """Returns why a data set can have no neighbours; nothing, where it can."""
    if dataset.n_receivers > 1:
        return "the data have several receivers"
    if len(dataset.validation) < FEWEST:
        return f"of {len(dataset.validation)} validation spectra there is nothing to learn whether that gains"
    return f"{known:,} known spectra are more than {MOST:,}" if known > MOST else ""


class _Known:
    """Known links, whose images are made once for all choices."""

    def __init__(self, field: Field, params: Params, dataset: Dataset, index: Int[np.ndarray, " m"]):
        self._made: dict[Kind, Num[Array, "m 90 360"]] = {}
        self._asked, self.dataset, self.index = (field, params), dataset, index

    def neighbours(self, choice: Choice) -> Neighbours:
        """Returns them as neighbours."""
        if choice.kind not in self._made:
            spectra = self.dataset.eight_bit(self.index)
            self._made[choice.kind] = images_of(choice.kind, spectra, self._predicted() if choice.kind == "residuals" else None)
        return make_neighbours(choice, self.dataset, self.index, self._made[choice.kind])

    def _predicted(self) -> Float[np.ndarray, "m 90 360"]:
        return as_observed(*self._asked, predict_spectra(*self._asked, self.dataset, self.index))


def images_of(
    kind: Kind, spectra: UInt8[np.ndarray, "m 90 360"], predicted: Float[np.ndarray, "m 90 360"] | None
) -> Num[Array, "m 90 360"]:
    """Returns what is kept of known spectra: themselves in bytes, or what a field leaves of them in half precision."""
    if kind == "spectra":
        return jnp.asarray(spectra)
    assert predicted is not None, "residuals are what predictions leave"
    return jnp.asarray(spectra / 255 - predicted, jnp.float16)


def choices(dataset: Dataset, known: Int[np.ndarray, " n"]) -> list[Choice]:
    """Returns what is tried."""
    positions = np.unique(dataset.tx_positions[known], axis=0)
    if len(positions) < 2:
        return []
    metres = spacing(positions)
    kinds: tuple[Kind, ...] = ("residuals", "spectra") if len(known) <= MOST_RESIDUALS else ("spectra",)
    return [Choice(kind, scale * metres, weight) for kind, scale, weight in itertools.product(kinds, SPACINGS, WEIGHTS)]


def spacing(places: Float[np.ndarray, "n 3"]) -> float:
    """Returns the median distance (metres) of a place to the next one, of two or more different ones."""
    return float(np.median(cKDTree(places).query(places, 2)[0][:, 1]))


def choose(tried: dict[Choice, Float[np.ndarray, " n"]], tx_index: Int[np.ndarray, " n"]) -> tuple[Choice | None, float]:
    """Returns the choice by its gains over the field alone (None: nothing sure), and its mean gain.

    Of two, the one with the full weight is smoother, then the one of spectra, then the longer one.
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
    """Returns known links, with `images_of` them, as neighbours."""
    spectra = choice.kind == "spectra"
    return Neighbours(
        rx_position=dataset.receiver().position,
        tx_position=jnp.asarray(dataset.tx_positions[index], jnp.float32),
        frequency_hz=jnp.asarray(dataset.frequencies_hz[index], jnp.float32),
        images=images,
        scale=jnp.float32(1 / 255 if spectra else 1.0),
        weight=jnp.float32(choice.weight),
        own=jnp.float32(spectra),
        length=jnp.float32(choice.length),
    )
