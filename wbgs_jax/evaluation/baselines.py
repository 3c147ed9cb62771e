"""Baselines that learn nothing, reported beside every model: a model worse than inverse-distance weighting is of no use.

A baseline takes indices of spectra of its data set and returns their predicted PAS. It uses training spectra only; if a
frequency does not occur among them, those of the nearest one (in log f) are used instead.
"""

import functools
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.radio.array import PAS_SHAPE, snapshot_to_pas, steering_vector
from wbgs_jax.radio.geometry import to_local

Baseline = Callable[[Int[np.ndarray, " b"]], Float[np.ndarray, "b 90 360"]]

BLOCK = 256
"""Spectra processed together: a scene has thousands, of 32,400 pixels each."""


def can_lend(dataset: Dataset, index: Int[np.ndarray, " n"]) -> bool:
    """Returns whether every receiver of the links has training links, so that baselines can predict them."""
    return bool(np.isin(dataset.receiver_index[index], dataset.receiver_index[dataset.train]).all())


def baselines(dataset: Dataset) -> dict[str, Baseline]:
    """Returns the baselines of a data set by name; each call returns float32 PAS (b, 90, 360) for b indices.

    Raises:
        UserError: the data set has no training spectra to predict from.
    """
    if len(dataset.train) == 0:
        raise UserError(f"{dataset.name} has no training spectra; choose another split")
    return {
        "mean_image": mean_image(dataset),
        "nearest_tx": nearest_tx(dataset),
        "inverse_distance": inverse_distance(dataset),
        "line_of_sight": line_of_sight(dataset),
    }


def mean_image(dataset: Dataset) -> Baseline:
    """Returns a baseline that always predicts the mean of all training spectra."""

    @functools.cache
    def mean() -> np.ndarray:
        total = np.zeros(PAS_SHAPE)
        for block in _blocks(dataset.train):
            total += np.asarray(dataset.pas(block)).sum(0, dtype=np.float64)
        return (total / len(dataset.train)).astype(np.float32)

    return lambda index: np.tile(mean(), (len(index), 1, 1))


def nearest_tx(dataset: Dataset) -> Baseline:
    """Returns a baseline that predicts the training spectrum of the nearest transmitter at the same frequency and receiver."""

    def predict(index: Int[np.ndarray, " b"]) -> Float[np.ndarray, "b 90 360"]:
        predicted = np.zeros((len(index), *PAS_SHAPE), np.float32)
        nearest = nearest_links(dataset, index, dataset.train)
        for part in _blocks(np.arange(len(index))):
            predicted[part] = dataset.pas(nearest[part])
        return predicted

    return predict


def nearest_links(dataset: Dataset, index: Int[np.ndarray, " b"], among: Int[np.ndarray, " m"]) -> Int[np.ndarray, " b"]:
    """Returns, for every link, the one in `among` with the nearest transmitter, at the same frequency and receiver."""
    nearest = np.zeros(len(index), int)
    for chosen, neighbours in _by_frequency(dataset, index, among):
        nearest[chosen] = neighbours[_squared_distances(dataset, index[chosen], neighbours).argmin(1)]
    return nearest


def inverse_distance(dataset: Dataset) -> Baseline:
    """Returns a baseline: the mean of all training spectra at the same frequency and receiver, weighted by 1/d^2."""

    def predict(index: Int[np.ndarray, " b"]) -> Float[np.ndarray, "b 90 360"]:
        predicted = np.zeros((len(index), *PAS_SHAPE), np.float32)
        for chosen, neighbours in _by_frequency(dataset, index, dataset.train):
            # The lower bound, a square micrometre, avoids a division by zero for transmitters that train at another frequency.
            weights = 1 / np.maximum(_squared_distances(dataset, index[chosen], neighbours), 1e-12)
            weights = (weights / weights.sum(1, keepdims=True)).astype(np.float32)
            mixed = np.zeros((len(chosen), *PAS_SHAPE), np.float32)
            for columns in _blocks(np.arange(len(neighbours))):
                mixed += np.tensordot(weights[:, columns], np.asarray(dataset.pas(neighbours[columns])), 1)
            predicted[chosen] = mixed
        return predicted

    return predict


def line_of_sight(dataset: Dataset) -> Baseline:
    """Returns a baseline that predicts the PAS of one plane wave from the transmitter's direction: geometry only, including
    directions below the horizon."""

    def predict(index: Int[np.ndarray, " b"]) -> Float[np.ndarray, "b 90 360"]:
        predicted = np.zeros((len(index), *PAS_SHAPE), np.float32)
        for number in np.unique(dataset.receiver_index[index]):
            receiver = dataset.receiver(int(number))
            for part in _blocks(np.flatnonzero(dataset.receiver_index[index] == number)):
                query = dataset.query(index[part])
                offsets = jnp.asarray(dataset.tx_positions[index[part]] - np.asarray(receiver.position), jnp.float32)
                distances = jnp.linalg.norm(offsets, axis=-1, keepdims=True)
                directions = to_local(offsets / jnp.maximum(distances, 1e-9), receiver.orientation)  # for a TX at the receiver
                elements = receiver.element_wavelengths(query.frequency_hz)
                each = elements.ndim == 3
                waves = (jax.vmap(steering_vector) if each else steering_vector)(elements, directions)
                predicted[part] = snapshot_to_pas(waves, elements)
        return predicted

    return predict


def _by_frequency(dataset: Dataset, index: np.ndarray, among: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields, for every receiver and frequency of `index`: positions in `index`, and the links of `among` to predict them
    from."""
    frequencies, receivers = dataset.frequencies_hz[index], dataset.receiver_index[index]
    for number in np.unique(receivers):
        own = among[dataset.receiver_index[among] == number]
        if not len(own):
            raise UserError(f"{dataset.name} has no training spectra for receiver {number}; choose another split")
        trained = dataset.frequencies_hz[own]
        available = np.unique(trained)
        for frequency in np.unique(frequencies[receivers == number]):
            stand_in = available[np.abs(np.log(available / frequency)).argmin()]
            yield np.flatnonzero((frequencies == frequency) & (receivers == number)), own[trained == stand_in]


def _squared_distances(dataset: Dataset, index: np.ndarray, neighbours: np.ndarray) -> Float[np.ndarray, "b m"]:
    """Returns squared distances (m^2) between transmitters, one axis after the other to avoid a (b, m, 3) array."""
    a, b = dataset.tx_positions[index], dataset.tx_positions[neighbours]
    return sum(((a[:, None, axis] - b[None, :, axis]) ** 2 for axis in range(3)), np.zeros((len(a), len(b))))


def _blocks(index: np.ndarray) -> Iterator[np.ndarray]:
    return (index[start : start + BLOCK] for start in range(0, len(index), BLOCK))
