"""What a person sees of a training: a live bar on a terminal, a plain line now and then in a log.

About how long a training will take on this machine: what it takes on a known one (`Field.seconds`), and how this one
compares.

Ctrl-C during a training: it is saved first, and the message says how to go on.
"""

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.progress_lines import LOG_INTERVAL, Bar
from wbgs_jax.fields import Field

HELD_OUT = ("held_out_ssim", "held_out_power_error_db")
"""Figures that are measured now and then, and shown until they are measured again."""
LABELS = {"batch_ssim": "SSIM", "held_out_ssim": "held-out SSIM", "held_out_power_error_db": "held-out power error dB"}
UNSHOWN = ("step", "seconds")


class TrainingProgress:
    """Shows the figures of a training, steps a second and the time left, on stderr."""

    def __init__(self, total: int, done: int = 0, shown: bool = True):
        self.total, self.done, self.start_step, self.shown = total, done, done, shown
        self.held_out: dict[str, float] = {}
        self.started = self.last_line = time.monotonic()
        self.compiled = False
        self.console = Console(file=sys.stderr)
        self.bar = Bar(
            SpinnerColumn(),
            TextColumn("{task.completed}/{task.total}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=self.console,
            disable=not (shown and self.console.is_terminal),
        )
        self.task = self.bar.add_task("train", total=total, completed=done, status="compiling ...")

    def __enter__(self) -> "TrainingProgress":
        self.bar.start()
        return self

    def __exit__(self, *exception) -> None:
        self.bar.stop()

    def stage(self, what: str) -> None:
        """Shows what is done before the first step."""
        self.bar.update(self.task, status=f"{what} ...")
        if self.shown and not self.console.is_terminal:
            print(f"{what} ({time.monotonic() - self.started:.0f} s)", file=sys.stderr, flush=True)

    def update(self, entry: dict[str, Any]) -> None:
        """Shows an entry of the curves: step, loss, metrics of the batches, sizes of the field, held-out figures."""
        step = int(entry["step"])
        self.held_out = {name: entry[name] for name in HELD_OUT if entry.get(name) is not None} or self.held_out
        shown = {LABELS.get(name, name): value for name, value in (entry | self.held_out).items() if name not in UNSHOWN}
        figures = [f"{name} {value:.4g}" for name, value in shown.items() if value is not None]
        elapsed = max(time.monotonic() - self.started, 1e-9)
        rate = (step - self.start_step) / elapsed if self.compiled else None
        status = "  ".join([*figures, *([] if rate is None else [f"{rate:.1f} steps/s"])])
        self.bar.update(self.task, completed=step, status=status)
        due = time.monotonic() - self.last_line > LOG_INTERVAL or step >= self.total
        if due and self.shown and not self.console.is_terminal:
            self.last_line = time.monotonic()
            left = "" if rate is None else f"  {(self.total - step) / max(rate, 1e-9):.0f} s left"
            print(f"step {step}/{self.total}  {status}{left}", file=sys.stderr, flush=True)
        if not self.compiled:  # neither searches nor compilation come again: what they took tells no rate
            self.compiled, self.started, self.start_step = True, time.monotonic(), step


PROBE_SECONDS = 0.0095
"""What `_probe` takes there: two cores of an AMD EPYC."""
SIZE, PRODUCTS, TRIALS = 512, 8, 15


def expected_seconds(field: type[Field], preset: str, share: float = 1.0) -> float | None:
    """Returns about how long a training takes here; None where no training like it has been timed.

    Args:
        field: what is trained.
        preset: by name.
        share: of the preset's steps that are still to do.
    """
    known = field.seconds.get(preset)
    return None if known is None or jax.default_backend() != "cpu" else known * share * _probe() / PROBE_SECONDS


def duration_words(seconds: float) -> str:
    """Returns "about 12 minutes"."""
    if seconds < 90:
        return "about a minute"
    minutes = seconds / 60
    return f"about {minutes:.0f} minutes" if minutes < 90 else f"about {minutes / 60:.1f} hours"


def _probe() -> float:
    """Returns the median time of a few matrix products: other programs that run count too."""

    def products(x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, PRODUCTS, lambda _, y: jnp.tanh(y @ x) / SIZE, x)

    run, x, times = jax.jit(products), jnp.ones((SIZE, SIZE)), []
    run(x).block_until_ready()
    for _ in range(TRIALS):
        start = time.perf_counter()
        run(x).block_until_ready()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


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
