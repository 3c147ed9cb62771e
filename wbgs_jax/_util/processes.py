"""Several processes that train one field, on one machine or on many: who writes, and how they stay together.

All of them do the same steps on the host and hold the same parameters; the first one alone writes files and prints. With one
process every function here costs nothing.
"""

import hashlib
import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from wbgs_jax._util.errors import UserError

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
