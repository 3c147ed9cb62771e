"""The jitted epoch for the next size of a field, compiled while the device trains the present one.

A field grows in steps that are known in advance. A call that runs no step compiles what the next size needs; when it is needed,
it is there, or waited for.
"""

import threading
import time
from collections.abc import Callable, Hashable


class Precompilation:
    """Programs that threads of the background compile, each once."""

    def __init__(self) -> None:
        self._threads: dict[Hashable, threading.Thread] = {}
        self._ready: set[Hashable] = set()
        self.seconds = 0.0
        """What compiling took, of what is ready."""

    def begin(self, key: Hashable, call: Callable[[], object]) -> None:
        """Starts a call whose programs have this key, unless it has been started before."""
        if key not in self._threads:
            self._threads[key] = threading.Thread(target=self._run, args=(key, call))  # a process ends after it: XLA demands it
            self._threads[key].start()

    def wait(self, key: Hashable) -> bool:
        """Waits for a call that is under way; returns whether its programs are ready."""
        if key in self._threads:
            self._threads[key].join()
        return key in self._ready

    def _run(self, key: Hashable, call: Callable[[], object]) -> None:
        begin = time.perf_counter()
        call()
        self.seconds += time.perf_counter() - begin
        self._ready.add(key)
