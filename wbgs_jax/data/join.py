"""Several data sets of one scene, each seen from receivers of its own, as one."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.splits import group_transmitters

SURFACES = ("vertices", "faces", "face_part")
OBSERVED = ("snapshots", "images", "power_db")


def join(datasets: Sequence[Dataset]) -> Dataset:
    """Returns the links of all data sets in their order.

    Receivers are numbered on, and a place where several data sets have a transmitter is one transmitter. It is of the test if
    one of them tests it, and else of the validation if one of them validates it: its other receivers would give it away. Links
    that are in no part of their data set are in none here.

    Raises:
        UserError: they are not of one scene, or of different kinds or arrays.
    """
    first, *others = datasets
    for other in others:
        _check_alike(first, other)
    tx_positions = np.concatenate([one.tx_positions for one in datasets])
    tx_index = group_transmitters(tx_positions)
    before = np.cumsum([0, *(len(one) for one in datasets)])
    receivers = np.cumsum([0, *(one.n_receivers for one in datasets)])
    named = {
        part: np.concatenate([getattr(one, part) + start for one, start in zip(datasets, before, strict=False)])
        for part in ("train", "validation", "test")
    }
    listed = np.isin(np.arange(len(tx_index)), np.concatenate(list(named.values())))
    tested, validated = (np.isin(tx_index, np.unique(tx_index[index])) for index in (named["test"], named["validation"]))
    arrays: dict[str, Any] = {name: _together(datasets, name) for name in OBSERVED}
    arrays |= {name: getattr(first, name) for name in SURFACES}
    return Dataset(
        name="+".join(one.name for one in datasets),
        receivers=jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *(one.receivers for one in datasets)),
        tx_positions=tx_positions,
        frequencies_hz=np.concatenate([one.frequencies_hz for one in datasets]),
        receiver_index=_numbered_on(datasets, receivers),
        tx_index=tx_index,
        train=np.flatnonzero(listed & ~tested & ~validated),
        validation=np.flatnonzero(listed & validated & ~tested),
        test=np.flatnonzero(listed & tested),
        **arrays,
        materials=first.materials,
    )


def _check_alike(first: Dataset, other: Dataset) -> None:
    where = f"{first.name} and {other.name} cannot be joined"
    if first.kind != other.kind:
        raise UserError(f"{where}: one holds {first.kind} and the other {other.kind} observations")
    arrays = [(one.receivers.unit, one.receivers.element_positions.shape[1:]) for one in (first, other)]
    if arrays[0] != arrays[1]:
        raise UserError(f"{where}: their arrays differ in the number or the unit of their elements")
    if not all(np.array_equal(getattr(first, name), getattr(other, name)) for name in SURFACES):
        raise UserError(f"{where}: their surfaces differ; give data sets of one scene")


def _numbered_on(datasets: Sequence[Dataset], receivers: Int[np.ndarray, " sets"]) -> Int[np.ndarray, " n"]:
    return np.concatenate([one.receiver_index + start for one, start in zip(datasets, receivers, strict=False)])


def _together(datasets: Sequence[Dataset], name: str) -> np.ndarray | None:
    values = [getattr(one, name) for one in datasets]
    return None if values[0] is None else np.concatenate(values)
