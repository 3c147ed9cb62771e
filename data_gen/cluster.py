"""Runs tasks in several processes, on this or other machines, with Dask, which repeats the tasks of killed workers."""

import contextlib
import logging
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from wbgs_jax._util.errors import UserError

LOCAL = "local"
"""Value in place of a scheduler's address that starts processes on this machine."""
CONNECT_S = "30s"
SETTINGS: dict[str, Any] = {
    # By default Dask limits linear algebra to one thread per process, and serial runs might then differ in the last bit.
    "distributed.nanny.pre-spawn-environ": {},
    "distributed.comm.timeouts.connect": CONNECT_S,
    # A worker that compiles for minutes is busy, not lost.
    "distributed.scheduler.worker-ttl": None,
}
Task = TypeVar("Task")


@contextlib.contextmanager
def connected(where: str, workers: int) -> Iterator[Any]:
    """Yields a Dask client: for `workers` single-threaded processes on this machine, or for a scheduler at an address.

    Args:
        where: `LOCAL` or the scheduler's address.
        workers: number of local processes.

    Raises:
        UserError: Dask is not installed, or no scheduler answers at the address.
    """
    try:
        import dask
        import distributed
    except ImportError as error:
        raise UserError("--cluster needs Dask; install it with: pip install 'wbgs-jax[cluster]'") from error
    with dask.config.set(SETTINGS), contextlib.ExitStack() as stack:
        cluster: Any = where
        if where == LOCAL:
            # No memory limit: Dask would end processes whose memory JAX needs. Processes ended by the kernel are restarted.
            wanted = {"n_workers": workers, "threads_per_worker": 1, "memory_limit": 0, "dashboard_address": None}
            cluster = distributed.LocalCluster(**wanted, silence_logs=logging.ERROR)
            stack.callback(_close, cluster)
        try:
            client = distributed.Client(cluster, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise UserError(f"no Dask scheduler answers at {where} ({reason}); start one with `dask scheduler`") from error
        yield stack.enter_context(client)


def _close(cluster: Any) -> None:
    """Closes local workers. If one does not end in time, results are kept all the same; it ends with this process."""
    with contextlib.suppress(TimeoutError, OSError):
        cluster.close(timeout=30.0)


def finished(
    client: Any, function: Callable[..., Any], tasks: Sequence[Task], *common: Any, seconds: float | None = None
) -> Iterator[tuple[Task, Any, Exception | None]]:
    """Yields, for every task when it is done: the task, the result of `function(task, *common)`, and its exception.

    Tasks begin in order. If a worker is killed, its task is sent to another one; a task that kills several workers fails.

    Raises:
        TimeoutError: not all were done within `seconds`. Waiting tasks are cancelled.
    """
    import distributed

    futures = {client.submit(function, task, *common, pure=False, priority=-number): task for number, task in enumerate(tasks)}
    try:
        for future in distributed.as_completed(list(futures), timeout=seconds):
            error = future.exception() if future.status != "finished" else None
            yield futures[future], None if error else future.result(), error
    finally:
        client.cancel(list(futures), force=True)
