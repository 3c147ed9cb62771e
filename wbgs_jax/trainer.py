"""The host loop: a search for materials, jitted epochs, density control between them, checkpoints, curves, resume.

A newcomer can read it top to bottom: `train` builds a `Run`, then repeats `Run.epoch` until the last step.
"""

import contextlib
import dataclasses
import json
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from wbgs_jax import checkpoint, density, material_search, metrics
from wbgs_jax.config import Settings, limit_steps
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.surface import make_mesh, make_surface
from wbgs_jax.errors import UserError
from wbgs_jax.fields import Field, get_field
from wbgs_jax.files import atomic_write
from wbgs_jax.inference import predict_spectra, scene_box
from wbgs_jax.optim import make_optimizer
from wbgs_jax.progress import TrainingProgress
from wbgs_jax.splat import Capacity, fit_capacity
from wbgs_jax.train_step import EpochReport, TrainingData, TrainState, gaussian_count, init_state, make_epoch, training_data

TILE_SLACK = 1.4
"""Room in the tile lists for footprints that grow during training."""


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """What a training run leaves."""

    params: Any
    steps: int
    seconds: float
    """Wall-clock training time, summed over resumed parts."""
    gaussians: int
    """Alive at the end."""
    compilations: int
    """Times the jitted epoch was compiled in this process: at the start and whenever a capacity changed."""


class Interrupted(UserError):
    """Ctrl-C: the state is saved, the message says how to go on."""


class Run:
    """One training run in a folder; everything that changes hangs here, everything pure is in train_step.py."""

    def __init__(self, dataset: Dataset, field_name: str, settings: Settings, seed: int, folder: Path):
        self.dataset, self.field_name, self.settings, self.seed, self.folder = dataset, field_name, settings, seed, folder
        self.field: Field = get_field(field_name)
        self.optimizer = make_optimizer(settings.optim)
        self.checkpoints = folder / "checkpoints"
        self.seconds = 0.0
        self.compilations = 0
        self.state, self.capacity = self._start()
        self.data = self._remember()
        self._build()
        rng = np.random.default_rng([seed, 1])
        count = min(settings.loop.evaluate_spectra, len(dataset.test))
        self.watched = np.sort(rng.choice(dataset.test, count, replace=False))

    def _start(self) -> tuple[TrainState, Capacity | None]:
        config, key = getattr(self.settings, self.field_name), jax.random.key(self.seed)
        if self.field.STARTS_FROM == "mesh":
            return init_state(self.field.init(key, make_mesh(self.dataset), config), self.optimizer), None
        if self.field.STARTS_FROM == "box":
            return init_state(
                self.field.init(key, jnp.asarray(scene_box(self.dataset), jnp.float32), config), self.optimizer
            ), None
        surface = make_surface(self.dataset, config.gaussians, self.seed, config.sampling)
        params = self.field.init(key, surface, config, density.capacity_bucket(len(surface.points)))
        jobs = self.field.plan(params, self.dataset.receiver).geometry.jobs
        return init_state(params, self.optimizer), fit_capacity(int(jobs.required_entries), int(jobs.required_jobs), TILE_SLACK)

    def _remember(self) -> TrainingData:
        """The data on the device, with what the field can compute of the transmitters once."""
        data = training_data(self.dataset)
        _, first = np.unique(self.dataset.tx_index, return_index=True)
        positions = jnp.asarray(self.dataset.tx_positions[first], jnp.float32)
        return dataclasses.replace(data, memory=self.field.remember(self.state.params, self.dataset.receiver, positions))

    def _build(self) -> None:
        """(Re)make the jitted epoch for the present tile capacity."""
        self.run_epoch = make_epoch(self.field, self.optimizer, self.capacity, self.settings.optim)
        self.compilations += 1

    @property
    def step(self) -> int:
        """Steps done."""
        return int(self.state.step)

    @property
    def alive(self) -> int:
        """Living Gaussians; 0 for a field without them."""
        if not gaussian_count(self.state.params):
            return 0
        return int(np.asarray(self.state.params.gaussians.alive).sum())

    def batches(self, epoch: int, steps: int) -> Int[np.ndarray, "k b"]:
        """The batches of an epoch: a function of seed and epoch alone, so that a resumed run sees the same ones."""
        rng = np.random.default_rng([self.seed, 2, epoch])
        pool = self.pool(epoch * steps / self.settings.optim.steps)
        batch = min(self.settings.optim.batch, len(self.dataset.train))
        return np.stack([rng.choice(pool, batch, replace=len(pool) < batch) for _ in range(steps)]).astype(np.int32)

    def pool(self, progress: float) -> Int[np.ndarray, "n"]:
        """The training spectra that batches are drawn from after this share of the steps: low frequencies first, if asked."""
        train, curriculum = self.dataset.train, self.settings.optim.curriculum
        frequencies = self.dataset.frequencies_hz[train]
        if progress >= curriculum:
            return train
        low, high = frequencies.min(), frequencies.max()
        return train[frequencies <= low * (high / low) ** (progress / curriculum) * (1 + 1e-6)]

    def epoch(self) -> tuple[float, float]:
        """Run one block of steps; returns mean loss and SSIM. Overflowed steps are repeated with a larger capacity."""
        begin = time.perf_counter()
        length = self.settings.loop.epoch_steps
        batches = self.batches(self.step // length, length)
        done, losses, ssims = 0, [], []
        while done < length:
            self.state, report = self.run_epoch(self.state, self.data, jnp.asarray(batches), jnp.asarray(done, jnp.int32))
            ran = slice(done, done + int(report.good_steps))
            losses += np.asarray(report.loss)[ran].tolist()
            ssims += np.asarray(report.ssim)[ran].tolist()
            done = ran.stop
            if report.stopped:
                self._recover(report, batches[done])
        self.seconds += time.perf_counter() - begin
        return float(np.mean(losses)), float(np.mean(ssims))

    def _recover(self, report: EpochReport, batch: Int[np.ndarray, "b"]) -> None:
        """Grow the tile lists after an overflow; anything else that stops an epoch is a loss or gradient that is not finite."""
        if report.overflow:
            entries, jobs = (int(n) for n in report.required)
            grown = fit_capacity(entries, jobs, TILE_SLACK)
            assert self.capacity is not None, "only splats overflow"
            self.capacity = Capacity(max(grown.entries, self.capacity.entries), max(grown.jobs, self.capacity.jobs))
            self._build()
            return
        saved = checkpoint.checkpoint_steps(self.checkpoints)
        last = f"the last good checkpoint is {self.checkpoints / str(saved[-1])}" if saved else "there is no checkpoint yet"
        raise UserError(
            f"the loss of step {self.step} or its gradient is not finite (spectra {batch.tolist()}); {last}. "
            "Check these spectra, or start again with smaller learning rates"
        )

    def control(self) -> None:
        """Density control where the schedule asks for it."""
        config, step = self.settings.density, self.step
        if (
            not gaussian_count(self.state.params)
            or not config.every
            or step < config.start
            or step > config.stop_fraction * self.settings.optim.steps
        ):
            return
        if step % config.every == 0:
            before = self.state.params.gaussians.means.shape
            rng = np.random.default_rng([self.seed, 3, step])
            self.state, report = density.control_density(self.state, config, rng)
            self.log({"step": step, "density": dataclasses.asdict(report)})
            if self.state.params.gaussians.means.shape != before:
                self.compilations += 1
        if config.reset_every and step % config.reset_every == 0:
            self.state = density.reset_attenuation(self.state, config)

    def search(self) -> None:
        """Before the first step: known materials that fit, for a field that has materials."""
        config = self.settings.search
        if self.step or not config.rounds or not hasattr(self.state.params, "materials"):
            return
        begin = time.perf_counter()
        rng = np.random.default_rng([self.seed, 6])
        chosen = rng.choice(self.dataset.train, min(config.spectra, len(self.dataset.train)), replace=False)
        params, report = material_search.search_materials(self.field, self.state.params, self.data, chosen, config)
        self.state = init_state(params, self.optimizer)
        self.seconds += time.perf_counter() - begin
        self.log({"step": 0, "search": dataclasses.asdict(report)})

    def evaluate(self) -> float:
        """Median SSIM (skimage) on the watched held-out spectra."""
        predicted = predict_spectra(self.field, self.state.params, self.dataset, self.watched)
        return float(np.median(metrics.ssim(predicted, np.asarray(self.dataset.pas(self.watched)))))

    def log(self, entry: dict[str, Any]) -> None:
        """Append a line to metrics.jsonl."""
        path = self.folder / "metrics.jsonl"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with path.open("a") as stream:
                stream.write(json.dumps(entry) + "\n")
        except OSError as error:
            raise UserError(f"cannot write {path}: {error.strerror}; free some space or choose another OUT") from error

    def save(self) -> None:
        """Write a checkpoint of the present step."""
        metadata = {
            "sizes": self.field.sizes(self.state.params),
            "tile_capacity": dataclasses.asdict(self.capacity) if self.capacity else None,
            "seconds": self.seconds,
        }
        checkpoint.save(self.checkpoints, self.step, self.state, metadata, self.settings.loop.keep_checkpoints)

    def restore(self) -> bool:
        """Load the newest checkpoint, if there is one."""
        steps = checkpoint.checkpoint_steps(self.checkpoints)
        _forget_later_metrics(self.folder / "metrics.jsonl", steps[-1] if steps else -1)
        if not steps:
            return False
        metadata = checkpoint.load_metadata(self.checkpoints, steps[-1])
        params = self.field.skeleton(getattr(self.settings, self.field_name), metadata["sizes"])
        like = jax.eval_shape(lambda params: init_state(params, self.optimizer), params)
        self.state = checkpoint.load(self.checkpoints, steps[-1], like)
        self.seconds = float(metadata["seconds"])
        if metadata["tile_capacity"]:
            self.capacity = Capacity(**metadata["tile_capacity"])
        self._build()
        self.compilations = 1
        return True


def _forget_later_metrics(path: Path, step: int) -> None:
    """Drop curve entries after the checkpoint a run resumes from (those steps are done again), and a line cut short."""
    if path.exists():
        kept = []
        for line in path.read_text().splitlines():
            with contextlib.suppress(ValueError):
                kept += [line] * (json.loads(line)["step"] <= step)
        with atomic_write(path) as stream:
            stream.write("".join(line + "\n" for line in kept).encode())


@contextlib.contextmanager
def _deferred_interrupt() -> Iterator[dict[str, bool]]:
    """Turn the first Ctrl-C into a flag that is looked at between epochs; a second one interrupts at once. One that comes too
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


def train(dataset: Dataset, field_name: str, settings: Settings, seed: int, folder: Path, resume: bool = False) -> TrainResult:
    """Train a field and leave checkpoints and curves in `folder`.

    Raises:
        UserError: a loss or gradient that is not finite (step, batch and last good checkpoint named), an unwritable folder,
            no training spectra.
        Interrupted: Ctrl-C; the state is saved.
        KeyboardInterrupt: Ctrl-C in the last epoch; the state is saved, and nothing is left to train.
    """
    if len(dataset.train) == 0:
        raise UserError(f"{dataset.name} has no training spectra; choose another split")
    settings = limit_steps(settings, len(dataset.train))
    run = Run(dataset, field_name, settings, seed, folder)
    if resume:
        run.restore()
    loop, total = settings.loop, settings.optim.steps
    with _deferred_interrupt() as interrupt, TrainingProgress(total, run.step) as progress:
        run.search()
        while run.step < total:
            before = run.step
            loss, ssim = run.epoch()
            run.control()
            entry: dict[str, Any] = {
                "step": run.step,
                "loss": loss,
                "batch_ssim": None if np.isnan(ssim) else ssim,
                "gaussians": run.alive,
                "seconds": run.seconds,
            }
            if len(run.watched) and (_crosses(before, run.step, loop.evaluate_every) or run.step == total):
                entry["held_out_ssim"] = run.evaluate()
            run.log(entry)
            progress.update(**entry)
            if _crosses(before, run.step, loop.checkpoint_every) or run.step == total or interrupt["set"]:
                run.save()
            if interrupt["set"] and run.step < total:
                raise Interrupted(
                    f"stopped at step {run.step} of {total}; the state is saved: run the same command with --resume to go on"
                )
    return TrainResult(run.state.params, run.step, run.seconds, run.alive, run.compilations)


def _crosses(before: int, after: int, interval: int) -> bool:
    return before // interval != after // interval
