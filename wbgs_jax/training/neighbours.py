"""Whether known spectra nearby are to be asked beside a trained field, and how: found on the validation part, on the host.

The training part is what is asked, at the transmitters of the validation part, which the field has not seen. If the best way
gains more than a standard error, the smoothest one is kept that gains no less by more than a standard error (Breiman et al.
1984): validation transmitters often lie closer to their neighbours than those that are asked for later. Afterwards both
parts are asked.
"""

import itertools
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.splits import training_links
from wbgs_jax.evaluation.metrics import ssim
from wbgs_jax.fields import Field
from wbgs_jax.inference.neighbours import Neighbours, correct, nearness
from wbgs_jax.inference.predictor import predict_spectra
from wbgs_jax.training.scores import standard_error

Kind = Literal["residuals", "spectra"]
FEWEST, MOST = 4, 1000
"""Validation spectra below which nothing is decided; known spectra above which nothing is kept (130 kB each)."""
SCORED = 60
"""Validation spectra that are looked at."""
SPACINGS = (0.5, 1, 2, 4, 8, 16, 32)
"""Lengths that are tried, in median distances of a training transmitter to the next one."""
WEIGHTS = (0.5, 1.0)
NOISE = 1e-2
"""Variance of what is no function of the position, beside 1."""


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


def learn_neighbours(field: Field, params: Any, dataset: Dataset) -> Learned:
    """Returns the neighbours that improve a trained field.

    Data of several receivers, of received powers, with fewer than `FEWEST` validation or more than `MOST` known spectra have
    none.
    """
    links = training_links(dataset)
    if dataset.kind == "power" or dataset.n_receivers > 1 or len(dataset.validation) < FEWEST or len(links) > MOST:
        return Learned()
    truth, predicted = np.asarray(dataset.pas(links)), predict_spectra(field, params, dataset, links)
    known, asked = (np.flatnonzero(np.isin(links, part)) for part in (dataset.train, dataset.validation))
    asked = np.random.default_rng(0).permutation(asked)[:SCORED]
    alone = ssim(predicted[asked], truth[asked])
    query = dataset.query(links[asked])

    def gains(choice: Choice) -> Float[np.ndarray, " n"]:
        neighbours = make_neighbours(choice, dataset, links[known], truth[known], predicted[known])
        return ssim(np.asarray(correct(neighbours, jnp.asarray(predicted[asked]), query)), truth[asked]) - alone

    tx = dataset.tx_index[links[asked]]
    chosen, gain = choose({choice: gains(choice) for choice in choices(dataset, links[known])}, tx)
    if chosen is None:
        return Learned(line=f"neighbours gain nothing sure on validation ({gain:+.3f} SSIM): the field answers alone")
    line = f"{chosen.kind} of neighbours within about {chosen.length:.2g} m, asked too, gain {gain:+.3f} SSIM on validation"
    of_training = make_neighbours(chosen, dataset, links[known], truth[known], predicted[known])
    return Learned(make_neighbours(chosen, dataset, links, truth, predicted), line, of_training)


def choices(dataset: Dataset, known: Int[np.ndarray, " n"]) -> list[Choice]:
    """Returns what is tried."""
    positions = np.unique(dataset.tx_positions[known], axis=0)
    if len(positions) < 2:
        return []
    distances = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    spacing = float(np.median(np.sort(distances, axis=1)[:, 1]))
    kinds: tuple[Kind, ...] = ("residuals", "spectra")
    return [Choice(kind, scale * spacing, weight) for kind, scale, weight in itertools.product(kinds, SPACINGS, WEIGHTS)]


def choose(tried: dict[Choice, Float[np.ndarray, " n"]], tx_index: Int[np.ndarray, " n"]) -> tuple[Choice | None, float]:
    """Returns the choice by its gains over the field alone (None: nothing sure), and its mean gain.

    Of two, the one with the full weight is smoother, then the one of spectra, then the longer one.
    """
    if not tried:
        return None, 0.0
    best = max(tried, key=lambda choice: float(tried[choice].mean()))
    gain, error = standard_error(tried[best], tx_index)
    if gain <= error:
        return None, gain
    enough = [choice for choice, gains in tried.items() if standard_error(gains, tx_index)[0] >= gain - error]
    smoothest = max(enough, key=lambda choice: (choice.weight, choice.kind == "spectra", choice.length))
    return smoothest, standard_error(tried[smoothest], tx_index)[0]


def make_neighbours(
    choice: Choice,
    dataset: Dataset,
    index: Int[np.ndarray, " m"],
    truth: Float[np.ndarray, "m 90 360"],
    predicted: Float[np.ndarray, "m 90 360"],
) -> Neighbours:
    """Returns known links as neighbours."""
    positions = jnp.asarray(dataset.tx_positions[index], jnp.float32)
    frequencies = jnp.asarray(dataset.frequencies_hz[index], jnp.float32)
    kernel = np.asarray(nearness(positions, frequencies, positions, frequencies, choice.length), np.float64)
    weights = choice.weight * np.linalg.inv(kernel + NOISE * np.eye(len(index)))
    spectra = choice.kind == "spectra"
    arrays = truth if spectra else truth - predicted, weights, float(spectra), choice.length
    return Neighbours(dataset.receiver().position, positions, frequencies, *(jnp.asarray(a, jnp.float32) for a in arrays))
