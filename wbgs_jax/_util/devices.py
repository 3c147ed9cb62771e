"""Several devices that share a batch: every one has all parameters and data, and works on its own part of the links.

The parts are made by `shard_map` in a jitted program, over the one axis (`AXIS`) of a mesh: left to itself, XLA divides the
splatting renderer as well, but exchanges something between the devices for every tile (docs/scaling.md). With one device there
is no mesh, and every function here returns what it was given.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Num

from wbgs_jax._util.errors import UserError

AXIS = "links"
"""Of the mesh: the links of a batch, or the queries of a map, are divided along it."""
EVERYWHERE, DIVIDED = PartitionSpec(), PartitionSpec(AXIS)


class Devices:
    """Some devices, and what is on all of them. `mesh` is None for a single one."""

    def __init__(self, mesh: Mesh | None = None):
        self.mesh = mesh
        self._kept: tuple[Any, Any] = (), ()

    @property
    def count(self) -> int:
        """How many there are, those of other processes included."""
        return 1 if self.mesh is None else self.mesh.size

    def replicated(self, tree: Any) -> Any:
        """Returns a tree of arrays with a copy on every device; every process gives the same one."""
        if self.mesh is None:
            return tree
        everywhere, here = NamedSharding(self.mesh, EVERYWHERE), self.mesh.local_devices

        def copies(leaf: Any) -> Array:
            own = [jax.device_put(leaf, device) for device in here]
            return jax.make_array_from_single_device_arrays(np.shape(leaf), everywhere, own)

        return jax.tree.map(copies, tree)

    def kept(self, *trees: Any) -> Any:
        """Returns `replicated` trees; those of the call before, where they are the same objects."""
        if self.mesh is None:
            return trees
        before, placed = self._kept
        if len(before) != len(trees) or any(a is not b for a, b in zip(before, trees, strict=True)):
            placed = self.replicated(trees)
            self._kept = trees, placed
        return placed

    def own(self, tree: Any) -> Any:
        """Returns the copy of the first device of this process of a replicated tree, for work on the host."""
        return tree if self.mesh is None else jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)


def devices_for(batch: int, wanted: int = 0) -> tuple[Devices, str]:
    """Returns as many devices as can share a batch of links evenly, and one line where some stay idle, else an empty one.

    Args:
        batch: number of links.
        wanted: devices a process, at most; 0: all that it has.

    Raises:
        UserError: there are not so many devices, or the processes themselves cannot share the batch evenly.
    """
    processes, have = jax.process_count(), jax.local_device_count()
    if not 0 <= wanted <= have:
        raise UserError(f"--devices is {wanted}, and this process has {have}; give 1 to {have}, or 0 for all")
    if batch % processes:
        raise UserError(f"{processes} processes cannot share a batch of {batch} links evenly; set --optim.batch to a multiple")
    asked = wanted or have
    used = max(count for count in range(1, asked + 1) if batch // processes % count == 0)
    idle = f"a batch of {batch} links is shared by {used} of {asked} devices; with --optim.batch {batch // used * asked} by all"
    return Devices(_mesh(jax.devices(), used)), idle if used < asked else ""


def own_devices() -> Devices:
    """Returns all devices of this process, for work that no other process takes part in."""
    return Devices(_mesh(jax.local_devices(), jax.local_device_count()))


def _mesh(devices: list[Any], each: int) -> Mesh | None:
    """Returns a mesh of the first so many devices of every process; None of a single device."""
    owners = sorted({device.process_index for device in devices})
    chosen = [device for owner in owners for device in [d for d in devices if d.process_index == owner][:each]]
    return None if len(chosen) == 1 else Mesh(np.array(chosen), (AXIS,))


def averaged(function: Callable[..., Any], mesh: Mesh | None, divided: int) -> Callable[..., Any]:
    """Returns a function that every device evaluates on its part of the positional argument number `divided` (of its leading
    axis) and on the whole of all others. All devices get the same results: means of floats, maxima of integers and booleans."""
    if mesh is None:
        return function

    def mean(leaf: Array) -> Array:
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            return jax.lax.pmean(leaf, AXIS)
        return jax.lax.pmax(leaf.astype(jnp.int32), AXIS).astype(leaf.dtype)

    def together(*arguments: Any) -> Any:
        return jax.tree.map(mean, function(*arguments))

    return _shared_out(together, mesh, divided, EVERYWHERE)


def spread(function: Callable[..., Any], mesh: Mesh | None, divided: int) -> Callable[..., Any]:
    """Returns a function whose positional argument number `divided` and results have a common leading axis, which the devices
    divide; each has the whole of all other arguments."""
    return function if mesh is None else _shared_out(function, mesh, divided, DIVIDED)


def _shared_out(function: Callable[..., Any], mesh: Mesh, divided: int, out: PartitionSpec) -> Callable[..., Any]:
    def shared(*arguments: Any) -> Any:
        specs = tuple(DIVIDED if number == divided else EVERYWHERE for number in range(len(arguments)))
        # No check of what differs between devices: the loops of the renderers begin with zeros that are alike on all.
        return jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=out, check_vma=False)(*arguments)

    return shared


def over_all_links(total: Num[Array, "*n"]) -> Num[Array, "*n"]:
    """Returns a sum over the links of a device as that over the links of all: for losses that divide one sum by another. Where
    the links are not divided it is what it was."""
    divided = AXIS in jax.sharding.get_abstract_mesh().manual_axes
    return jax.lax.psum(total, AXIS) if divided else total
