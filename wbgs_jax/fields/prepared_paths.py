"""The paths of many links, found on the host before a training: whoever trains materials asks for them again and again."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wbgs_jax._util.pytree import pytree, same
from wbgs_jax.fields.wave_channel import WavePlan
from wbgs_jax.propagation.image_method import Search, Surfaces
from wbgs_jax.propagation.paths import Paths, TracedPaths, trace_paths
from wbgs_jax.radio.array import Beams
from wbgs_jax.types import Links

TRACED_AT_ONCE = 16
"""Transmitters."""


@pytree
class PreparedPaths:
    """The paths of some pairs of a receiver and a transmitter."""

    surfaces: Surfaces
    """That they meet, of all receivers alike."""
    beams: Beams | None
    """Of the receivers' array; None where they differ from frequency to frequency or from receiver to receiver."""
    paths: TracedPaths
    """Leading axis: pairs, ascending by receiver, then by transmitter."""
    receiver_index: Int[Array, " pairs"]
    tx_index: Int[Array, " pairs"]

    def place(self, links: Links) -> Int[Array, "*b"]:
        """Returns which of the pairs links belong to."""
        numbers = jnp.max(self.tx_index) + 1
        pairs, asked = (one.receiver_index * numbers + one.tx_index for one in (self, links))
        return jnp.searchsorted(pairs, asked)

    def only(self, links: Links) -> "PreparedPaths":
        """Returns the pairs of links, one for each, so that what is done with them does not depend on how many others there
        are."""
        place = jnp.sort(self.place(links))
        paths, receiver_index, tx_index = jax.tree.map(
            lambda leaf: leaf[place], (self.paths, self.receiver_index, self.tx_index)
        )
        return dataclasses.replace(self, paths=paths, receiver_index=receiver_index, tx_index=tx_index)

    def of(self, links: Links) -> TracedPaths:
        """Returns the paths of links, with their axes."""
        place = self.place(links)
        paths: TracedPaths = jax.tree.map(lambda leaf: leaf[place], self.paths)
        return paths


def prepare_paths(links: Links, plan_of: Callable[[int], WavePlan]) -> PreparedPaths:
    """Returns the paths of all receivers and transmitters of some links (host).

    Args:
        links: any number of them, of any receivers.
        plan_of: plans a receiver by its number.
    """
    numbers = np.stack([np.asarray(links.receiver_index), np.asarray(links.tx_index)], -1)
    pairs, first = np.unique(numbers, axis=0, return_index=True)
    positions, found, beams = np.asarray(links.query.tx_position)[first], [], []
    for receiver in np.unique(pairs[:, 0]):
        plan = plan_of(int(receiver))  # one at a time: mirror images of many receivers are many
        found.append(_traced_in_blocks(plan, positions[pairs[:, 0] == receiver]))
        beams.append(plan.beams)
    paths = TracedPaths(_stacked([one.specular for one in found]), _stacked([one.diffracted for one in found]))
    surfaces = Surfaces(plan.surfaces.facets, plan.surfaces.edges)
    return PreparedPaths(surfaces, _shared(beams), paths, *jnp.asarray(pairs.T, jnp.int32))


@jax.jit
def trace(plan: WavePlan, tx_position: Float[Array, "b 3"]) -> TracedPaths:
    """Returns the paths of B transmitters; independent of frequency and materials."""
    config, search = plan.config, plan.surfaces
    if not isinstance(search, Search):
        raise TypeError("a plan that was made with prepared paths traces no others; plan without `cache`")
    sizes = config.specular_tried, config.specular_kept, config.diffracted_tried, config.diffracted_kept
    return jax.lax.map(lambda tx: trace_paths(search, tx, *sizes), tx_position)


def _traced_in_blocks(plan: WavePlan, positions: Float[np.ndarray, "n 3"]) -> Any:
    n, parts = len(positions), []
    size = min(n, TRACED_AT_ONCE)
    for start in range(0, n, size):
        index = np.minimum(np.arange(start, start + size), n - 1)  # blocks of one shape: one compilation
        parts.append(jax.tree.map(np.asarray, trace(plan, jnp.asarray(positions[index]))))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:n], *parts)


def _stacked(some: list[Paths]) -> Paths:
    """Returns paths one after the other, all with as much room as those that have most: receivers have different numbers."""
    room = max(paths.alive.shape[1] for paths in some)

    def filled(leaf: np.ndarray, mode: Any) -> np.ndarray:
        return np.pad(leaf, [(0, 0), (0, room - leaf.shape[1])] + [(0, 0)] * (leaf.ndim - 2), mode)

    together: Paths = jax.tree.map(
        lambda *leaves: jnp.asarray(np.concatenate([filled(leaf, "edge") for leaf in leaves])), *some
    )
    alive = np.concatenate([filled(np.asarray(paths.alive), "constant") for paths in some])
    return dataclasses.replace(together, alive=jnp.asarray(alive))


def _shared(beams: list[Beams | None]) -> Beams | None:
    """Returns the beams of all receivers, if they are the same."""
    first, *others = beams
    return first if all(same(first, other) for other in others) else None
