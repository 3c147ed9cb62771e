"""Ctrl-C during a training: it is saved first, and the message says how to go on."""

import contextlib
import signal
import threading
from collections.abc import Iterator

from wbgs_jax._util.errors import UserError


class Interrupted(UserError):
    """Ctrl-C: the state is saved, the message says how to go on."""


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[dict[str, bool]]:
    """Turns the first Ctrl-C into a flag that is looked at between epochs; a second one interrupts at once. One that comes too
    late to be looked at is passed on at the end.

    Signals reach the main thread only; elsewhere the flag is never set.
    """
    flag, received = {"set": False}, list[int]()

    def handler(signum, frame):
        if flag["set"]:
            raise KeyboardInterrupt
        flag["set"] = True
        received.append(signum)

    signals = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    previous = {s: signal.signal(s, handler) for s in signals}
    try:
        yield flag
    finally:
        for s, old in previous.items():
            signal.signal(s, old)
    for number in received:  # nobody was told
        signal.raise_signal(number)
