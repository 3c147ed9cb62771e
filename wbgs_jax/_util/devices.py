"""Data parallelism over several devices and processes.

Every device holds all parameters and data, and works on its own part of the links. The parts are made by `shard_map` in a
jitted program, over the single axis (`AXIS`) of a mesh. XLA's automatic partitioning would divide the splatting renderer as
well, but with communication between the devices for every tile (docs/scaling.md). With one device there is no mesh, and the
functions here return their arguments unchanged.

Several processes, on one machine or on many, can train one field. All of them take the same steps on the host and hold the same
parameters; only the first one writes files and prints. With one process the functions here cost nothing.
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
"""Axis of the mesh along which the links of a batch, or the queries of a map, are divided."""
EVERYWHERE, DIVIDED = PartitionSpec(), PartitionSpec(AXIS)


class Devices:
    """A set of devices and the data replicated on all of them. `mesh` is None for a single device."""

    def __init__(self, mesh: Mesh | None = None):
        self.mesh = mesh
        self._kept: tuple[Any, Any] = (), ()

    @property
    def count(self) -> int:
        """Number of devices, including those of other processes."""
        return 1 if self.mesh is None else self.mesh.size

    def replicated(self, tree: Any) -> Any:
        """Returns a tree of arrays with a copy on every device; every process must pass the same tree."""
        if self.mesh is None:
            return tree
        everywhere, here = NamedSharding(self.mesh, EVERYWHERE), self.mesh.local_devices

        def copies(leaf: Any) -> Array:
            own = [jax.device_put(leaf, device) for device in here]
            return jax.make_array_from_single_device_arrays(np.shape(leaf), everywhere, own)

        return jax.tree.map(copies, tree)

    def kept(self, *trees: Any) -> Any:
        """Returns `replicated` trees; copies from the previous call are reused if the trees are the same objects."""
        if self.mesh is None:
            return trees
        before, placed = self._kept
        if len(before) != len(trees) or any(a is not b for a, b in zip(before, trees, strict=True)):
            placed = self.replicated(trees)
            self._kept = trees, placed
        return placed

    def own(self, tree: Any) -> Any:
        """Returns the copy of a replicated tree on this process's first device, for work on the host."""
        return tree if self.mesh is None else jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)


def devices_for(batch: int, wanted: int = 0) -> tuple[Devices, str]:
    """Returns as many devices as can share a batch of links evenly, and a line of text if some stay idle, else an empty one.

    Args:
        batch: number of links.
        wanted: maximum number of devices per process; 0 for all.

    Raises:
        UserError: there are fewer devices, or the processes cannot share the batch evenly.
    """
    processes, have = jax.process_count(), jax.local_device_count()
    if not 0 <= wanted <= have:
        raise UserError(f"--devices is {wanted}, but this process has {have}; give 1 to {have}, or 0 for all")
    if batch % processes:
        raise UserError(f"{processes} processes cannot share a batch of {batch} links evenly; set --optim.batch to a multiple")
    requested = wanted or have
    used = max(count for count in range(1, requested + 1) if batch // processes % count == 0)
    idle = (
        f"a batch of {batch} links uses {used} of {requested} devices; --optim.batch {batch // used * requested} would use all"
    )
    return Devices(_mesh(jax.devices(), used)), idle if used < requested else ""


def own_devices() -> Devices:
    """Returns all devices of this process, for work in which no other process takes part."""
    return Devices(_mesh(jax.local_devices(), jax.local_device_count()))


def _mesh(devices: list[Any], each: int) -> Mesh | None:
    """Returns a mesh of the first `each` devices of every process; None for a single device."""
    owners = sorted({device.process_index for device in devices})
    chosen = [device for owner in owners for device in [d for d in devices if d.process_index == owner][:each]]
    return None if len(chosen) == 1 else Mesh(np.array(chosen), (AXIS,))


def averaged(function: Callable[..., Any], mesh: Mesh | None, divided: int) -> Callable[..., Any]:
    """Returns a function that every device evaluates on its part (along the leading axis) of positional argument `divided` and
    on all of the other arguments. All devices get the same results: means of floats, maxima of integers and booleans."""
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
    """Returns a function whose positional argument `divided` and whose results share a leading axis, which is divided between
    the devices; each device gets all of the other arguments."""
    return function if mesh is None else _shared_out(function, mesh, divided, DIVIDED)


def _shared_out(function: Callable[..., Any], mesh: Mesh, divided: int, out: PartitionSpec) -> Callable[..., Any]:
    def shared(*arguments: Any) -> Any:
        specs = tuple(DIVIDED if number == divided else EVERYWHERE for number in range(len(arguments)))
        # The check of varying values is off: the renderers' loops start from zeros that are the same on all devices.
        return jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=out, check_vma=False)(*arguments)

    return shared


def over_all_links(total: Num[Array, "*n"]) -> Num[Array, "*n"]:
    """Returns the sum over all devices of a sum over a device's links, for losses that divide one sum by another. Unchanged if
    the links are not divided."""
    divided = AXIS in jax.sharding.get_abstract_mesh().manual_axes
    return jax.lax.psum(total, AXIS) if divided else total


COORDINATOR, COUNT, NUMBER = "JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"
"""Environment variables with host:port of the first process, the number of processes, and the index of this one."""


def connect() -> None:
    """Connects to the other processes; must be called before any other use of JAX. Slurm, Open MPI and Kubernetes provide the
    settings themselves; otherwise they are taken from the environment.

    Raises:
        UserError: the settings are missing, or the other processes cannot be reached.
    """
    settings = [os.environ.get(name) for name in (COORDINATOR, COUNT, NUMBER)]
    try:
        if all(settings):
            jax.distributed.initialize(settings[0], int(settings[1] or 0), int(settings[2] or 0))
        else:
            jax.distributed.initialize()
    except (ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(
            f"--distributed: the processes cannot connect ({reason}); start them with srun or mpirun, "
            f"or set {COORDINATOR}, {COUNT} and {NUMBER}"
        ) from error


def is_first() -> bool:
    """Returns whether this process is the one that writes files and prints."""
    return jax.process_index() == 0


def any_process(flag: bool) -> bool:
    """Returns whether a flag is set in any process; all processes must call this at the same time."""
    return flag if jax.process_count() == 1 else bool(_gathered(np.array([flag])).any())


def by_first(action: Callable[[], Any]) -> None:
    """Runs an action, such as writing a file, in the first process while all others wait.

    Raises:
        UserError: the action failed; in the other processes the message refers to the first one.
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
        raise UserError(f"process {jax.process_index()} stops because the first one failed; see its message")


def check_alike(tree: Any, what: str) -> None:
    """Raises a `UserError` in all processes unless they hold the same values, bit for bit.

    Args:
        tree: of arrays.
        what: name of the tree, for the message.
    """
    if jax.process_count() == 1:
        return
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        found.update(np.ascontiguousarray(leaf).tobytes())
    digests = _gathered(np.frombuffer(found.digest(), np.uint32))
    others = np.flatnonzero((digests != digests[0]).any(-1))
    if len(others):
        raise UserError(
            f"{what} of process {others[0]} and of the first one differ; all processes need the same program, data and kind of "
            "machine, and a checkpoint folder that all can read"
        )


def _gathered(values: np.ndarray) -> np.ndarray:
    """Returns the arrays of all processes, stacked along a leading axis."""
    from jax.experimental import multihost_utils

    return np.asarray(multihost_utils.process_allgather(values))
