"""Transmitters that nobody measured, with spectra that kriging gives them: what keeps a field that knows no paths from learning
a few spectra by heart (host).

Between few transmitters such a field makes up what it likes. Half of every batch are therefore links of transmitters somewhere
between and around the known ones, whose spectra are ordinary kriging's (`inference.mixture`): the field starts from the kriged
spectra, and varies over transmitters as smoothly as they do.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from wbgs_jax.data.dataset import Dataset
from wbgs_jax.fields import Field
from wbgs_jax.training.data import TrainingData, knows_no_paths, training_data
from wbgs_jax.types import Links, Query

FEW = 128
"""Training spectra from which on there are no virtual ones."""
COUNT = 4, 256
"""Virtual links for every training link, and at most."""
BEYOND, BESIDE = 0.3, 0.1
"""How far they lie beyond two known transmitters, in their distance, and beside the line between them, in the extent of all."""
LENGTH, NUGGET = 0.5, 0.01
"""Of the kriging: length in the extent of all transmitters, and nugget."""


class VirtualLinks(NamedTuple):
    """Links that nobody measured."""

    tx_position: Float[np.ndarray, "v 3"]
    """World frame, metres."""
    frequency_hz: Float[np.ndarray, " v"]
    receiver_index: Int[np.ndarray, " v"]
    images: UInt8[np.ndarray, "v 90 360"]
    """255 times the spectra."""


def virtual_links(dataset: Dataset, seed: int) -> VirtualLinks | None:
    """Returns virtual links around the training links of a data set; None where these are many, or of a single transmitter or
    without spectra."""
    train = dataset.train
    positions = dataset.tx_positions[train]
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    if len(train) >= FEW or extent == 0 or dataset.kind == "power":
        return None
    rng = np.random.default_rng([seed, 7])
    count = min(COUNT[0] * len(train), COUNT[1])
    first, second = rng.integers(len(train), size=(2, count))
    along = rng.uniform(-BEYOND, 1 + BEYOND, (count, 1))
    places = positions[first] + along * (positions[second] - positions[first])
    places += rng.normal(0, BESIDE * extent / np.sqrt(3), places.shape)
    spectra, images = np.asarray(dataset.pas(train)), np.empty((count, 90, 360), np.uint8)
    frequency, receiver = dataset.frequencies_hz[train], dataset.receiver_index[train]
    for i in range(count):
        alike = np.flatnonzero((frequency == frequency[first[i]]) & (receiver == receiver[first[i]]))
        weights = kriging_weights(positions[alike], places[i], LENGTH * extent, NUGGET)
        images[i] = (255 * np.clip(np.tensordot(weights, spectra[alike], 1), 0, 1)).round()
    return VirtualLinks(places, frequency[first], receiver[first], images)


def data_with_virtual(
    dataset: Dataset, field: type[Field], seed: int | None
) -> tuple[TrainingData, list[Int[np.ndarray, " v"]]]:
    """Returns data on the device and, of every receiver, the numbers of its virtual links: none without a seed, or where the
    field knows paths."""
    data, count = training_data(dataset), len(dataset)
    virtual = virtual_links(dataset, seed) if seed is not None and knows_no_paths(dataset, field) else None
    if virtual is None:
        return data, [np.zeros(0, int)] * dataset.n_receivers
    numbers = [count + np.flatnonzero(virtual.receiver_index == receiver) for receiver in range(dataset.n_receivers)]
    return with_virtual(data, virtual, dataset.eight_bit(np.arange(count))), numbers


def with_virtual_drawn(
    drawn: Int[np.ndarray, " b"], virtual: Int[np.ndarray, " v"], share: float, rng: np.random.Generator
) -> Int[np.ndarray, " b"]:
    """Returns a batch of links of one receiver, a share of which gives way to virtual ones of it, where it has any."""
    count = round(share * len(drawn)) if len(virtual) else 0
    return np.concatenate([drawn[count:], rng.choice(virtual, count)]) if count else drawn


def kriging_weights(
    positions: Float[np.ndarray, "n 3"], place: Float[np.ndarray, "3"], length: float, nugget: float
) -> Float[np.ndarray, " n"]:
    """Returns the weights of ordinary kriging with the kernel exp(-distance / length), which sum to 1."""
    kernel = np.exp(-np.linalg.norm(positions[:, None] - positions[None], axis=-1) / length) + nugget * np.eye(len(positions))
    right = np.column_stack([np.exp(-np.linalg.norm(positions - place, axis=-1) / length), np.ones(len(positions))])
    simple, ones = np.linalg.solve(kernel, right).T
    weights: np.ndarray = simple + (1 - simple.sum()) / ones.sum() * ones
    return weights


def with_virtual(data: TrainingData, virtual: VirtualLinks, observed: UInt8[np.ndarray, "n 90 360"]) -> TrainingData:
    """Returns training data with virtual links behind the others, each of a transmitter of its own. `observed` are the spectra
    of the others; nothing but a spectrum is known of a virtual link."""
    count = len(virtual.frequency_hz)
    more = Links(
        Query(jnp.asarray(virtual.tx_position, jnp.float32), jnp.asarray(virtual.frequency_hz, jnp.float32)),
        jnp.asarray(virtual.receiver_index, jnp.int32),
        jnp.arange(count, dtype=jnp.int32) + 1 + jnp.max(data.links.tx_index),
    )
    snapshots = None
    if data.snapshots is not None:  # of silence, from which no power is learned
        snapshots = jnp.concatenate([data.snapshots, jnp.zeros((count, data.snapshots.shape[1]), data.snapshots.dtype)])
    links = jax.tree.map(lambda *parts: jnp.concatenate(parts), data.links, more)
    images = jnp.asarray(np.concatenate([observed, virtual.images]))
    return dataclasses.replace(data, links=links, snapshots=snapshots, images=images)
