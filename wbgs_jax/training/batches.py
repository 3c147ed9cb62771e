"""A dataset on the device, if a field can be trained on it: snapshots or 8-bit pixels of all links, of which a step makes the
spectra of its batch.

Transmitters that nobody measured, with spectra that kriging gives them: what keeps a field that knows no paths from learning
a few spectra by heart (host).

Between few transmitters such a field makes up what it likes. Half of every batch are therefore links of transmitters somewhere
between and around the known ones, whose spectra are ordinary kriging's (`inference.mixture`): the field starts from the kriged
spectra, and varies over transmitters as smoothly as they do.
"""

import dataclasses
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, Key, UInt8

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree
from wbgs_jax.config import Settings, limit_steps
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.fields import Field, field_names, get_field
from wbgs_jax.observation_kinds import KINDS, Observations, Observed, spectra_of
from wbgs_jax.radio.array import pas_directions, steering_vector
from wbgs_jax.types import Batch, Links, Query, Receiver

FAR_M = 500.0
"""From the origin: there single precision rounds positions to 30 micrometres, a hundredth of a wavelength at 100 GHz."""


@pytree
class TrainingData(Observed):
    """All links, and what was observed on them."""

    receivers: Receiver
    """With a leading axis."""
    links: Links
    observations: Observations
    """By kind; beside virtual links the spectra of all links, too."""
    steering: Complex[Array, "90 360 elements"] | None
    """Of the only receiver, if its array scales with the frequency and spectra depend on it: made once."""

    def receiver_of(self, index: Int[Array, " b"]) -> Receiver:
        """Returns the receiver of some links, all of which have the same."""
        if self.receivers.position.shape[0] == 1:
            return jax.tree.map(lambda leaf: leaf[0], self.receivers)
        number = self.links.receiver_index[index[0]]
        return jax.tree.map(lambda leaf: leaf[number], self.receivers)

    def pas(self, index: Int[Array, " b"]) -> Float[Array, "b 90 360"] | None:
        """Returns the observed spectra of some links of one receiver; None where there are none."""
        return self._spectra(self._rows(index), index)

    def batch(self, index: Int[Array, " b"], key: Key[Array, ""]) -> Batch:
        """Returns some links of one receiver with everything that was observed on them."""
        observed = self._rows(index)
        if (spectra := self._spectra(observed, index)) is not None:
            observed["pas"] = spectra
        return Batch(jax.tree.map(lambda leaf: leaf[index], self.links), self.receiver_of(index), observed, key)

    def _rows(self, index: Int[Array, " b"]) -> Observations:
        return {name: values[index] for name, values in self.observations.items()}

    def _spectra(self, observed: Observations, index: Int[Array, " b"]) -> Float[Array, "b 90 360"] | None:
        elements = self.receiver_of(index).element_wavelengths(self.links.query.frequency_hz[index])
        return spectra_of(observed, elements, self.steering)


def batches_of_one_receiver(
    data: TrainingData, pool: Int[np.ndarray, " n"], count: int, size: int, rng: np.random.Generator
) -> Int[Array, "count b"]:
    """Returns so many batches of links of a pool, drawn with replacement, each of one receiver and of `size` links, or of as
    many as the pool has (host)."""
    receiver = np.asarray(data.links.receiver_index)[pool]
    owns = [pool[receiver == number] for number in rng.choice(receiver, count)]
    return jnp.asarray([rng.choice(own, min(size, len(pool))) for own in owns], jnp.int32)


def training_data(dataset: Dataset) -> TrainingData:
    """Returns a dataset on the device."""
    receivers, steering = dataset.receivers, None
    if dataset.observed.needs_array and receivers.position.shape[0] == 1 and receivers.unit == "wavelengths":
        steering = steering_vector(receivers.element_positions[0], jnp.asarray(pas_directions(), jnp.float32))
    return TrainingData(
        receivers=receivers,
        links=dataset.links(np.arange(len(dataset))),
        observations={name: jnp.asarray(values, KINDS[name].dtype) for name, values in dataset.observations.items()},
        steering=steering,
    )


def knows_no_paths(dataset: Dataset, field: type[Field]) -> bool:
    """Returns whether all that a field can know of data are their observations: it follows no paths, or there is no mesh."""
    return "paths" not in field.outputs or not len(dataset.faces)


def limited(settings: Settings, dataset: Dataset, field: type[Field]) -> Settings:
    """Returns settings with the steps that a field gets on a data set (`config.limit_steps`)."""
    return limit_steps(settings, len(dataset.train), knows_no_paths(dataset, field))


def check_data(dataset: Dataset, field: type[Field]) -> None:
    """Raises a `UserError` for data that a field cannot be trained on, before any work is done, and warns of coordinates that
    are too large."""
    if len(dataset.train) == 0:
        raise UserError(f"{dataset.name} has no training spectra; choose another split")
    far = max(float(np.abs(points).max(initial=0)) for points in (dataset.tx_positions, dataset.vertices))
    if far > FAR_M:
        warnings.warn(
            f"{dataset.name} holds coordinates of {far:,.0f} m, where single precision is coarse; subtract one offset from "
            "mesh, transmitters and receivers",
            stacklevel=1,  # of this line, whoever checks: it is said once
        )
    if not dataset.has_spectra and "power" not in field.outputs:
        able, words = ", ".join(name for name in field_names() if "power" in get_field(name).outputs), dataset.observed.words
        raise UserError(f"{dataset.name} holds {words}, of which the {field.name} field knows nothing; choose one of: {able}")


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
    if len(train) >= FEW or extent == 0 or not dataset.has_spectra:
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
    silent = {
        name: jnp.concatenate([values, jnp.full((count, *values.shape[1:]), KINDS[name].silence, values.dtype)])
        for name, values in data.observations.items()
        if name != "pas"
    }
    links = jax.tree.map(lambda *parts: jnp.concatenate(parts), data.links, more)
    images = jnp.asarray(np.concatenate([observed, virtual.images]))
    return dataclasses.replace(data, links=links, observations=silent | {"pas": images})
