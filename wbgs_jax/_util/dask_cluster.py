"""Work in several processes, here or on other machines, by Dask: it queues, sends, and repeats what a killed worker leaves."""

import contextlib
import logging
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from wbgs_jax._util.errors import UserError

LOCAL = "local"
"""In the place of a scheduler's address: processes on this machine."""
CONNECT_S = "30s"
CLOSE_S = 30.0
SETTINGS: dict[str, Any] = {
    # Dask would give its processes one thread for linear algebra each: then a serial run might differ in the last bit.
    "distributed.nanny.pre-spawn-environ": {},
    "distributed.comm.timeouts.connect": CONNECT_S,
    # A worker that compiles for minutes is busy, not dead.
    "distributed.scheduler.worker-ttl": None,
}
Task = TypeVar("Task")


@contextlib.contextmanager
def connected(where: str, workers: int) -> Iterator[Any]:
    """Yields a Dask client: of `workers` processes of one thread each on this machine, or of a scheduler by its address.

    Raises:
        UserError: Dask is not installed, or nobody answers at the address.
    """
    try:
        import dask
        import distributed
    except ImportError as error:
        raise UserError("--cluster needs Dask; install it with: pip install 'wbgs-jax[cluster]'") from error
    with dask.config.set(SETTINGS), contextlib.ExitStack() as stack:
        cluster: Any = where
        if where == LOCAL:
            # No limit of memory: Dask would end processes that JAX has good use for. One that the kernel ends is started anew.
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
    """Ends local workers. One that does not end in time is no reason to lose what all have done: it ends with this process."""
    with contextlib.suppress(TimeoutError, OSError):
        cluster.close(timeout=CLOSE_S)


def finished(
    client: Any, function: Callable[..., Any], tasks: Sequence[Task], *common: Any, seconds: float | None = None
) -> Iterator[tuple[Task, Any, Exception | None]]:
    """Yields every task when it is done: itself, what `function(task, *common)` returned, and what it raised.

    Tasks begin in their order. One whose worker is killed is sent to another; one that kills several fails.

    Raises:
        TimeoutError: not all were done within so many seconds. What waits is not begun then.
    """
    import distributed

    futures = {client.submit(function, task, *common, pure=False, priority=-number): task for number, task in enumerate(tasks)}
    try:
        for future in distributed.as_completed(list(futures), timeout=seconds):
            error = future.exception() if future.status != "finished" else None
            yield futures[future], None if error else future.result(), error
    finally:
        client.cancel(list(futures), force=True)
