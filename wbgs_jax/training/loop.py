"""The host loop: jitted epochs, host controls between them, checkpoints, curves, resume.

A newcomer can read it top to bottom: `train` builds a `Run` (run.py), then repeats `Run.epoch` until the last step.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wbgs_jax._util.memory import give_back
from wbgs_jax._util.processes import any_process, check_alike, is_first
from wbgs_jax.config import Settings
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.fields import Field, get_field
from wbgs_jax.training.data import check_data, limited
from wbgs_jax.training.interrupts import Interrupted, deferred_interrupt
from wbgs_jax.training.progress import TrainingProgress
from wbgs_jax.training.run import CONTROLS, Run, crosses

__all__ = ["CONTROLS", "Interrupted", "Run", "TrainResult", "train"]


@dataclass(frozen=True)
class TrainResult:
    """What a training run leaves."""

    field: Field
    params: Any
    steps: int
    seconds: float
    """Wall-clock training time, summed over resumed parts."""
    compilations: int
    """Times the jitted epoch changed its shapes in this process: at the start and whenever a limit or size changed."""
    compile_seconds: float = 0.0
    """What compiling it took, in the background too."""

    @property
    def sizes(self) -> dict[str, int]:
        """How large the trained field is."""
        return self.field.sizes(self.params)


def train(
    dataset: Dataset,
    field: str,
    settings: Settings,
    seed: int,
    folder: Path,
    resume: bool = False,
    devices: int = 0,
    shown: bool = True,
) -> TrainResult:
    """Trains a field, by its name, and leaves checkpoints and curves in `folder`.

    `shown` lets a person see how it goes. Every batch is shared by so many devices of every process, evenly; by default by all
    that can. Where there are several processes (`jax.distributed`), all of them call this, and the first one writes.

    Raises:
        UserError: a loss or gradient that is not finite (step, batch and last good checkpoint named), an unwritable folder,
            no training spectra.
        Interrupted: Ctrl-C; the state is saved.
        KeyboardInterrupt: Ctrl-C in the last epoch; the state is saved, and nothing is left to train.
    """
    kind = get_field(field)
    check_data(dataset, kind)
    settings = limited(settings, dataset, kind)
    run = Run(dataset, field, settings, seed, folder, devices)
    resumed = resume and run.restore()
    check_alike((run.state, run.field), "what training begins with")
    total = settings.optim.steps
    with deferred_interrupt() as interrupt, TrainingProgress(total, run.step, shown and is_first()) as progress:
        if not resumed:
            _begin(run, progress, interrupt)
        while run.step < total:
            _advance(run, total, progress, interrupt)
    compiled = run.compile_seconds + run.precompilation.seconds
    return TrainResult(run.field, run.state.params, run.step, run.seconds, run.compilations, compiled)


def _begin(run: Run, progress: TrainingProgress, interrupt: dict[str, bool]) -> None:
    """Does what is due before the first step, and saves what that took."""

    def say(stage: str) -> None:
        give_back()
        progress.stage(stage)
        if any_process(interrupt["set"]):
            raise Interrupted("stopped before the first step; run the same command with --resume to begin again")

    if run.control(say):
        run.save()


def _advance(run: Run, total: int, progress: TrainingProgress, interrupt: dict[str, bool]) -> None:
    """Runs an epoch and all that is due after it; where nothing is, the device has the next one before this one ends."""
    before, loop = run.step, run.settings.loop
    after = before + loop.epoch_steps
    stopping = any_process(interrupt["set"])
    figures = run.epoch(go_on=not (stopping or run.due(after)))
    interrupted = any_process(interrupt["set"]) and not run.launched
    run.control()
    if run.step == total:
        run.calibrate()
    entry: dict[str, Any] = {"step": after} | {name: None if np.isnan(v) else v for name, v in figures.items()}
    entry |= run.sizes | {"seconds": run.seconds}
    if len(run.watched) and (crosses(before, after, loop.evaluate_every) or after == total):
        entry |= run.evaluate()
    run.log(entry)
    progress.update(entry)
    if crosses(before, after, loop.checkpoint_every) or after == total or interrupted:
        run.save()
    if interrupted and after < total:
        raise Interrupted(
            f"stopped at step {after} of {total}; the state is saved: run the same command with --resume to go on"
        )
