"""Progress display of long work: a live bar on a terminal, a plain line at intervals in a log."""

import sys
import threading
import time
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

LOG_INTERVAL = 9.0
"""Seconds between two lines if the output is not a terminal."""


class Bar(Progress):
    """A live bar that prints nothing if disabled; older versions of rich print an empty line at the end even then."""

    def stop(self) -> None:
        """Ends the display."""
        if not self.disable:
            super().stop()


class Pulse:
    """Prints the present state of long work on stderr at intervals, from another thread: a compilation or a search that takes
    minutes in one call is seen to be alive. Nothing is printed on a terminal, where bars move, or unless `shown`."""

    def __init__(self, line: Callable[[], str], shown: bool = True):
        self.line, self.shown = line, shown and not Console(file=sys.stderr).is_terminal
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "Pulse":
        if self.shown:
            self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._ended.set()
        if self.shown:
            self._thread.join()

    def print(self) -> None:
        """Prints the line now."""
        if self.shown:
            print(self.line(), file=sys.stderr, flush=True)

    def _run(self) -> None:
        while not self._ended.wait(LOG_INTERVAL):
            self.print()


class CountProgress:
    """Shows on stderr how many of a number of equal steps are done, and the remaining time; nothing unless `shown`."""

    def __init__(self, label: str, total: int, done: int = 0, shown: bool = True):
        self.label, self.total, self.done, self.start_done = label, total, done, done
        self.started: float | None = None
        columns = (TextColumn(label), BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn())
        console = Console(file=sys.stderr)
        own = TextColumn("left"), TimeRemainingColumn()
        self.bar = Bar(*columns, *own, console=console, disable=not (shown and console.is_terminal))
        self.task = self.bar.add_task(label, total=total, completed=done)
        self.pulse = Pulse(self._line, shown)

    def __enter__(self) -> "CountProgress":
        self.bar.start()
        self.pulse.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        self.pulse.__exit__()
        self.bar.stop()

    def advance(self, count: int = 1) -> None:
        """Records that more steps are done."""
        self.done += count
        self.bar.update(self.task, completed=self.done)
        if self.started is None:  # the first step is not part of the rate: it includes compilation
            self.started, self.start_done = time.monotonic(), self.done
        if self.done == self.total:
            self.pulse.print()

    def _line(self) -> str:
        done = self.done - self.start_done
        if self.started is None or not done:
            return f"{self.label}: {self.done}/{self.total}"
        left = (self.total - self.done) * (time.monotonic() - self.started) / done
        return f"{self.label}: {self.done}/{self.total}  {left:.0f} s left"
