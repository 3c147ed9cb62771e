"""The dataset, the common form of all data for training, evaluation and experiments: links, observations, receivers, surfaces,
split.

A run stores a checksum of its dataset, so that it cannot be continued with other data of the same name.
"""

import dataclasses
import hashlib
from dataclasses import dataclass, field
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, UInt8

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.conventions import ConventionName
from wbgs_jax.radio.array import PAS_SHAPE, snapshot_to_pas
from wbgs_jax.radio.channel import received_power_db
from wbgs_jax.types import Links, Query, Receiver

Kind = Literal["snapshot", "pas", "power"]
"""Kind of the observations of a data set."""
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
class Dataset:
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
    snapshots: Complex[np.ndarray, "n elements"] | None = None
    """Complex array snapshots, or ..."""
    images: UInt8[np.ndarray, "n 90 360"] | None = None
    """... 8-bit images of the power angular spectrum, or ..."""
    power_db: Float[np.ndarray, " n"] | None = None
    """... received power relative to the transmitted power, dB. Exactly one of the three is not None."""
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
        observed = [values for values in (self.snapshots, self.images, self.power_db) if values is not None]
        if len(observed) != 1:
            raise ValueError(
                f"{self.name} has {len(observed)} kinds of observations; pass exactly one of snapshots, images, power_db"
            )
        columns = (self.tx_positions, self.receiver_index, self.tx_index, *observed)
        if any(len(column) != len(self) for column in columns):
            raise ValueError(f"{self.name}: arrays of links have lengths {[*map(len, columns)]}; all must be {len(self)}")
        if len(self) and not 0 <= self.receiver_index.min() <= self.receiver_index.max() < self.n_receivers:
            raise ValueError(f"{self.name}: receiver_index must lie between 0 and {self.n_receivers - 1}")

    def __len__(self) -> int:
        return len(self.frequencies_hz)

    @property
    def kind(self) -> Kind:
        """Kind of the observations."""
        if self.snapshots is not None:
            return "snapshot"
        return "pas" if self.images is not None else "power"

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
        return Query(jnp.asarray(self.tx_positions[index], jnp.float32), jnp.asarray(self.frequencies_hz[index], jnp.float32))

    def links(self, index: Int[np.ndarray, " b"]) -> Links:
        """Returns links as float32 and int32 arrays on the device."""
        receiver, tx = (jnp.asarray(which[index], jnp.int32) for which in (self.receiver_index, self.tx_index))
        return Links(self.query(index), receiver, tx)

    def pas(self, index: Int[np.ndarray, " b"]) -> Float[Array, "b 90 360"]:
        """Returns the observed power angular spectra (float32, maximum 1) of links.

        Raises:
            UserError: only received powers are available.
        """
        if self.images is not None:
            return jnp.asarray(self.images[index], jnp.float32) / 255
        if self.snapshots is None:
            raise UserError(f"{self.name} contains received powers, which have no angular spectrum; give a scene that has one")
        snapshots = self.snapshots[index]
        arrays, which = self._arrays(index)
        if len(arrays) == 1:
            return snapshot_to_pas(jnp.asarray(snapshots), arrays[0])
        spectra = np.zeros((len(snapshots), *PAS_SHAPE), np.float32)
        for number, element_positions in enumerate(arrays):
            chosen = which == number
            spectra[chosen] = snapshot_to_pas(jnp.asarray(snapshots[chosen]), element_positions)
        return jnp.asarray(spectra)

    def eight_bit(self, index: Int[np.ndarray, " b"]) -> UInt8[np.ndarray, "b 90 360"]:
        """Returns the observed spectra of links as 8-bit values, as in published data; raises the same errors as `pas`."""
        if self.images is not None:
            return self.images[index]
        blocks = [index[start : start + AT_ONCE] for start in range(0, len(index), AT_ONCE)]
        made = [np.asarray(255 * self.pas(block)).round().astype(np.uint8) for block in blocks]
        return np.concatenate(made) if made else np.zeros((0, *PAS_SHAPE), np.uint8)

    def rx_positions(self, index: Int[np.ndarray, " b"]) -> Float[np.ndarray, "b 3"]:
        """Returns the positions of the receivers of links (float64, world frame, metres)."""
        return np.asarray(self.receivers.position, np.float64)[self.receiver_index[index]]

    def received_db(self, index: Int[np.ndarray, " b"]) -> Float[np.ndarray, " b"] | None:
        """Returns the received power of links (dB, relative to the transmitted power), observed or computed from snapshots;
        None if there are only spectra, which have no absolute scale."""
        if self.power_db is not None:
            return self.power_db[index]
        return None if self.snapshots is None else np.asarray(received_power_db(jnp.asarray(self.snapshots[index])))

    def _arrays(self, index: Int[np.ndarray, " b"]) -> tuple[Float[Array, "arrays elements 3"], Int[np.ndarray, " b"]]:
        """Returns the distinct arrays of links (element positions in wavelengths) and the index of each link's array."""
        own = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[self.receiver_index[index]]), self.receivers)
        positions = own.element_wavelengths(jnp.asarray(self.frequencies_hz[index], jnp.float32))
        _, first, which = np.unique(np.asarray(positions), axis=0, return_index=True, return_inverse=True)
        return positions[first], which.reshape(-1)


NAMES = ("name", "convention")


def checksum(dataset: Dataset) -> str:
    """Returns a checksum (SHA-256) of all numbers of a dataset, including its split but not names."""
    found = hashlib.sha256()
    parts = {field.name: getattr(dataset, field.name) for field in dataclasses.fields(dataset) if field.name not in NAMES}
    parts["materials"] = None if dataset.materials is None else dataclasses.asdict(dataset.materials) | {"names": ()}
    for path, leaf in jax.tree_util.tree_leaves_with_path(parts):
        array = np.ascontiguousarray(leaf)
        found.update(f"{jax.tree_util.keystr(path)} {array.dtype.str} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def check_data(dataset: Dataset, expected: str, where: str) -> Dataset:
    """Returns the dataset if its checksum is the expected one (or if that is empty).

    Raises:
        UserError: the checksum differs.
    """
    if expected and checksum(dataset) != expected:
        raise UserError(f"the data of {where} are not those that it was trained on; restore them, or train again")
    return dataset
