"""Progress of a training: a live bar on a terminal, or a plain line at intervals in a log.

The module also estimates the time of a training on this machine, from that on a reference machine (`Field.seconds`) and a short
benchmark, and handles Ctrl-C during training: the state is saved first, and the message explains how to continue.
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

from wbgs_jax._util.cli import STOPPED
from wbgs_jax._util.compilation import has_compiled
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.progress_lines import Bar, Pulse
from wbgs_jax.fields import Field

LABELS = {
    "batch_ssim": "SSIM of the batch",
    "batch_ssim_wave": "of its coherent half",
    "held_out_ssim": "SSIM on validation",
    "held_out_power_error_db": "power error on validation (dB)",
}


class TrainingProgress:
    """Shows the metrics of a training, steps per second and the remaining time, on stderr."""

    def __init__(self, total: int, done: int = 0, shown: bool = True):
        self.total, self.start_step = total, done
        self.held_out: dict[str, float] = {}
        self.begun = self.started = time.monotonic()
        self.entries = 0
        self.state = "compiling"
        console = Console(file=sys.stderr)
        self.bar = Bar(
            SpinnerColumn(),
            TextColumn("{task.completed}/{task.total}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            disable=not (shown and console.is_terminal),
        )
        self.task = self.bar.add_task("train", total=total, completed=done, status="compiling ...")
        self.ready: float | None = None
        """When the last step is expected (`time.monotonic`); None before there is a rate."""
        self.pulse = Pulse(self._line, shown)

    def __enter__(self) -> "TrainingProgress":
        self.bar.start()
        self.pulse.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        self.pulse.__exit__()
        self.bar.stop()

    def _line(self) -> str:
        """Returns the present state for a log, without a remaining time that has run out, as when a program is compiled."""
        now = time.monotonic()
        left = "" if self.ready is None or self.ready < now else f"  {self.ready - now:.0f} s left"
        return f"{self.state}{left} ({now - self.begun:.0f} s)"

    def stage(self, what: str) -> None:
        """Shows a stage of the work before the first step or between two steps."""
        self.state, self.ready = what, None
        self.bar.update(self.task, status=f"{what} ...")
        self.pulse.print()

    def update(self, entry: dict[str, Any]) -> None:
        """Shows an entry of the curves: step, loss, metrics of the batches, sizes of the field, held-out figures."""
        step = int(entry["step"])
        # Metrics that are evaluated at intervals, and displayed until the next evaluation
        held_out = ("held_out_ssim", "held_out_power_error_db")
        self.held_out = {name: entry[name] for name in held_out if entry.get(name) is not None} or self.held_out
        # Entries that are not displayed: most of these numbers do not change
        unshown = ("step", "seconds", "materials", "facets", "edges")
        shown = {LABELS.get(name, name): value for name, value in (entry | self.held_out).items() if name not in unshown}
        figures = [f"{name} {value:.4g}" for name, value in shown.items() if value is not None]
        elapsed = max(time.monotonic() - self.started, 1e-9)
        rate = (step - self.start_step) / elapsed if self.entries > 1 else None
        status = "  ".join([*figures, *([] if rate is None else [f"{rate:.1f} steps/s"])])
        self.bar.update(self.task, completed=step, status=status)
        self.ready = None if rate is None else time.monotonic() + (self.total - step) / max(rate, 1e-9)
        self.state = f"step {step}/{self.total}  {status}"
        if step >= self.total:
            self.pulse.print()
        self.entries += 1
        # Calibration and compilation happen once: their time is not part of the rate. While the first evaluation is compiled,
        # the second epoch runs.
        if self.entries <= 2:
            self.started, self.start_step = time.monotonic(), step


PROBE_SECONDS = 0.0112
"""Time of `_probe` on the reference machine, two cores of an AMD EPYC at 2 GHz."""
SIZE, ROUNDS, TRIALS = 2**19, 8, 9


def expected_seconds(field: type[Field], preset: str, share: float = 1.0) -> float | None:
    """Returns the approximate time of a training on this machine, seconds; None if there is no reference time.

    Args:
        field: class of the field.
        preset: name of the preset.
        share: number of steps, relative to the preset's.
    """
    known = field.seconds.get(preset)
    if known is None or jax.default_backend() != "cpu":
        return None
    compiling = 0 if has_compiled("run_epoch") else known.compiling
    return (known.steps * share + known.others + compiling) * _probe() / PROBE_SECONDS


def duration_words(seconds: float) -> str:
    """Returns a duration in words, such as "about 12 minutes"."""
    minutes = seconds / 60
    if minutes < 2:
        return f"about {max(10 * round(seconds / 10), 10)} seconds"
    if minutes < 90:
        return f"about {round(2 * minutes) / 2 if minutes < 5 else round(minutes):g} minutes"
    return f"about {minutes / 60:.1f} hours"


def _probe() -> float:
    """Returns the median time of functions of large arrays, seconds, which the other programs on the machine slow down as they
    do the steps of a training. (Matrix products are slowed down more.)"""

    def functions(x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, ROUNDS, lambda _, y: jnp.exp(-jnp.abs(y)) * jnp.sin(y) + 0.1, x)

    run, x, times = jax.jit(functions), jnp.linspace(0, 1, SIZE), []
    run(x).block_until_ready()
    for _ in range(TRIALS):
        start = time.perf_counter()
        run(x).block_until_ready()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


class Interrupted(UserError):
    """Ctrl-C: the state is saved, and the message explains how to continue."""

    exit_code = STOPPED


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[dict[str, bool]]:
    """Turns the first Ctrl-C into a flag that is checked between epochs; a second one interrupts immediately. The signals are
    raised again at the end, in case the flag was not checked.

    Signals reach the main thread only; in other threads the flag is never set.
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
    for number in received:  # reached only if no exception has been raised, so the flag was not checked
        signal.raise_signal(number)
