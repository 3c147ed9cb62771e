"""The host loop of training: jitted epochs, hooks between them, checkpoints, curves, and resuming a run.

`train` builds a `Run` and repeats `Run.epoch` until the last step. A run holds the state and uses a field through its interface
only (`fields.base.Field`).

The epoch for the next size of a field is compiled while the device trains the current size (`Precompilation`): the sizes of a
growing field are predictable. A call that runs no step compiles the program for the next size; if the program is needed before
it is ready, the loop waits for it.
"""

import dataclasses
import time
import warnings
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from wbgs_jax._util.compilation import give_back
from wbgs_jax._util.devices import any_process, by_first, check_alike, devices_for, is_first
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.progress_lines import Pulse
from wbgs_jax.config import Settings
from wbgs_jax.data.dataset import Dataset, check_checksum, checksum, training_links, without_test
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.evaluation.score import watch
from wbgs_jax.fields import Field, get_field
from wbgs_jax.fields.base import Params, field_from_arrays
from wbgs_jax.training import checkpoint, curves
from wbgs_jax.training.batches import check_data, data_with_virtual, limited, with_virtual_drawn
from wbgs_jax.training.calibration.pipeline import Calibration
from wbgs_jax.training.density import DensityControl
from wbgs_jax.training.hooks import Context, Edit, ExpertWeights, Hook, OfPart, Say, map_moments, silent
from wbgs_jax.training.progress import Interrupted, TrainingProgress, deferred_interrupt
from wbgs_jax.training.step import EpochReport, TrainState, init_state, make_optimizer, run_epoch
from wbgs_jax.types import Batch


class Precompilation:
    """Programs that background threads compile, each once."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(2)
        self._calls: dict[Hashable, Future[None]] = {}
        self.seconds = 0.0
        """Compilation time of the programs that are ready."""

    def begin(self, key: Hashable, call: Callable[[], object]) -> None:
        """Starts a call that compiles the programs with this key, unless it has been started before."""
        if key not in self._calls:
            self._calls[key] = self._threads.submit(self._run, call)

    def wait(self, key: Hashable) -> bool:
        """Waits for a call, and returns whether its programs are ready."""
        return key in self._calls and self._calls[key].exception() is None

    def __enter__(self) -> "Precompilation":
        return self

    def __exit__(self, *exception: object) -> None:
        """Drops calls that have not begun: the process would make them before it ends."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    def _run(self, call: Callable[[], object]) -> None:
        begin = time.perf_counter()
        call()
        self.seconds += time.perf_counter() - begin


HOOKS: dict[str, Callable[[Any], Hook]] = {
    "density": DensityControl,
    "calibration": Calibration,
    "expert_weights": lambda _: ExpertWeights(),
}
"""Constructors of hooks from their section of the settings, by their names in fields and settings."""
VALIDATION_LINKS, BLOCK, FEW_BLOCKS = 720, 16, 8
"""Maximum number of validation links for hooks, and their number per batch. Of more batches than the third number, a shorter
last one is left out: it would need a program of its own."""


def make_hook(name: str, settings: Settings) -> Hook | None:
    """Returns the hook of a name in `Field.hooks`; None if its section of the settings disables it."""
    part, _, kind = name.rpartition(".")
    config = getattr(settings, kind, True)
    if not config:
        return None
    hook = HOOKS[kind](config)
    return OfPart(part, hook) if part else hook


@dataclass(frozen=True)
class Launched:
    """An epoch that has been dispatched to the device."""

    step: int
    """Step at which it begins."""
    batches: Int[np.ndarray, "k b"]
    """Indices of the links of every batch."""
    report: EpochReport
    """Results, which may still be pending on the device."""


class Run:
    """A training run in a folder. It holds all mutable state; pure functions are in step.py."""

    def __init__(self, dataset: Dataset, field: str, settings: Settings, seed: int, folder: Path, devices: int = 0):
        self.numbers = training_links(dataset)  # indices of the links in the whole dataset
        self.checksum = checksum(dataset)
        dataset = without_test(dataset)  # training has no access to the test part
        self.dataset, self.settings, self.seed, self.folder = dataset, settings, seed, folder
        kind, self.key = get_field(field), jax.random.key(seed)
        self.hooks = tuple(hook for name in kind.hooks if (hook := make_hook(name, settings)))
        self.optimizer = make_optimizer(kind, settings.field, settings.optim)
        self.checkpoints = folder / "checkpoints"
        self.seconds, self.compilations, self.compile_seconds = 0.0, 1, 0.0
        self.launched: list[Launched] = []
        self.precompilation = Precompilation()
        self._known: set[Any] = set()  # programs that have run
        self.field = kind.build(settings.field, DatasetScene(dataset), seed)
        self.state = init_state(self.field.init(self.key), self.optimizer, self.hooks)
        self.capacity = self.field.capacity(self.state.params, dataset.receivers)
        self.data, self.virtual = data_with_virtual(dataset, kind, seed if settings.optim.virtual else None)
        rng = np.random.default_rng([seed, 1])
        watched = min(settings.loop.evaluate_spectra, len(dataset.validation))
        self.watched = np.sort(rng.choice(dataset.validation, watched, replace=False))
        self.devices, idle = devices_for(self.batch, devices)
        if idle and is_first():
            warnings.warn(idle, stacklevel=2)

    @cached_property
    def prepared(self) -> Any:
        """Result of the field's `prepare` for all links, computed at first use: a checkpoint may contain another field."""
        return self.field.prepare(self.data.links, self.data.receivers)

    @property
    def batch(self) -> int:
        """Links per step."""
        return min(self.settings.optim.batch, len(self.dataset.train))

    @property
    def step(self) -> int:
        """Number of steps whose results have been read."""
        return self.launched[0].step if self.launched else int(self.state.step)

    @cached_property
    def sizes(self) -> dict[str, int]:
        """Sizes of the field, which only hooks change."""
        return self.field.inspect(self.state.params).sizes

    def batches(self, epoch: int, steps: int) -> Int[np.ndarray, "k b"]:
        """Returns the batches of an epoch of `steps` steps, each of one receiver. They depend on the seed and the epoch only,
        so that a resumed run uses the same batches."""
        rng = np.random.default_rng([self.seed, 2, epoch])
        pool = self.pool(epoch * steps / self.settings.optim.steps)
        return np.stack([self._draw(rng, pool, self.batch) for _ in range(steps)]).astype(np.int32)

    def _draw(self, rng: np.random.Generator, pool: Int[np.ndarray, " n"], batch: int) -> Int[np.ndarray, " b"]:
        if self.dataset.n_receivers > 1:  # receivers are drawn in proportion to their links
            of_receiver = self.dataset.receiver_index[pool]
            pool = pool[of_receiver == rng.choice(of_receiver)]
        drawn = rng.choice(pool, batch, replace=len(pool) < batch)
        virtual = self.virtual[self.dataset.receiver_index[drawn[0]]]
        return with_virtual_drawn(drawn, virtual, self.settings.optim.virtual, rng)

    def pool(self, progress: float) -> Int[np.ndarray, " n"]:
        """Returns the training links that batches are drawn from after a fraction `progress` of the steps; with a curriculum,
        low frequencies come first."""
        train, curriculum = self.dataset.train, self.settings.optim.curriculum
        frequencies = self.dataset.frequencies_hz[train]
        if progress >= curriculum:
            return train
        low, high = frequencies.min(), frequencies.max()
        return train[frequencies <= low * (high / low) ** (progress / curriculum) * (1 + 1e-6)]

    def epoch(self, go_on: bool = False) -> dict[str, float]:
        """Runs one epoch and returns means of the loss and of the metrics. Overflowed steps are repeated with larger capacity.

        `go_on` dispatches the next epoch to the device before the results of this one are read; nothing may be due in between.
        """
        begin, length = time.perf_counter(), self.settings.loop.epoch_steps
        resized = not self._known
        if not self.launched:
            _ = self.sizes  # before the device is busy: later they would wait for it
            self._launch(self.step)
        if go_on:
            self._launch(self.launched[-1].step + length)
        done, figures = 0, dict[str, list[float]]()
        while done < length:
            report = self.launched[0].report
            ran = slice(done, done + int(report.good_steps))
            for name, values in ({"loss": report.loss} | report.metrics).items():
                figures.setdefault(name, []).extend(np.asarray(values)[ran].tolist())
            done = ran.stop
            if report.stopped:
                given, self.launched, resized = self.launched, [], True
                self._recover(report, given[0].batches[done])
                for old in given:  # epochs after the first have run no steps
                    self._launch(old.step, done if old is given[0] else 0)
        self.launched.pop(0)
        if resized:
            self._compile_next()
        self.seconds += time.perf_counter() - begin
        return {name: float(np.mean(values)) for name, values in figures.items()}

    def _launch(self, step: int, first: int = 0) -> None:
        """Dispatches the epoch that begins at a step to the device, starting with batch number `first`."""
        length, program, prepared = (
            self.settings.loop.epoch_steps,
            self._program(self.state.params, self.capacity),
            self.prepared,
        )
        batches = self.batches(step // length, length)
        stopped = self.launched[-1].report.stopped if self.launched else jnp.zeros((), bool)
        ready, begin = self.precompilation.wait(program), time.perf_counter()
        self.state, report = self._run_epoch(self.state, prepared, batches, first, self.capacity, stopped)
        self.launched.append(Launched(step, batches, report))
        if not ready and program not in self._known:
            self.compile_seconds += time.perf_counter() - begin  # the call returns before the first step has run
        self._known.add(program)

    def _run_epoch(
        self, state: TrainState, prepared: Any, batches: Any, first: int, capacity: Any, stopped: Any
    ) -> tuple[TrainState, EpochReport]:
        given = state, (jnp.asarray(batches), jnp.asarray(first, jnp.int32), self.key), stopped
        state, rest, stopped = self.devices.replicated(given)
        results = run_epoch(
            state,
            *self.devices.kept(self.field, prepared, self.data),
            *rest,
            optimizer=self.optimizer,
            hooks=self.hooks,
            capacity=capacity,
            mesh=self.devices.mesh,
            stopped=stopped,
            branches=jax.default_backend() == "cpu",
        )
        return self.devices.own(results)

    def _program(self, params: Params, capacity: Any) -> Any:
        """Returns a key that distinguishes the compiled epochs of a run."""
        return capacity, tuple(_shapes(params)), jax.tree.structure(self.field)

    def _compile_next(self) -> None:
        """Starts compiling the epoch for the next size of the field if a change is near."""
        for hook in self.hooks:
            found = hook.next_size(self.state.params, self.step, self.settings.optim.steps)
            if found is not None:
                self._compile_ahead(found[0], self._grown(found[1]))

    def _compile_ahead(self, params: Params, capacity: Any) -> None:
        """Starts compiling the epoch for parameters of these shapes; only with one process and device."""
        if self.devices.mesh is not None or jax.process_count() > 1:
            return
        prepared, shapes = self.prepared, jax.eval_shape(lambda one: init_state(one, self.optimizer, self.hooks), params)
        batches = np.zeros((self.settings.loop.epoch_steps, self.batch), np.int32)

        def call() -> None:
            state = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
            self._run_epoch(state, prepared, batches, len(batches), capacity, jnp.zeros((), bool))

        self.precompilation.begin(self._program(params, capacity), call)

    def _grown(self, growth: float) -> Any:
        """Returns the capacity of the field after it has grown by a factor. It depends only on the capacity stored in
        checkpoints."""
        return self.capacity if self.capacity is None or growth == 1 else self.capacity.scaled(growth)

    def _recover(self, report: EpochReport, batch: Int[np.ndarray, " b"]) -> None:
        """Increases the capacity after an overflow.

        Raises:
            UserError: the epoch has stopped for the only other reason, a loss or gradient that is not finite.
        """
        if report.overflow:
            if self.capacity is None:
                raise NotImplementedError(
                    f"`loss` of the {self.field.name} field reports an overflow, but it has no `capacity`"
                )
            needed = self.field.capacity(self.state.params, self.dataset.receivers, np.asarray(report.required))
            self.capacity = self.capacity.grown_to(needed)
            self.compilations += 1
            return
        saved = checkpoint.checkpoint_steps(self.checkpoints)
        last = f"the last good checkpoint is {self.checkpoints / str(saved[-1])}" if saved else "there is no checkpoint yet"
        spectra = self.numbers[np.unique(batch[batch < len(self.numbers)])].tolist()
        raise UserError(
            f"the loss of step {self.step} or its gradient is not finite; {last}. Check spectra {spectra}, counted from 0, or "
            "start again with smaller learning rates"
        )

    def run_hooks(self, say: Say = silent) -> bool:
        """Runs all hooks that are due, and returns whether there were any; `say` is called with the stages of long work."""
        acted = False
        for number, hook in enumerate(self.hooks):
            if hook.due(self.step, self.settings.optim.steps):
                if not self._known:  # most hooks that act before the first epoch change no shape that it depends on
                    self._compile_ahead(self.state.params, self.capacity)
                begin, step = time.perf_counter(), self.step
                rng = np.random.default_rng([self.seed, hook.stream, step])
                context = Context(self.data, self.prepared, self.dataset.train, say, self.validation_batches)
                edit = hook.apply(self.field, self.state.params, self.state.statistics[number], context, step, rng)
                self._commit(number, edit)
                check_alike(self.state, f"the parameters after {type(hook).__name__}")
                self.seconds += time.perf_counter() - begin
                if edit.report:
                    self.log({"step": step} | edit.report)
                acted = True
        if acted:
            give_back()
            self._compile_next()
        return acted

    def due(self, step: int) -> bool:
        """Returns whether anything is due after a step: hooks, an evaluation, a checkpoint, or the end."""
        loop, total = self.settings.loop, self.settings.optim.steps
        before, shown = step - loop.epoch_steps, len(self.watched) > 0
        return (
            step >= total
            or any(hook.due(step, total) for hook in self.hooks)
            or (shown and crosses(before, step, loop.evaluate_every))
            or crosses(before, step, loop.checkpoint_every)
        )

    def _commit(self, number: int, edit: Edit) -> None:
        """Applies a hook's edit to the state, including the optimiser's moments."""
        old, statistics = self.state, list(self.state.statistics)
        self.__dict__.pop("sizes", None)
        if _shapes(edit.params) != _shapes(old.params):
            self.compilations += 1
            self.capacity = self._grown(edit.growth)
            statistics = [hook.statistics(edit.params) for hook in self.hooks]  # those of other hooks have the old shapes
        follow = edit.moments
        moments = map_moments(old.optimizer, old.params, follow) if follow else self.optimizer.init(edit.params)
        statistics[number] = edit.statistics
        self.state = TrainState(edit.params, moments, tuple(statistics), old.step)
        if edit.field is not None:
            self.field, self.prepared = edit.field, edit.prepared

    def validation_batches(self) -> list[Batch]:
        """Returns batches of validation links, each of one receiver."""
        chosen = np.random.default_rng([self.seed, 4]).permutation(self.dataset.validation)[:VALIDATION_LINKS]
        receiver = self.dataset.receiver_index[chosen]
        blocks = list[Int[np.ndarray, " b"]]()
        for number in np.unique(receiver):
            own = chosen[receiver == number]
            if len(own) >= FEW_BLOCKS * BLOCK:
                own = own[: len(own) // BLOCK * BLOCK]
            blocks += np.split(own, range(BLOCK, len(own), BLOCK))
        return [self.data.batch(jnp.asarray(block, jnp.int32), self.key) for block in blocks]

    def evaluate(self) -> dict[str, float]:
        """Returns the metrics of the validation spectra that are evaluated during training."""
        return watch(self.field, self.state.params, self.dataset, self.watched)

    def log(self, entry: dict[str, Any]) -> None:
        """Appends a line to metrics.jsonl."""
        if is_first():
            curves.append(self.folder / "metrics.jsonl", entry)

    def save(self) -> None:
        """Writes a checkpoint of the current step."""
        capacity = dataclasses.asdict(self.capacity) if self.capacity else None
        compiled = {"compilations": self.compilations, "compile_seconds": self.compile_seconds + self.precompilation.seconds}
        metadata = {"limits": capacity, "seconds": self.seconds, "data": self.checksum} | compiled
        keep = self.settings.loop.keep_checkpoints
        check_alike(self.state, f"the state of step {self.step}")
        checkpoint.save(self.checkpoints, self.step, self.state, self.field, metadata, keep)

    def restore(self) -> bool:
        """Loads the newest checkpoint, and returns whether there was one.

        Raises:
            UserError: the checkpoint is damaged, or belongs to other data or another configuration.
        """
        by_first(lambda: checkpoint.tidy(self.checkpoints, self.settings.loop.keep_checkpoints))
        steps = checkpoint.checkpoint_steps(self.checkpoints)
        by_first(lambda: curves.forget_after(self.folder / "metrics.jsonl", steps[-1] if steps else -1))
        if not steps:
            return False
        saved = checkpoint.read(self.checkpoints, steps[-1])
        check_checksum(self.checksum, saved.metadata.get("data", self.checksum), str(self.folder))
        self.field = field_from_arrays(type(self.field), jax.tree.map(jnp.asarray, saved.field), self.settings.field)
        params = checkpoint.fill(saved, self.field.init, self.key, prefix=".params")
        like = jax.eval_shape(lambda params: init_state(params, self.optimizer, self.hooks), params)
        self.state = checkpoint.fill_like(saved, like)
        self.seconds = float(saved.metadata["seconds"])
        if saved.metadata["limits"]:
            self.capacity = type(self.capacity)(**saved.metadata["limits"])
        for derived in ("prepared", "sizes"):
            self.__dict__.pop(derived, None)
        return True


def _shapes(tree: Any) -> list[tuple[int, ...]]:
    return [np.shape(leaf) for leaf in jax.tree.leaves(tree)]


def crosses(before: int, after: int, interval: int) -> bool:
    """Returns whether a multiple of the interval lies between two steps, including the second one."""
    return before // interval != after // interval


__all__ = ["HOOKS", "Interrupted", "Run", "TrainResult", "train"]


@dataclass(frozen=True)
class TrainResult:
    """Result of a training run."""

    field: Field
    params: Params
    steps: int
    seconds: float
    """Wall-clock training time, summed over resumed parts."""
    compilations: int
    """Number of compilations of the jitted epoch for new shapes in this process: at the start, and after every change of a
    capacity or size."""
    compile_seconds: float = 0.0
    """Time of these compilations, including those in the background."""

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes of the trained field."""
        return self.field.inspect(self.params).sizes


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
    """Trains a field and writes checkpoints and curves to a folder. With several processes (`jax.distributed`) all of them call
    this function, and the first one writes.

    Args:
        dataset: data.
        field: name of the field.
        settings: settings.
        seed: seed of all random numbers.
        folder: folder of the run.
        resume: whether to continue from the newest checkpoint.
        devices: number of devices of each process that share every batch evenly; 0 for as many as possible.
        shown: whether progress is printed.

    Raises:
        UserError: the loss or its gradient is not finite (the message names step, spectra and last good checkpoint), the folder
            is not writable, or there are no training spectra.
        Interrupted: Ctrl-C; the state is saved.
        KeyboardInterrupt: Ctrl-C in the last epoch; the state is saved, and training is complete.
    """
    kind = get_field(field)
    check_data(dataset, kind)
    settings = limited(settings, dataset, kind)
    shown = shown and is_first()
    with Pulse(lambda: "preparing the field and its data", shown):
        run = Run(dataset, field, settings, seed, folder, devices)
        resumed = resume and run.restore()
        check_alike((run.state, run.field), "the initial state of training")
    total = settings.optim.steps
    progress = TrainingProgress(total, run.step, shown)
    with deferred_interrupt() as interrupt, run.precompilation, progress:
        if not resumed:
            _begin(run, progress, interrupt)
        while run.step < total:
            _advance(run, total, progress, interrupt)
    compiled = run.compile_seconds + run.precompilation.seconds
    return TrainResult(run.field, run.state.params, run.step, run.seconds, run.compilations, compiled)


def _begin(run: Run, progress: TrainingProgress, interrupt: dict[str, bool]) -> None:
    """Runs hooks that are due before the first step, and saves their result."""

    def say(stage: str) -> None:
        give_back()
        progress.stage(stage)
        if any_process(interrupt["set"]):
            raise Interrupted("stopped before the first step; run the same command with --resume to begin again")

    if run.run_hooks(say):
        run.save()
        progress.stage("compiling; first steps")


def _advance(run: Run, total: int, progress: TrainingProgress, interrupt: dict[str, bool]) -> None:
    """Runs an epoch and all that is due after it; if nothing is due, the next epoch is dispatched before this one ends."""
    before, loop = run.step, run.settings.loop
    after = before + loop.epoch_steps
    stopping = any_process(interrupt["set"])
    figures = run.epoch(go_on=not (stopping or run.due(after)))
    interrupted = any_process(interrupt["set"]) and not run.launched
    run.run_hooks(progress.stage)
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
            f"stopped at step {after} of {total}; the state is saved: run the same command with --resume to continue"
        )
