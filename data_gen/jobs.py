"""The long part of a generation, cut into chunks that survive an interruption.

A chunk is one batch of transmitters at one frequency, or the ceilings of one frequency. Its result is a file in a work folder,
written whole or not at all; the folder's name contains a checksum of everything that decides a result, so a run finds what an
earlier one with the same settings left, and never anything else. Chunks are independent: their order, the number of processes
and interruptions do not change a bit.
"""

import concurrent.futures
import hashlib
import importlib.metadata
import json
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from data_gen.llvm import find_backend, use_backend
from data_gen.scenes.base import SceneSpec
from data_gen.settings import SolverSettings
from wbgs_jax.errors import UserError
from wbgs_jax.files import atomic_write, read_json, write_json

if TYPE_CHECKING:
    from data_gen.solve import Simulator

PACKAGES = ("sionna-rt", "mitsuba", "drjit", "numpy")
"""Packages whose version may change a result."""


@dataclass(frozen=True)
class Job:
    """Everything that decides the snapshots."""

    spec: SceneSpec
    settings: SolverSettings
    tx_positions: Float[np.ndarray, "tx 3"]
    """World frame, metres."""
    ceiling_tx: tuple[int, ...] = ()
    """Which transmitters the ceilings are measured on."""

    def batch(self, index: int) -> Float[np.ndarray, "batch 3"]:
        """Transmitter positions of one batch."""
        size = self.settings.tx_per_call
        return self.tx_positions[index * size : (index + 1) * size]

    @property
    def n_batches(self) -> int:
        """Number of batches."""
        return -(-len(self.tx_positions) // self.settings.tx_per_call)

    def digest(self, backend: str) -> str:
        """Checksum of the scene, the transmitters, the settings and the versions; frequencies are in the chunks' names."""
        decides = {
            "mesh": self.spec.mesh_sha256(), "rx": self.spec.rx_position, "settings": asdict(self.settings),
            "tx": self.tx_positions.tolist(), "ceiling_tx": self.ceiling_tx, "versions": versions(), "backend": backend,
        }  # fmt: skip
        return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Chunk:
    """One piece of work: a batch of transmitters at a frequency, or (batch None) the ceilings at a frequency."""

    frequency_hz: float
    batch: int | None

    def file(self, folder: Path) -> Path:
        """Where its result lies."""
        name = "ceilings.json" if self.batch is None else f"{self.batch:04d}.npz"
        return folder / f"{self.frequency_hz / 1e9:.9g}GHz" / name


def versions() -> dict[str, str]:
    """Versions of the packages that may change a result."""
    return {name: importlib.metadata.version(name) for name in PACKAGES}


def chunks(job: Job, frequencies_hz: tuple[float, ...]) -> list[Chunk]:
    """All chunks, frequency by frequency because a new frequency recompiles."""
    batches: list[int | None] = [*range(job.n_batches), *([None] if job.ceiling_tx else [])]
    return [Chunk(f, b) for f in frequencies_hz for b in batches]


def run(job: Job, todo: list[Chunk], folder: Path, workers: int, threads: int | None) -> Iterator[Chunk]:
    """Compute chunks in `workers` processes with `threads` threads each, and yield every one when its file is written."""
    backend = find_backend()
    if workers == 1:
        _start(job, backend, threads)
        yield from (_work(chunk, folder) for chunk in todo)
        return
    context = multiprocessing.get_context("spawn")  # Dr.Jit and JAX have threads: a fork could hang
    with concurrent.futures.ProcessPoolExecutor(workers, context, _start_worker, (job, backend, threads)) as pool:
        waiting = [pool.submit(_work, chunk, folder) for chunk in todo]
        try:
            for future in concurrent.futures.as_completed(waiting):
                yield future.result()
        except BrokenProcessPool as error:
            raise UserError("a worker was killed, out of memory perhaps; the same command goes on from there") from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


_simulator: "Simulator"
_job: Job


def _start(job: Job, backend: tuple[str, str], threads: int | None) -> None:
    global _simulator, _job
    use_backend(backend)
    import drjit as dr  # only now is it safe

    from data_gen.solve import Simulator

    if threads is not None:
        dr.set_thread_count(threads)
    _simulator, _job = Simulator(job.spec, job.settings), job


def _start_worker(job: Job, backend: tuple[str, str], threads: int | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which lets chunks in progress finish
    _start(job, backend, threads)


def _work(chunk: Chunk, folder: Path) -> Chunk:
    file = chunk.file(folder)
    read_back = _simulator.set_frequency(chunk.frequency_hz)
    if chunk.batch is None:
        from data_gen.ceilings import measure

        write_json(file, measure(_simulator, _job.tx_positions[list(_job.ceiling_tx)]))
        return chunk
    paths = _simulator.paths(_job.batch(chunk.batch))
    snapshots = np.stack([p.snapshot() for p in paths])
    with atomic_write(file) as stream:
        np.savez(stream, snapshots=snapshots, n_paths=[len(p.delays) for p in paths], frequency_hz=read_back)
    return chunk


def collect(job: Job, frequencies_hz: tuple[float, ...], folder: Path) -> dict[str, Any]:
    """Put the finished chunks together.

    Returns:
        snapshots (tx, freq, elements) complex64, n_paths (tx, freq) int64, read_back_hz and ceilings (one entry a frequency).
    """
    results = [[_load(Chunk(f, b).file(folder)) for b in range(job.n_batches)] for f in frequencies_hz]
    stack: Callable[[str], np.ndarray] = lambda key: np.stack([np.concatenate([r[key] for r in row]) for row in results], 1)  # noqa: E731
    ceilings = [read_json(Chunk(f, None).file(folder)) for f in frequencies_hz] if job.ceiling_tx else []
    read_back = [float(row[0]["frequency_hz"]) for row in results]
    return {"snapshots": stack("snapshots"), "n_paths": stack("n_paths"), "read_back_hz": read_back, "ceilings": ceilings}


def _load(file: Path) -> dict[str, np.ndarray]:
    with np.load(file, allow_pickle=False) as archive:
        return dict(archive)
