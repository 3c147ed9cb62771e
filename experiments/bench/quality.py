"""Time to quality: the device's preset trained on scene 1, scored on a fixed subset of the held-out spectra.

The clock runs from the start of the run, compilation and density control included; evaluating is the instrument and stops it.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import jax

from experiments.bench.timing import Effort, Report
from experiments.bench.training import preset, settings, start_run
from wbgs_jax._util.cli import say
from wbgs_jax._util.errors import UserError

TARGETS = (0.72, 0.80, 0.85)
PLATEAU = 0.01
"""A run is on its plateau once its SSIM is within this of its best."""
COMPILE_EVENT = "/jax/core/compile/backend_compile_duration"


@contextmanager
def compilations(found: list[tuple[str, float]]) -> Iterator[None]:
    """Note the name and the seconds of everything that XLA compiles, or its cache of programs reads, within the block."""

    def listen(event: str, duration_secs: float, **details: str | int) -> None:
        if event == COMPILE_EVENT:
            found.append((str(details.get("fun_name", "")), duration_secs))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


@dataclass
class Curve:
    """Held-out median SSIM over training time, and what was compiled on the way."""

    seconds: list[float] = field(default_factory=list)
    ssim: list[float] = field(default_factory=list)
    compiled: list[tuple[str, float]] = field(default_factory=list)

    def time_to(self, target: float) -> float | None:
        """Seconds until the SSIM first reaches the target."""
        return next((t for t, s in zip(self.seconds, self.ssim, strict=True) if s >= target), None)

    def compilations_of(self, function: str) -> int:
        """Returns how often a jitted function was compiled."""
        return sum(name == f"jit({function})" for name, _ in self.compiled)


def train(effort: Effort, folder: Path) -> Curve:
    """Returns the curve of a whole training, evaluated after every epoch."""
    if not effort.quick:
        jax.clear_caches()  # what an earlier part compiled would be free
    curve, spent, begin = Curve(), 0.0, time.perf_counter()
    with compilations(curve.compiled):
        run = start_run(effort, folder)
    spent += time.perf_counter() - begin
    total = 2 * run.settings.loop.epoch_steps if effort.quick else run.settings.optim.steps
    while run.step < total:
        begin = time.perf_counter()
        with compilations(curve.compiled):
            run.epoch()
            run.run_hooks()
        spent += time.perf_counter() - begin
        curve.seconds.append(spent)
        curve.ssim.append(run.evaluate()["held_out_ssim"])
        if run.step % 1000 == 0:
            say(f"  step {run.step}: {spent:.0f} s, SSIM {curve.ssim[-1]:.3f}")
    return curve


def start_seconds(effort: Effort) -> tuple[float, float]:
    """Seconds of the training command for one epoch, with JAX's persistent compilation cache empty and filled."""
    steps = settings(effort).loop.epoch_steps
    command = [
        sys.executable,
        "-m",
        "wbgs_jax.commands.train",
        "--scene",
        "1",
        "--preset",
        preset(effort),
        "--optim.steps",
        str(steps),
    ]
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        variables = {"JAX_COMPILATION_CACHE_DIR": f"{folder}/cache", "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
        for name in ("cold", "warm"):
            begin = time.perf_counter()
            done = subprocess.run(
                [*command, "--out", f"{folder}/{name}"], env=os.environ | variables, capture_output=True, text=True, check=False
            )
            if done.returncode:
                raise UserError(f"the training command failed: {done.stderr.strip().splitlines()[-1]}")
            seconds.append(time.perf_counter() - begin)
    return seconds[0], seconds[1]


def measure(report: Report, effort: Effort) -> None:
    """Seconds to every target and to the plateau, compilations, and what the persistent cache spares."""
    say(f"quality: {preset(effort)} preset on scene 1")
    with tempfile.TemporaryDirectory() as folder:
        curve = train(effort, Path(folder))
    for target in TARGETS:
        name = f"time_to_ssim_{round(100 * target):03d}_s"
        if (seconds := curve.time_to(target)) is None:
            report.skip(name, f"the best SSIM is {max(curve.ssim):.3f}")
        else:
            report.add(name, seconds, "s", "lower")
    plateau = curve.time_to(max(curve.ssim) - PLATEAU)
    assert plateau is not None
    report.add("time_to_plateau_s", plateau, "s", "lower")
    report.add("ssim_last", curve.ssim[-1], "SSIM", "higher")
    report.add("compilations_per_run", curve.compilations_of("run_epoch"), "compilations", "lower")
    report.add("compile_s_per_run", sum(seconds for _, seconds in curve.compiled), "s", "lower")
    if not effort.quick:
        for name, seconds in zip(("cold", "warm"), start_seconds(effort), strict=True):
            report.add(f"first_epoch_s_{name}_cache", seconds, "s", "lower")
