"""The dataset, the common form of all data for training, evaluation and experiments: links, observations, receivers, surfaces,
split.

A run stores a checksum of its dataset, so that it cannot be continued with other data of the same name.
"""

import dataclasses
import hashlib
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.conventions import ConventionName
from wbgs_jax.observation_kinds import KINDS, HostObservations, Kind, Observed, only_kind
from wbgs_jax.radio.array import PAS_SHAPE
from wbgs_jax.types import Links, Query, Receiver, make_query

AT_ONCE = 1024
"""Number of spectra computed from snapshots at a time."""


@dataclass(frozen=True)
class Materials:
    """Assignment of triangles to materials. Their electrical properties are not included: a field has to learn them."""

    material: Int[np.ndarray, " faces"]
    """int32: index of the material of every triangle."""
    names: tuple[str, ...]
    """Label of every material."""
    thickness: Float[np.ndarray, " materials"]
    """Metres; 0 if unknown."""


@dataclass(frozen=True)
class Dataset(Observed):
    """Observations of the links of one scene: observation i belongs to link (transmitter position, receiver, frequency) i."""

    name: str
    receivers: Receiver
    """All receivers: every array has a leading axis R."""
    tx_positions: Float[np.ndarray, "n 3"]
    """World frame, metres, float64."""
    frequencies_hz: Float[np.ndarray, " n"]
    receiver_index: Int[np.ndarray, " n"]
    """Index of the receiver."""
    tx_index: Int[np.ndarray, " n"]
    """Index of the transmitter, shared by links with the same TX position; 0, 1, ... without gaps. Splits never divide these
    links."""
    train: Int[np.ndarray, " n_train"]
    """Indices of the training links."""
    validation: Int[np.ndarray, " n_validation"]
    """Indices of the links used to choose between settings; may be empty."""
    test: Int[np.ndarray, " n_test"]
    observations: HostObservations
    """Observations of exactly one kind, such as `{"snapshots": ...}`, `{"pas": ...}` or `{"power_db": ...}`."""
    vertices: Float[np.ndarray, "vertices 3"] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    """The scene's surfaces in the world frame, metres, float32; empty without a mesh."""
    faces: Int[np.ndarray, "faces 3"] = field(default_factory=lambda: np.zeros((0, 3), np.int32))
    """int32 triangles; empty if only points are available."""
    face_part: Int[np.ndarray, " faces"] | None = None
    """int32: the part (scene object) of every triangle; None if unknown."""
    materials: Materials | None = None
    """Materials of the triangles; None if unknown. Parts of one material share it."""
    convention: ConventionName | None = None
    """Convention by which the images of a folder were read; None for scene files, which have only one."""

    def __post_init__(self) -> None:
        only_kind(self.observations, self.name)
        if unknown := self.observations.keys() - KINDS.keys():
            raise ValueError(f"{self.name}: unknown kind of observation {min(unknown)!r}; register it in observation_kinds")
        columns = (self.tx_positions, self.receiver_index, self.tx_index, *self.observations.values())
        if any(len(column) != len(self) for column in columns):
            raise ValueError(f"{self.name}: arrays of links have lengths {[*map(len, columns)]}; all must be {len(self)}")
        if len(self) and not 0 <= self.receiver_index.min() <= self.receiver_index.max() < self.n_receivers:
            raise ValueError(f"{self.name}: receiver_index must lie between 0 and {self.n_receivers - 1}")

    def __len__(self) -> int:
        return len(self.frequencies_hz)

    @property
    def observed(self) -> Kind:
        """Kind of the observations."""
        return only_kind(self.observations, self.name)

    @property
    def n_receivers(self) -> int:
        """Number of receivers."""
        return len(self.receivers.position)

    def receiver(self, i: int = 0) -> Receiver:
        """Returns one of the receivers, without the leading axis.

        Raises:
            UserError: there is no such receiver.
        """
        if not 0 <= i < self.n_receivers:
            raise UserError(f"{self.name} has no receiver {i}; choose 0 to {self.n_receivers - 1}")
        return jax.tree.map(lambda leaf: leaf[i], self.receivers)

    def query(self, index: Int[np.ndarray, " b"]) -> Query:
        """Returns the float32 queries of links."""
        return make_query(self.tx_positions[index], self.frequencies_hz[index])

    def links(self, index: Int[np.ndarray, " b"]) -> Links:
        """Returns links as float32 and int32 arrays on the device."""
        receiver, tx = (jnp.asarray(which[index], jnp.int32) for which in (self.receiver_index, self.tx_index))
        return self.query(index).with_indices(receiver, tx)

    def pas(self, index: Int[np.ndarray, " b"]) -> Float[Array, "b 90 360"]:
        """Returns the observed power angular spectra (float32, maximum 1) of links.

        Raises:
            UserError: the observations have no spectrum, such as received powers.
        """
        kind = self.observed
        if kind.to_spectra is None:
            raise UserError(
                f"{self.name} contains {kind.words}, which have no angular spectrum; give a scene with spectra or snapshots"
            )
        values = self.observations[kind.name][index]
        if not kind.needs_array:
            return kind.to_spectra(values, None, None)
        arrays, which = self._arrays(index)
        if len(arrays) == 1:
            return kind.to_spectra(values, arrays[0], None)
        spectra = np.zeros((len(values), *PAS_SHAPE), np.float32)
        for number, element_positions in enumerate(arrays):
            chosen = which == number
            spectra[chosen] = kind.to_spectra(values[chosen], element_positions, None)
        return jnp.asarray(spectra)

    def eight_bit(self, index: Int[np.ndarray, " b"]) -> UInt8[np.ndarray, "b 90 360"]:
        """Returns the observed spectra of links as bytes, as in published data; raises the same errors as `pas`."""
        if self.has("pas"):
            return self.observations["pas"][index]
        blocks = [index[start : start + AT_ONCE] for start in range(0, len(index), AT_ONCE)]
        made = [np.asarray(255 * self.pas(block)).round().astype(np.uint8) for block in blocks]
        return np.concatenate(made) if made else np.zeros((0, *PAS_SHAPE), np.uint8)

    def rx_positions(self, index: Int[np.ndarray, " b"]) -> Float[np.ndarray, "b 3"]:
        """Returns the positions of the receivers of links (float64, world frame, metres)."""
        return np.asarray(self.receivers.position, np.float64)[self.receiver_index[index]]

    def received_db(self, index: Int[np.ndarray, " b"]) -> Float[np.ndarray, " b"] | None:
        """Returns the received power of links (dB, relative to the transmitted power), observed or computed from snapshots;
        None for spectra, which have no scale."""
        kind = self.observed
        return None if kind.to_power is None else np.asarray(kind.to_power(self.observations[kind.name][index]))

    def _arrays(self, index: Int[np.ndarray, " b"]) -> tuple[Float[Array, "arrays elements 3"], Int[np.ndarray, " b"]]:
        """Returns the distinct arrays of links (element positions in wavelengths) and the index of each link's array."""
        own = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[self.receiver_index[index]]), self.receivers)
        positions = own.element_wavelengths(jnp.asarray(self.frequencies_hz[index], jnp.float32))
        _, first, which = np.unique(np.asarray(positions), axis=0, return_index=True, return_inverse=True)
        return positions[first], which.reshape(-1)


def checksum(dataset: Dataset) -> str:
    """Returns a checksum (SHA-256) of all numbers of a dataset, including its split but not names."""
    found = hashlib.sha256()
    numbers = (field.name for field in dataclasses.fields(dataset) if field.name not in ("name", "convention"))
    parts = {name: getattr(dataset, name) for name in numbers}
    # Kinds of observation with another name in checksums, so that those of old run folders remain valid.
    renamed = {"pas": "images"}
    parts |= {renamed.get(name, name): values for name, values in parts.pop("observations").items()}
    parts["materials"] = None if dataset.materials is None else dataclasses.asdict(dataset.materials) | {"names": ()}
    for path, leaf in jax.tree_util.tree_leaves_with_path(parts):
        array = np.ascontiguousarray(leaf)
        found.update(f"{jax.tree_util.keystr(path)} {array.dtype.str} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def check_checksum(actual: str, expected: str, where: str) -> None:
    """Checks that the data of a run are those it was trained on.

    Raises:
        UserError: the checksums differ.
    """
    if actual != expected:
        raise UserError(f"the data of {where} have changed since it was trained; restore them, or train again")


def check_data(dataset: Dataset, expected: str, where: str) -> Dataset:
    """Returns the dataset, its checksum compared with the expected one (unless that is empty).

    Raises:
        UserError: the checksum differs.
    """
    if expected:
        check_checksum(checksum(dataset), expected, where)
    return dataset
