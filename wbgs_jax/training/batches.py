"""A dataset on the device: snapshots or 8-bit pixels of all links, from which every training step computes the spectra of its
batch; and the check that a field can be trained on it.

Virtual links keep a field without paths from overfitting a few spectra (host). Between a small number of transmitters the
predictions of such a field are arbitrary. Half of every batch are therefore links of virtual transmitters between and around
the measured ones, with spectra from ordinary kriging (`inference.kriging`): the field starts from the kriged spectra, and
varies as smoothly with the transmitter's position as they do.
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
from wbgs_jax.data.scene import on_surfaces
from wbgs_jax.fields import Field, field_names, get_field
from wbgs_jax.observation_kinds import KINDS, Observations, Observed, spectra_of
from wbgs_jax.radio.array import pas_directions, steering_vector
from wbgs_jax.types import Batch, Links, Receiver, Transmitter


@pytree
class TrainingData(Observed):
    """All links with their observations."""

    receivers: Receiver
    """All receivers, with a leading axis."""
    links: Links
    observations: Observations
    """Observations by kind; with virtual links also the spectra of all links."""
    steering: Complex[Array, "90 360 elements"] | None
    """Steering vectors of a single receiver whose element positions are in wavelengths, if spectra are computed from snapshots;
    None otherwise."""

    def receiver_of(self, index: Int[Array, " b"]) -> Receiver:
        """Returns the receiver of links, which all have the same one."""
        if self.receivers.position.shape[0] == 1:
            return jax.tree.map(lambda leaf: leaf[0], self.receivers)
        number = self.links.receiver_index[index[0]]
        return jax.tree.map(lambda leaf: leaf[number], self.receivers)

    def pas(self, index: Int[Array, " b"]) -> Float[Array, "b 90 360"] | None:
        """Returns the observed spectra of links of one receiver; None for data without spectra."""
        return self._spectra(self._rows(index), index)

    def batch(self, index: Int[Array, " b"], key: Key[Array, ""]) -> Batch:
        """Returns links of one receiver with all of their observations."""
        observed = self._rows(index)
        if (spectra := self._spectra(observed, index)) is not None:
            observed["pas"] = spectra
        return Batch(jax.tree.map(lambda leaf: leaf[index], self.links), self.receiver_of(index), observed, key)

    def _rows(self, index: Int[Array, " b"]) -> Observations:
        return {name: values[index] for name, values in self.observations.items()}

    def _spectra(self, observed: Observations, index: Int[Array, " b"]) -> Float[Array, "b 90 360"] | None:
        elements = self.receiver_of(index).element_wavelengths(self.links.frequency_hz[index])
        return spectra_of(observed, elements, self.steering)


def batches_of_one_receiver(
    data: TrainingData, pool: Int[np.ndarray, " n"], count: int, size: int, rng: np.random.Generator
) -> Int[Array, "count b"]:
    """Returns random batches of links, drawn with replacement, each of a single receiver (host).

    Args:
        data: training data.
        pool: indices of the links to draw from.
        count: number of batches.
        size: links per batch, at most the size of the pool.
        rng: random numbers.
    """
    receiver = np.asarray(data.links.receiver_index)[pool]
    owns = [pool[receiver == number] for number in rng.choice(receiver, count)]
    return jnp.asarray([rng.choice(own, min(size, len(pool))) for own in owns], jnp.int32)


def training_data(dataset: Dataset) -> TrainingData:
    """Returns a dataset as arrays on the device."""
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
    """Returns whether a field must learn from the observations alone, since it predicts no paths or the data have no mesh."""
    return "paths" not in field.outputs or not len(dataset.faces)


def limited(settings: Settings, dataset: Dataset, field: type[Field]) -> Settings:
    """Returns settings with the number of steps for a field and a dataset (`config.limit_steps`)."""
    return limit_steps(settings, len(dataset.train), knows_no_paths(dataset, field))


def check_data(dataset: Dataset, field: type[Field]) -> None:
    """Checks data before any work is done, and warns if coordinates are too large for single precision.

    Raises:
        UserError: there are no training spectra, or the field cannot be trained on this kind of observation.
    """
    if len(dataset.train) == 0:
        raise UserError(f"{dataset.name} has no training spectra; choose another split")
    far = max(float(np.abs(points).max(initial=0)) for points in (dataset.tx_positions, dataset.vertices))
    # Distance from the origin, metres, at which single precision rounds positions to 30 micrometres, a hundredth of a
    # wavelength at 100 GHz.
    far_m = 500.0
    if far > far_m:
        warnings.warn(
            f"{dataset.name} holds coordinates of {far:,.0f} m, where single precision is coarse; subtract one offset from "
            "mesh, transmitters and receivers",
            stacklevel=1,  # that of this line, so that the warning appears once
        )
    if not knows_no_paths(dataset, field):
        ends = np.unique(dataset.tx_positions, axis=0), np.asarray(dataset.receivers.position, np.float64)
        transmitters, receivers = (int(on_surfaces(dataset, points).sum()) for points in ends)
        if transmitters or receivers:
            warnings.warn(
                f"{dataset.name}: {transmitters} transmitters and {receivers} receivers lie on a surface of the mesh (within "
                "1 mm), hence on both sides of it; move them or the surface by 2 mm",
                stacklevel=1,
            )
    if not dataset.has_spectra and "power" not in field.outputs:
        able, words = ", ".join(name for name in field_names() if "power" in get_field(name).outputs), dataset.observed.words
        raise UserError(f"{dataset.name} holds {words}, which the {field.name} field does not predict; choose one of: {able}")


FEW = 128
"""Number of training spectra from which on virtual links are not used."""
BEYOND, BESIDE = 0.3, 0.1
"""Range of virtual transmitters beyond two measured ones, relative to the distance between these, and r.m.s. displacement from
the line through them, relative to the extent of all transmitters."""


class VirtualLinks(NamedTuple):
    """Links with kriged instead of measured spectra."""

    tx_position: Float[np.ndarray, "v 3"]
    """Positions of the virtual transmitters, world frame, metres."""
    frequency_hz: Float[np.ndarray, " v"]
    receiver_index: Int[np.ndarray, " v"]
    images: UInt8[np.ndarray, "v 90 360"]
    """Kriged spectra, multiplied by 255."""


def virtual_links(dataset: Dataset, seed: int) -> VirtualLinks | None:
    """Returns virtual links around the training links of a dataset; None if there are `FEW` training links or more, if all of
    a frequency and receiver have the same transmitter, or if the data have no spectra. Links without another transmitter at
    their frequency have none, since nothing is known about the change of their spectra with the position."""
    train = dataset.train
    positions = dataset.tx_positions[train]
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    if len(train) >= FEW or extent == 0 or not dataset.has_spectra:
        return None
    rng = np.random.default_rng([seed, 7])
    count = min(4 * len(train), 256)  # virtual links: four per training link, up to a maximum
    frequency, receiver = dataset.frequencies_hz[train], dataset.receiver_index[train]
    alike = (frequency[:, None] == frequency) & (receiver[:, None] == receiver)
    apart = alike & (positions[:, None] != positions).any(-1)
    if not apart.any():
        return None
    first = rng.choice(np.flatnonzero(apart.any(1)), count)
    second = np.array([rng.choice(np.flatnonzero(alike[one])) for one in first])
    along = rng.uniform(-BEYOND, 1 + BEYOND, (count, 1))
    places = positions[first] + along * (positions[second] - positions[first])
    places += rng.normal(0, BESIDE * extent / np.sqrt(3), places.shape)
    spectra, images = np.asarray(dataset.pas(train)), np.empty((count, 90, 360), np.uint8)
    length, nugget = 0.5, 0.01  # correlation length of the kriging, relative to the extent of all transmitters, and its nugget
    for i in range(count):
        known = alike[first[i]]
        weights = kriging_weights(positions[known], places[i], length * extent, nugget)
        images[i] = (255 * np.clip(np.tensordot(weights, spectra[known], 1), 0, 1)).round()
    return VirtualLinks(places, frequency[first], receiver[first], images)


def data_with_virtual(
    dataset: Dataset, field: type[Field], seed: int | None
) -> tuple[TrainingData, list[Int[np.ndarray, " v"]]]:
    """Returns data on the device, and the indices of the virtual links of every receiver. No virtual links exist without a
    seed, or if the field predicts paths."""
    data, count = training_data(dataset), len(dataset)
    virtual = virtual_links(dataset, seed) if seed is not None and knows_no_paths(dataset, field) else None
    if virtual is None:
        return data, [np.zeros(0, int)] * dataset.n_receivers
    numbers = [count + np.flatnonzero(virtual.receiver_index == receiver) for receiver in range(dataset.n_receivers)]
    return with_virtual(data, virtual, dataset.eight_bit(np.arange(count))), numbers


def with_virtual_drawn(
    drawn: Int[np.ndarray, " b"], virtual: Int[np.ndarray, " v"], share: float, rng: np.random.Generator
) -> Int[np.ndarray, " b"]:
    """Returns a batch of links of one receiver, with a share of them replaced by virtual links of that receiver (if any)."""
    count = round(share * len(drawn)) if len(virtual) else 0
    return np.concatenate([drawn[count:], rng.choice(virtual, count)]) if count else drawn


def kriging_weights(
    positions: Float[np.ndarray, "n 3"], place: Float[np.ndarray, "3"], length: float, nugget: float
) -> Float[np.ndarray, " n"]:
    """Returns the weights of ordinary kriging at a place, with the kernel exp(-distance / length); they sum to 1. Positions and
    `length` are in metres, `nugget` is relative to the kernel at distance 0."""
    kernel = np.exp(-np.linalg.norm(positions[:, None] - positions[None], axis=-1) / length) + nugget * np.eye(len(positions))
    right = np.column_stack([np.exp(-np.linalg.norm(positions - place, axis=-1) / length), np.ones(len(positions))])
    simple, ones = np.linalg.solve(kernel, right).T
    weights: np.ndarray = simple + (1 - simple.sum()) / ones.sum() * ones
    return weights


def with_virtual(data: TrainingData, virtual: VirtualLinks, observed: UInt8[np.ndarray, "n 90 360"]) -> TrainingData:
    """Returns training data with virtual links appended, each with its own transmitter. The only observation of a virtual link
    is its spectrum.

    Args:
        data: training data.
        virtual: virtual links.
        observed: observed spectra of the links of `data`, multiplied by 255.
    """
    count = len(virtual.frequency_hz)
    more = Links(
        Transmitter(jnp.asarray(virtual.tx_position, jnp.float32)),
        jnp.asarray(virtual.frequency_hz, jnp.float32),
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
