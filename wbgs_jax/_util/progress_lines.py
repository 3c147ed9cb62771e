"""Progress display of long work: a live bar on a terminal, a plain line at intervals in a log."""

import sys
import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

LOG_INTERVAL = 20.0
"""Seconds between two lines if the output is not a terminal."""


class Bar(Progress):
    """A live bar that prints nothing if disabled; older versions of rich print an empty line at the end even then."""

    def stop(self) -> None:
        """Ends the display."""
        if not self.disable:
            super().stop()


class CountProgress:
    """Shows on stderr how many of a number of equal steps are done, and the remaining time."""

    def __init__(self, label: str, total: int, done: int = 0):
        self.label, self.total, self.done, self.start_done = label, total, done, done
        self.started = self.last_line = time.monotonic()
        self.console = Console(file=sys.stderr)
        columns = (TextColumn(label), BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn())
        self.bar = Bar(
            *columns, TextColumn("left"), TimeRemainingColumn(), console=self.console, disable=not self.console.is_terminal
        )
        self.task = self.bar.add_task(label, total=total, completed=done)

    def __enter__(self) -> "CountProgress":
        self.bar.start()
        return self

    def __exit__(self, *exception) -> None:
        self.bar.stop()

    def advance(self) -> None:
        """Records that one more step is done."""
        self.done += 1
        self.bar.update(self.task, completed=self.done)
        now = time.monotonic()
        if not self.console.is_terminal and (now - self.last_line > LOG_INTERVAL or self.done == self.total):
            self.last_line = now
            left = (self.total - self.done) * (now - self.started) / (self.done - self.start_done)
            print(f"{self.label}: {self.done}/{self.total}  {left:.0f} s left", file=sys.stderr, flush=True)
