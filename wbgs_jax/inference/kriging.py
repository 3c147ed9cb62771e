"""What known spectra nearby say about a spectrum, beside the field: simple kriging over the transmitter's position.

    k_j = exp(-|x - x_j| / L) over the nearest known transmitters at the same frequency,   a = (K + noise)^-1 k
    residuals:  f(x) + w a . (y - f)
    spectra:    f(x) + w a . (y - f(x))

The first adds what the field left unexplained at its neighbours; the second moves towards their spectra themselves, which helps
where the field has learned them by heart and their residuals are zero. Which, how far (L) and how much (w) is found on the
validation part (training/fit_kriging.py), nothing at all included. Only the nearest are asked: the others are behind them, and
a data set may hold thousands.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from wbgs_jax._util.arrays import read_tree, write_tree
from wbgs_jax._util.pytree import pytree
from wbgs_jax.inference.mixture import NEAREST, SAME_FREQUENCY, Mixture, answer, solve
from wbgs_jax.radio.array import EXACT
from wbgs_jax.types import Query, Receiver

SAME_PLACE_M = 1e-3
"""Distance of two receivers that are the same."""
NOISE = 1e-2
"""Variance of what is no function of the position, beside 1."""
FILE = "neighbours.npz"


@pytree
class Neighbours:
    """M known spectra of one receiver, ready to be asked."""

    rx_position: Float[Array, "3"]
    tx_position: Float[Array, "m 3"]
    """Metres, world frame."""
    frequency_hz: Float[Array, " m"]
    images: Num[Array, "m 90 360"]
    """y - f in half precision, or 255 y in bytes."""
    scale: Float[Array, ""]
    """What the images are multiplied by."""
    weight: Float[Array, ""]
    """w."""
    own: Float[Array, ""]
    """Whether the field's own spectrum gives way: 1 for spectra, 0 for residuals."""
    length: Float[Array, ""]
    """L in metres."""


Beside = Neighbours | Mixture | None
"""Known spectra beside a field: those of many data correct it, those of few share its answers."""


def without_asked(neighbours: Beside, query: Query) -> Beside:
    """Returns neighbours that do not know the spectra that are asked for (host); None where nothing is left."""
    if neighbours is None:
        return None
    known = nearness(neighbours.tx_position, neighbours.frequency_hz, query.tx_position, query.frequency_hz, SAME_PLACE_M)
    kept = np.flatnonzero(np.asarray(known).max(1, initial=0) < np.exp(-1))
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
    distance = jnp.sqrt(jnp.sum(offset**2, -1) + 1e-12)  # differentiable at a neighbour itself
    same = jnp.abs(jnp.log(frequency_hz[:, None] / known_frequency[None])) < SAME_FREQUENCY
    return jnp.where(same, jnp.exp(-distance / length), 0)


def correct(neighbours: Beside, pas: Float[Array, "b 90 360"], query: Query) -> Float[Array, "b 90 360"]:
    """Returns a field's spectra with what known ones add to them; at frequencies or places far from all of them they stay."""
    if neighbours is None:
        return pas
    if isinstance(neighbours, Mixture):
        return answer(neighbours, pas, query)
    asked = query.tx_position, query.frequency_hz, pas
    return jax.lax.map(lambda one: _corrected(neighbours, *one), asked)


def _corrected(
    neighbours: Neighbours, position: Float[Array, "3"], frequency_hz: Float[Array, ""], own: Float[Array, "90 360"]
) -> Float[Array, "90 360"]:
    known, length = (neighbours.tx_position, neighbours.frequency_hz), neighbours.length
    near = nearness(position[None], frequency_hz[None], *known, length)[0]
    k, index = jax.lax.top_k(near, min(NEAREST, len(near)))
    places = known[0][index], known[1][index]
    kernel = nearness(*places, *places, length) + NOISE * jnp.eye(len(k), dtype=k.dtype)
    shares = neighbours.weight * solve(kernel, k)
    said = jnp.tensordot(shares, neighbours.scale * neighbours.images[index].astype(own.dtype), 1, precision=EXACT)
    corrected = own + said - neighbours.own * jnp.sum(shares) * own
    return jnp.where(k[0] > 0, jnp.clip(corrected, 0, 1), own)


def for_receiver(learned: Any, receiver: Receiver) -> Any:
    """Returns what was learned of a receiver (`Neighbours`, `Confidence`), of several as of this one alone; None if it is none
    of them (host)."""
    if learned is None:
        return None
    distance = np.linalg.norm(np.asarray(receiver.position) - np.atleast_2d(learned.rx_position), axis=-1)
    near = int(distance.argmin())
    if distance[near] >= SAME_PLACE_M:
        return None
    return learned if learned.rx_position.ndim == 1 else dataclasses.replace(learned, rx_position=learned.rx_position[near])


def write_neighbours(folder: Path, neighbours: Beside) -> None:
    """Leaves them in a run folder, or nothing."""
    write_tree(folder / FILE, neighbours)


def read_neighbours(folder: Path) -> Beside:
    """Returns those of a run folder; None if it has none. A damaged file is a `UserError`."""
    classes: tuple[type[Mixture | Neighbours], ...] = (Mixture, Neighbours)
    return read_tree(folder / FILE, classes, "ask the field alone")
