"""Trainings of scene 1 for as long as there is time: the paper's own form of the wideband field, and the coherent field."""

import dataclasses
import tempfile
import time
from pathlib import Path
from typing import Any

from experiments.bench.rays import measure_scene
from experiments.bench.timing import Effort, Report
from experiments.gpu_check.record import Record, rounded
from experiments.gpu_check.renderer import most_memory
from experiments.profiles import TINY
from wbgs_jax._util.command import say
from wbgs_jax.config import Settings, changed, limit_steps
from wbgs_jax.data import load_dataset
from wbgs_jax.data.splits import hold_out_validation
from wbgs_jax.fields import get_field
from wbgs_jax.training.loop import Run

SCENE = "1"
SPARE = 3.0
"""An epoch begins only if so many of the longest one so far would fit: one may have to be compiled anew."""


def measure_paper(record: Record, deadline: float, quick: bool) -> None:
    """Trains the preset `paper`; in the stand-in a tiny field by the preset `smoke`."""
    preset = "smoke" if quick else "paper"
    settings = get_field("wideband").presets[preset]
    if quick:
        settings = changed(settings, {"field": TINY, "loop": {"epoch_steps": 2}})
    train(record, deadline, "wideband", settings, preset, longest=2 if quick else None)


def measure_coherent(record: Record, deadline: float, quick: bool) -> None:
    """Traces paths, answers queries, and trains materials and antennas without the searches of the host."""
    record.add("paths_ms", paths(quick))
    preset = "smoke" if quick else "gpu"
    settings = dataclasses.replace(get_field("wave").presets[preset], search=None)
    if quick:
        settings = changed(settings, {"loop": {"epoch_steps": 2}})
    train(record, deadline, "wave", settings, preset, longest=1 if quick else None)


def train(record: Record, deadline: float, field: str, settings: Settings, preset: str, longest: int | None) -> None:
    """Trains until the deadline (of `time.monotonic`), `longest` epochs at most, and keeps every epoch."""
    dataset = hold_out_validation(load_dataset(SCENE))
    settings = limit_steps(settings, len(dataset.train))
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        run = Run(dataset, field, settings, 0, Path(folder))
        record.add("start_s", round(time.monotonic() - begin, 1))
        slowest, epochs = 0.0, 0
        while run.step < settings.optim.steps and epochs != longest and time.monotonic() + SPARE * slowest < deadline:
            start, trained = time.monotonic(), run.seconds
            losses = run.epoch()
            run.control()
            slowest, epochs = max(slowest if epochs > 1 else 0.0, time.monotonic() - start), epochs + 1
            record.add("training", state_of(run, preset, run.seconds - trained, losses["loss"]))
        record.add("validation_ssim", rounded(run.evaluate()["held_out_ssim"]))
    say(f"  {field}, preset {preset}: {run.step} of {settings.optim.steps} steps")


def state_of(run: Run, preset: str, seconds: float, loss: float) -> dict[str, Any]:
    """Returns how far a training is; `ms_per_step` is that of its last epoch, without compilation as a rule."""
    steps = run.settings.loop.epoch_steps
    sizes = run.field.sizes(run.state.params)
    figures = {"preset": preset, "steps": run.step, "of": run.settings.optim.steps, "batch": run.settings.optim.batch}
    times = {"seconds": round(run.seconds, 1), "ms_per_step": rounded(1e3 * seconds / steps), "loss": rounded(loss)}
    return figures | times | sizes | {"compilations": run.compilations} | most_memory()


def paths(quick: bool) -> dict[str, float]:
    """Returns what a receiver, a transmitter and a spectrum take, milliseconds, as `make bench ARGS="--only rays"` has them."""
    report = Report()
    measure_scene(report, Effort(repeats=2 if quick else 5, budget_s=10.0), SCENE)
    return {name: metric["value"] for name, metric in report.metrics.items()}
