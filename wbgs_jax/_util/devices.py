"""Several devices that share a batch: every one has all parameters and data, and works on its own part of the links.

The parts are made by `shard_map` in a jitted program, over the one axis (`AXIS`) of a mesh: left to itself, XLA divides the
splatting renderer as well, but exchanges something between the devices for every tile (docs/scaling.md). With one device there
is no mesh, and every function here returns what it was given.

Several processes that train one field, on one machine or on many: who writes, and how they stay together.

All of them do the same steps on the host and hold the same parameters; the first one alone writes files and prints. With one
process every function here costs nothing.
"""

import hashlib
import os
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


COORDINATOR, COUNT, NUMBER = "JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"
"""Environment variables that say host:port of the first process, how many there are, and which this one is."""


def connect() -> None:
    """Joins the other processes, before anything else is done with JAX. Slurm, Open MPI and Kubernetes say themselves who they
    are; elsewhere the environment does.

    Raises:
        UserError: nobody says so, or they cannot be reached.
    """
    told = [os.environ.get(name) for name in (COORDINATOR, COUNT, NUMBER)]
    try:
        if all(told):
            jax.distributed.initialize(told[0], int(told[1] or 0), int(told[2] or 0))
        else:
            jax.distributed.initialize()
    except (ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(
            f"--distributed: the processes do not find each other ({reason}); start them with srun or mpirun, "
            f"or set {COORDINATOR}, {COUNT} and {NUMBER}"
        ) from error


def is_first() -> bool:
    """Returns whether this process is the one that writes and prints."""
    return jax.process_index() == 0


def any_process(flag: bool) -> bool:
    """Returns whether a flag is set in any process; all of them ask at the same time."""
    return flag if jax.process_count() == 1 else bool(_gathered(np.array([flag])).any())


def by_first(action: Callable[[], Any]) -> None:
    """Lets the first process do something, such as write a file, while all others wait.

    Raises:
        UserError: it could not; in the others the message says where to look.
    """
    failure = None
    try:
        if is_first():
            action()
    except UserError as error:
        failure = error
    failed = any_process(failure is not None)
    if failure is not None:
        raise failure
    if failed:
        raise UserError(f"process {jax.process_index()} stops, because the first one could not go on; its message says why")


def check_alike(tree: Any, what: str) -> None:
    """Raises a `UserError` in all processes unless they hold the same values, bit for bit."""
    if jax.process_count() == 1:
        return
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        found.update(np.ascontiguousarray(leaf).tobytes())
    digests = _gathered(np.frombuffer(found.digest(), np.uint32))
    others = np.flatnonzero((digests != digests[0]).any(-1))
    if len(others):
        raise UserError(
            f"{what} of process {others[0]} and of the first one differ; all need the same program, data and kind of machine, "
            "and one folder for checkpoints that all can read"
        )


def _gathered(values: np.ndarray) -> np.ndarray:
    """Returns the arrays of all processes, with a leading axis."""
    from jax.experimental import multihost_utils

    return np.asarray(multihost_utils.process_allgather(values))
