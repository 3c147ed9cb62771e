"""The host loop: jitted epochs, host controls between them, checkpoints, curves, resume.

A newcomer can read it top to bottom: `train` builds a `Run`, then repeats `Run.epoch` until the last step. What a field is
made of is the field's business; the loop knows the seam alone (`fields.base.Field`).
"""

import dataclasses
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from wbgs_jax._util.devices import devices_for
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.memory import give_back
from wbgs_jax._util.processes import any_process, by_first, check_alike, is_first
from wbgs_jax.config import Settings, limit_steps
from wbgs_jax.data.checksum import checksum
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.splits import training_links, without_test
from wbgs_jax.data.surface import DatasetScene
from wbgs_jax.evaluation.score import watch
from wbgs_jax.fields import Field, get_field
from wbgs_jax.training import checkpoint, curves
from wbgs_jax.training.controls import Context, Control, Edit, OfPart, Say, silent
from wbgs_jax.training.data import TrainingData, check_data, training_data
from wbgs_jax.training.density import DensityControl
from wbgs_jax.training.interrupts import Interrupted, deferred_interrupt
from wbgs_jax.training.moments import map_moments
from wbgs_jax.training.optim import make_optimizer
from wbgs_jax.training.progress import TrainingProgress
from wbgs_jax.training.search import Search
from wbgs_jax.training.step import EpochReport, TrainState, init_state, run_epoch

CONTROLS: dict[str, Callable[[Any], Control]] = {"density": DensityControl, "search": Search}
"""Host controls by the names that fields and settings give them."""
CALIBRATED, BLOCK = 720, 16
"""Validation links that a field is calibrated by, at most, and how many at a time."""


def make_control(name: str, settings: Settings) -> Control | None:
    """Returns the host control that a field asks for by this name; None where the settings switch it off."""
    part, _, kind = name.rpartition(".")
    config = getattr(settings, kind)
    if not config:
        return None
    control = CONTROLS[kind](config)
    return OfPart(part, control) if part else control


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

    @property
    def sizes(self) -> dict[str, int]:
        """How large the trained field is."""
        return self.field.sizes(self.params)


class Run:
    """One training run in a folder; everything that changes hangs here, everything pure is in step.py."""

    def __init__(self, dataset: Dataset, field: str, settings: Settings, seed: int, folder: Path, devices: int = 0):
        self.numbers = training_links(dataset)  # of the links, as the data count them
        self.checksum = checksum(dataset)
        dataset = without_test(dataset)  # nothing in a training can look at the test
        self.dataset, self.settings, self.seed, self.folder = dataset, settings, seed, folder
        kind, self.key = get_field(field), jax.random.key(seed)
        self.controls = tuple(control for name in kind.controls if (control := make_control(name, settings)))
        self.optimizer = make_optimizer(kind, settings.field, settings.optim)
        self.checkpoints = folder / "checkpoints"
        self.seconds, self.compilations = 0.0, 1
        self.field = kind.make(settings.field, DatasetScene(dataset), seed)
        self.state = init_state(self.field.init(self.key), self.optimizer, self.controls)
        self.limits = self.field.limits(self.state.params, dataset.receivers)
        self.data: TrainingData = training_data(dataset)
        rng = np.random.default_rng([seed, 1])
        watched = min(settings.loop.evaluate_spectra, len(dataset.validation))
        self.watched = np.sort(rng.choice(dataset.validation, watched, replace=False))
        self.devices, idle = devices_for(self.batch, devices)
        if idle and is_first():
            warnings.warn(idle, stacklevel=2)

    @cached_property
    def cache(self) -> Any:
        """What the field has prepared of all links: when it is first asked for, since a checkpoint may bring another field."""
        return self.field.prepare(self.data.links, self.data.receivers)

    @property
    def batch(self) -> int:
        """Links a step."""
        return min(self.settings.optim.batch, len(self.dataset.train))

    @property
    def step(self) -> int:
        """Steps done."""
        return int(self.state.step)

    def batches(self, epoch: int, steps: int) -> Int[np.ndarray, "k b"]:
        """Returns the batches of an epoch, each of one receiver: a function of seed and epoch alone, so that a resumed run sees
        the same ones."""
        rng = np.random.default_rng([self.seed, 2, epoch])
        pool = self.pool(epoch * steps / self.settings.optim.steps)
        return np.stack([self._draw(rng, pool, self.batch) for _ in range(steps)]).astype(np.int32)

    def _draw(self, rng: np.random.Generator, pool: Int[np.ndarray, " n"], batch: int) -> Int[np.ndarray, " b"]:
        if self.dataset.n_receivers > 1:  # a receiver as often as its share of the links
            of_receiver = self.dataset.receiver_index[pool]
            pool = pool[of_receiver == rng.choice(of_receiver)]
        return rng.choice(pool, batch, replace=len(pool) < batch)

    def pool(self, progress: float) -> Int[np.ndarray, " n"]:
        """Returns the training links that batches are drawn from after this share of the steps: low frequencies first, if
        asked."""
        train, curriculum = self.dataset.train, self.settings.optim.curriculum
        frequencies = self.dataset.frequencies_hz[train]
        if progress >= curriculum:
            return train
        low, high = frequencies.min(), frequencies.max()
        return train[frequencies <= low * (high / low) ** (progress / curriculum) * (1 + 1e-6)]

    def epoch(self) -> dict[str, float]:
        """Runs one block of steps and returns means of the loss and of the metrics. Overflowed steps are repeated with larger
        limits."""
        begin, length = time.perf_counter(), self.settings.loop.epoch_steps
        batches = self.batches(self.step // length, length)
        done, figures = 0, dict[str, list[float]]()
        while done < length:
            state, report = run_epoch(
                self.devices.replicated(self.state),
                *self.devices.kept(self.field, self.cache, self.data),
                *self.devices.replicated((jnp.asarray(batches), jnp.asarray(done, jnp.int32), self.key)),
                optimizer=self.optimizer,
                controls=self.controls,
                limits=self.limits,
                mesh=self.devices.mesh,
            )
            self.state, report = self.devices.own((state, report))
            ran = slice(done, done + int(report.good_steps))
            for name, values in ({"loss": report.loss} | report.metrics).items():
                figures.setdefault(name, []).extend(np.asarray(values)[ran].tolist())
            done = ran.stop
            if report.stopped:
                self._recover(report, batches[done])
        self.seconds += time.perf_counter() - begin
        return {name: float(np.mean(values)) for name, values in figures.items()}

    def _recover(self, report: EpochReport, batch: Int[np.ndarray, " b"]) -> None:
        """Grows the limits after an overflow; anything else that stops an epoch is a loss or gradient that is not finite."""
        if report.overflow:
            self.limits = self.field.grow(self.limits, np.asarray(report.required))
            self.compilations += 1
            return
        saved = checkpoint.checkpoint_steps(self.checkpoints)
        last = f"the last good checkpoint is {self.checkpoints / str(saved[-1])}" if saved else "there is no checkpoint yet"
        raise UserError(
            f"the loss of step {self.step} or its gradient is not finite; {last}. Check spectra "
            f"{self.numbers[batch].tolist()}, counted from 0, or start again with smaller learning rates"
        )

    def control(self, say: Say = silent) -> bool:
        """Lets every host control act that is due, and returns whether any was; `say` is told of long work."""
        acted = False
        for number, control in enumerate(self.controls):
            if control.due(self.step, self.settings.optim.steps):
                begin, step = time.perf_counter(), self.step
                rng = np.random.default_rng([self.seed, control.stream, step])
                context = Context(self.data, self.cache, self.dataset.train, say)
                edit = control.apply(self.field, self.state.params, self.state.statistics[number], context, step, rng)
                self._commit(number, edit)
                check_alike(self.state, f"what the {type(control).__name__} made of the parameters")
                self.seconds += time.perf_counter() - begin
                if edit.report:
                    self.log({"step": step} | edit.report)
                acted = True
        give_back()
        return acted

    def _commit(self, number: int, edit: Edit) -> None:
        """Puts a control's edit into the state, moments and all."""
        old, statistics = self.state, list(self.state.statistics)
        if _shapes(edit.params) != _shapes(old.params):
            self.compilations += 1
            statistics = [control.statistics(edit.params) for control in self.controls]  # what others saw is of other shapes
        follow = edit.moments
        moments = map_moments(old.optimizer, old.params, follow) if follow else self.optimizer.init(edit.params)
        statistics[number] = edit.statistics
        self.state = TrainState(edit.params, moments, tuple(statistics), old.step)
        if edit.field is not None:
            self.field, self.cache = edit.field, edit.cache

    def calibrate(self) -> None:
        """Lets the field learn what only the validation part can say."""
        chosen = np.random.default_rng([self.seed, 4]).permutation(self.dataset.validation)[:CALIBRATED]
        receiver = self.dataset.receiver_index[chosen]
        blocks = [
            own[i : i + BLOCK]
            for number in np.unique(receiver)
            for own in [chosen[receiver == number]]
            for i in range(0, len(own), BLOCK)
        ]
        batches = [self.data.batch(jnp.asarray(block, jnp.int32), self.key) for block in blocks]
        params, report = self.field.calibrate(self.state.params, self.cache, batches)
        self.state = dataclasses.replace(self.state, params=params)
        if report:
            self.log({"step": self.step} | report)

    def evaluate(self) -> dict[str, float]:
        """Returns figures of the watched validation spectra."""
        return watch(self.field, self.state.params, self.dataset, self.watched)

    def log(self, entry: dict[str, Any]) -> None:
        """Appends a line to metrics.jsonl."""
        if is_first():
            curves.append(self.folder / "metrics.jsonl", entry)

    def save(self) -> None:
        """Writes a checkpoint of the present step."""
        limits = dataclasses.asdict(self.limits) if self.limits else None
        metadata = {"limits": limits, "seconds": self.seconds, "data": self.checksum}
        keep = self.settings.loop.keep_checkpoints
        check_alike(self.state, f"the state of step {self.step}")
        checkpoint.save(self.checkpoints, self.step, self.state, self.field, metadata, keep)

    def restore(self) -> bool:
        """Loads the newest checkpoint, if there is one, and returns whether there was."""
        by_first(lambda: checkpoint.tidy(self.checkpoints, self.settings.loop.keep_checkpoints))
        steps = checkpoint.checkpoint_steps(self.checkpoints)
        by_first(lambda: curves.forget_after(self.folder / "metrics.jsonl", steps[-1] if steps else -1))
        if not steps:
            return False
        saved = checkpoint.read(self.checkpoints, steps[-1])
        if saved.metadata.get("data", self.checksum) != self.checksum:
            raise UserError(f"the data of {self.folder} are not those that it was trained on; put them back, or train again")
        self.field = type(self.field).from_arrays(jax.tree.map(jnp.asarray, saved.field), self.settings.field)
        params = checkpoint.fill(saved, self.field.init, self.key, prefix=".params")
        like = jax.eval_shape(lambda params: init_state(params, self.optimizer, self.controls), params)
        self.state = checkpoint.fill_like(saved, like)
        self.seconds = float(saved.metadata["seconds"])
        if saved.metadata["limits"]:
            self.limits = type(self.limits)(**saved.metadata["limits"])
        self.__dict__.pop("cache", None)
        return True


def _shapes(tree: Any) -> list[tuple[int, ...]]:
    return [np.shape(leaf) for leaf in jax.tree.leaves(tree)]


def train(
    dataset: Dataset, field: str, settings: Settings, seed: int, folder: Path, resume: bool = False, devices: int = 0
) -> TrainResult:
    """Trains a field, by its name, and leaves checkpoints and curves in `folder`.

    Every batch is shared by so many devices of every process, evenly; by default by all that can. Where there are several
    processes (`jax.distributed`), all of them call this, and the first one writes.

    Raises:
        UserError: a loss or gradient that is not finite (step, batch and last good checkpoint named), an unwritable folder,
            no training spectra.
        Interrupted: Ctrl-C; the state is saved.
        KeyboardInterrupt: Ctrl-C in the last epoch; the state is saved, and nothing is left to train.
    """
    check_data(dataset, get_field(field))
    settings = limit_steps(settings, len(dataset.train))
    run = Run(dataset, field, settings, seed, folder, devices)
    resumed = resume and run.restore()
    check_alike((run.state, run.field), "what training begins with")
    total = settings.optim.steps
    with deferred_interrupt() as interrupt, TrainingProgress(total, run.step, is_first()) as progress:
        if not resumed:
            _begin(run, progress, interrupt)
        while run.step < total:
            _advance(run, total, progress, interrupt)
    return TrainResult(run.field, run.state.params, run.step, run.seconds, run.compilations)


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
    """Runs an epoch and all that is due after it."""
    before, loop = run.step, run.settings.loop
    figures = run.epoch()
    interrupted = any_process(interrupt["set"])
    run.control()
    if run.step == total:
        run.calibrate()
    entry: dict[str, Any] = {"step": run.step} | {name: None if np.isnan(v) else v for name, v in figures.items()}
    entry |= run.field.sizes(run.state.params) | {"seconds": run.seconds}
    if len(run.watched) and (_crosses(before, run.step, loop.evaluate_every) or run.step == total):
        entry |= run.evaluate()
    run.log(entry)
    progress.update(entry)
    if _crosses(before, run.step, loop.checkpoint_every) or run.step == total or interrupted:
        run.save()
    if interrupted and run.step < total:
        raise Interrupted(
            f"stopped at step {run.step} of {total}; the state is saved: run the same command with --resume to go on"
        )


def _crosses(before: int, after: int, interval: int) -> bool:
    return before // interval != after // interval
