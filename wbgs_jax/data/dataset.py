"""What a trainer, an evaluation or an experiment sees of any data: queries, observations, receiver, surface, split."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, UInt8

from wbgs_jax.array import snapshot_to_pas
from wbgs_jax.types import Query, Receiver


@dataclass(frozen=True)
class Materials:
    """Which triangles share a material. Not its electrical properties: those are for a field to find out."""

    cluster: Int[np.ndarray, "faces"]
    """int32: the material of every triangle."""
    names: tuple[str, ...]
    """A label of every material."""
    thickness: Float[np.ndarray, "materials"]
    """Metres; 0 where it is not known."""


@dataclass(frozen=True)
class Dataset:
    """Spectra of one scene with a fixed receiver; spectrum i was observed for query i."""

    name: str
    receiver: Receiver
    tx_positions: Float[np.ndarray, "n 3"]
    """World frame, metres, float64."""
    frequencies_hz: Float[np.ndarray, "n"]
    tx_index: Int[np.ndarray, "n"]
    """Which transmitter (0, 1, ...): spectra of one TX position share it; splits never cut through it."""
    train: Int[np.ndarray, "n_train"]
    """Indices of the training spectra."""
    test: Int[np.ndarray, "n_test"]
    snapshots: Complex[np.ndarray, "n elements"] | None
    """Complex array snapshots where they are known (scene files) ..."""
    images: UInt8[np.ndarray, "n 90 360"] | None
    """... else 8-bit images of the published layout. Exactly one of the two is not None."""
    vertices: Float[np.ndarray, "vertices 3"]
    """The scene's surface in the world frame, metres, float32; empty where no mesh is known."""
    faces: Int[np.ndarray, "faces 3"]
    """int32 triangles; empty where only points are known."""
    materials: Materials | None = None
    """What the triangles are made of, as far as it is known."""
    element_pattern: str = ""
    """Of the receiver's elements, such as "tr38901" or "iso"; empty where it is not known."""

    def __len__(self) -> int:
        return len(self.frequencies_hz)

    def query(self, index: Int[np.ndarray, "b"]) -> Query:
        """The float32 queries of some spectra."""
        return Query(jnp.asarray(self.tx_positions[index], jnp.float32), jnp.asarray(self.frequencies_hz[index], jnp.float32))

    def pas(self, index: Int[np.ndarray, "b"]) -> Float[Array, "b 90 360"]:
        """The observed power angular spectra (float32, maximum 1) of some spectra."""
        if self.images is not None:
            return jnp.asarray(self.images[index], jnp.float32) / 255
        assert self.snapshots is not None
        return snapshot_to_pas(jnp.asarray(self.snapshots[index]), self.receiver.element_positions)
