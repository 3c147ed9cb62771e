"""Residual kriging: correction of predicted spectra by measured ones, with simple kriging over the transmitter's position.

    k_j = exp(-|x - x_j| / L) over the nearest measured transmitters at the same frequency,   a = (K + noise)^-1 k
    residuals:  f(x) + w a . (y - f)
    spectra:    f(x) + w a . (y - f(x))

The first form interpolates the residuals of the field; the second interpolates the measured spectra themselves, which helps
if the field is overfitted to them, so that their residuals are zero. The form, the correlation length L and the weight w are
selected on the validation part (training/fit_kriging.py), where no correction at all is one of the options. Only the nearest
measurements are used: they screen the others, and a dataset may have thousands.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from wbgs_jax._util.arrays import read_tree, write_tree
from wbgs_jax._util.pytree import pytree
from wbgs_jax.inference.mixture import NEAREST, SAME_FREQUENCY, Mixture, answer, solve
from wbgs_jax.radio.array import EXACT
from wbgs_jax.types import Query, Receiver

SAME_PLACE_M = 1e-3
"""Distance below which two receivers count as the same, metres."""
NOISE = 1e-2
"""Variance of the part that is not a function of the position, relative to a variance of 1 of the other part."""
FILE = "neighbours.npz"


@pytree
class Neighbours:
    """Residual kriging with M measured spectra of one receiver."""

    rx_position: Float[Array, "3"]
    tx_position: Float[Array, "m 3"]
    """Metres, world frame."""
    frequency_hz: Float[Array, " m"]
    images: Num[Array, "m 90 360"]
    """y - f in half precision, or 255 y as bytes."""
    scale: Float[Array, ""]
    """Factor of the images."""
    weight: Float[Array, ""]
    """Weight w."""
    own: Float[Array, ""]
    """Form of the correction: 1 for spectra, 0 for residuals."""
    length: Float[Array, ""]
    """Correlation length L, metres."""


Beside = Neighbours | Mixture | None
"""Use of measured spectra together with a field: kriging with many measurements, a mixture with few; None: not used."""


def without_asked(neighbours: Beside, query: Query) -> Beside:
    """Returns the measurements without those of the queried links (host); None if none remain."""
    if neighbours is None:
        return None
    near = nearness(neighbours.tx_position, neighbours.frequency_hz, query.tx_position, query.frequency_hz, SAME_PLACE_M)
    return some_of(neighbours, np.flatnonzero(np.asarray(near).max(1, initial=0) < np.exp(-1)))


def some_of(neighbours: Neighbours | Mixture, kept: Int[np.ndarray, " k"]) -> Beside:
    """Returns some of the measurements, given by their indices (host); None if none remain."""
    if not len(kept):
        return None
    taken = {name: getattr(neighbours, name)[kept] for name in ("tx_position", "frequency_hz", "images")}
    if isinstance(neighbours, Mixture):
        taken["mean"] = jnp.asarray(np.asarray(taken["images"]).mean(0) / 255, jnp.float32)
    return dataclasses.replace(neighbours, **taken)


def nearness(
    tx_position: Float[Array, "b 3"],
    frequency_hz: Float[Array, " b"],
    known_position: Float[Array, "m 3"],
    known_frequency: Float[Array, " m"],
    length: Any,
) -> Float[Array, "b m"]:
    """Returns the kernel: exp(-distance / length) at equal frequencies, else 0."""
    offset = tx_position[:, None] - known_position[None]
    distance = jnp.sqrt(jnp.sum(offset**2, -1) + 1e-12)  # differentiable at a measured position
    same = jnp.abs(jnp.log(frequency_hz[:, None] / known_frequency[None])) < SAME_FREQUENCY
    return jnp.where(same, jnp.exp(-distance / length), 0)


def correct(neighbours: Beside, pas: Float[Array, "b 90 360"], query: Query) -> Float[Array, "b 90 360"]:
    """Returns corrected spectra of a field; far from all measurements in position or frequency, they remain unchanged."""
    if neighbours is None:
        return pas
    if isinstance(neighbours, Mixture):
        return answer(neighbours, pas, query)
    queried = query.tx_position, query.frequency_hz, pas
    return jax.lax.map(lambda one: _corrected(neighbours, *one), queried)


def _corrected(
    neighbours: Neighbours, position: Float[Array, "3"], frequency_hz: Float[Array, ""], own: Float[Array, "90 360"]
) -> Float[Array, "90 360"]:
    known, length = (neighbours.tx_position, neighbours.frequency_hz), neighbours.length
    near = nearness(position[None], frequency_hz[None], *known, length)[0]
    k, index = jax.lax.top_k(near, min(NEAREST, len(near)))
    places = known[0][index], known[1][index]
    kernel = nearness(*places, *places, length) + NOISE * jnp.eye(len(k), dtype=k.dtype)
    shares = neighbours.weight * solve(kernel, k)
    interpolated = jnp.tensordot(shares, neighbours.scale * neighbours.images[index].astype(own.dtype), 1, precision=EXACT)
    corrected = own + interpolated - neighbours.own * jnp.sum(shares) * own
    return jnp.where(k[0] > 0, jnp.clip(corrected, 0, 1), own)


def for_receiver(learned: Any, receiver: Receiver) -> Any:
    """Returns what was learned (`Neighbours`, `Mixture`, `Confidence`) restricted to one receiver; None if it was learned
    for other receivers (host)."""
    if learned is None:
        return None
    distance = np.linalg.norm(np.asarray(receiver.position) - np.atleast_2d(learned.rx_position), axis=-1)
    near = int(distance.argmin())
    if distance[near] >= SAME_PLACE_M:
        return None
    return learned if learned.rx_position.ndim == 1 else dataclasses.replace(learned, rx_position=learned.rx_position[near])


def write_neighbours(folder: Path, neighbours: Beside) -> None:
    """Writes the measurements to a run folder; None writes no file."""
    write_tree(folder / FILE, neighbours)


def read_neighbours(folder: Path) -> Beside:
    """Returns the measurements of a run folder; None if it has none. A damaged file is a `UserError`."""
    classes: tuple[type[Mixture | Neighbours], ...] = (Mixture, Neighbours)
    return read_tree(folder / FILE, classes, "use the field alone")
