"""The long-running part of a generation, divided into batches that survive interruptions.

A batch is a group of transmitters at all frequencies. Its result is a file in a work folder, written atomically. The folder's
name contains a checksum of everything that determines a result, so that a run finds exactly the results of earlier runs with
the same settings. Batches are independent: results do not depend, bit for bit, on their order, the number of processes, or
interruptions.
"""

import hashlib
import importlib.metadata
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from data_gen.cluster import LOCAL, connected, finished
from data_gen.llvm import find_backend, use_backend
from data_gen.scenes.base import SceneSpec
from data_gen.settings import ArraySettings, SolverSettings
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, read_arrays

if TYPE_CHECKING:
    from data_gen.solve import Simulator, TxPaths

SILENT = 64
"""Number of transmitters of which at least one has a path, unless there is an error in the scene."""
PACKAGES = ("sionna-rt", "mitsuba", "drjit", "numpy")
"""Packages whose versions may affect results."""

Results = dict[str, np.ndarray]
"""Arrays by name, with transmitters along the first axis: `snapshots` (tx, freq, elements) complex64, `n_paths` (tx, freq),
`line_of_sight` (tx, freq) bool, `delay_spread_s` (tx, freq) and `ceilings` (tx, freq, ceilings), NaN where not measured."""


@dataclass(frozen=True)
class Job:
    """Everything that determines the snapshots."""

    spec: SceneSpec
    settings: SolverSettings
    tx_positions: Float[np.ndarray, "tx 3"]
    """World frame, metres."""
    frequencies_hz: tuple[float, ...]
    array: ArraySettings = field(default_factory=ArraySettings)
    ceiling_tx: tuple[int, ...] = ()
    """Indices of the transmitters for which the ceilings are measured."""

    def batch(self, index: int) -> range:
        """Returns the indices of the transmitters of one batch."""
        size = self.settings.tx_per_call
        return range(index * size, min((index + 1) * size, len(self.tx_positions)))

    @property
    def n_batches(self) -> int:
        """Number of batches."""
        return -(-len(self.tx_positions) // self.settings.tx_per_call)

    def digest(self, backend: str) -> str:
        """Returns a checksum of the scene, the transmitters, the array, the frequencies, the settings and the versions."""
        decides = {
            "mesh": self.spec.mesh_sha256(), "rx": self.spec.rx_position, "orientation": self.spec.rx_orientation,
            "settings": self.settings.record(), "array": asdict(self.array), "frequencies": self.frequencies_hz,
            "tx": self.tx_positions.tolist(), "ceiling_tx": self.ceiling_tx, "versions": versions(), "backend": backend,
        }  # fmt: skip
        return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:16]


def batch_file(folder: Path, batch: int) -> Path:
    """Returns the path of the result of a batch."""
    return folder / f"{batch:04d}.npz"


def versions() -> dict[str, str]:
    """Returns the versions of the packages that may affect results."""
    return {name: importlib.metadata.version(name) for name in PACKAGES}


def run(
    job: Job, todo: list[int], folder: Path, workers: int, threads: int | None, cluster: str | None = None
) -> Iterator[int]:
    """Computes batches in `workers` processes with `threads` threads each, or on the workers of a Dask cluster, and yields
    each one when its file is written. If a worker is killed, its batch is computed by another one.

    Raises:
        UserError: a batch failed.
    """
    backend = find_backend()
    if workers == 1 and cluster is None:
        _start(job, backend, threads)
        yield from (_work(batch, folder) for batch in todo)
        return
    # On other machines the library may be in another place.
    there = backend if cluster in (None, LOCAL) else None
    with connected(cluster or LOCAL, workers) as client:
        for batch, _, error in finished(client, _work_there, todo, job, folder.resolve(), there, threads):
            if isinstance(error, UserError):
                raise error
            if error is not None:
                raise UserError(
                    f"batch {batch} failed ({type(error).__name__}: {error}); free some memory or use fewer --workers, and the "
                    "same command continues from there"
                ) from error
            yield batch


_simulator: "Simulator"
_job: Job
_digest = ""
"""Checksum of the job for which a worker is initialised."""


def _start(job: Job, backend: tuple[str, str], threads: int | None) -> None:
    global _simulator, _job
    use_backend(backend)
    import drjit as dr  # safe only after `use_backend`

    from data_gen.solve import Simulator

    if threads is not None:
        dr.set_thread_count(threads)
    _simulator, _job = Simulator(job.spec, job.settings, job.array), job


def _work_there(batch: int, job: Job, folder: Path, backend: tuple[str, str] | None, threads: int | None) -> int:
    """Computes a batch on a worker, which keeps its simulator for the next one."""
    global _digest
    backend = backend or find_backend()
    if _digest != (digest := job.digest(backend[0])):
        _start(job, backend, threads)
        _digest = digest
    return _work(batch, folder)


def _work(batch: int, folder: Path) -> int:
    chosen = _job.batch(batch)
    by_frequency = _simulator.paths(_job.tx_positions[chosen], _job.frequencies_hz)
    found = [_measure(_job, tx, [paths[i] for paths in by_frequency]) for i, tx in enumerate(chosen)]
    read_back = [_simulator.read_back_hz[f] for f in _job.frequencies_hz]
    arrays: dict[str, Any] = {key: np.stack([one[key] for one in found]) for key in found[0]}
    with atomic_write(batch_file(folder, batch)) as stream:
        np.savez(stream, read_back_hz=read_back, **arrays)
    return batch


def _measure(job: Job, tx: int, paths: list["TxPaths"]) -> Results:
    """Returns the arrays of `Results` for one transmitter from its paths at every frequency."""
    from data_gen import ceilings

    nothing = np.full(len(ceilings.NAMES), np.nan)
    return {
        "snapshots": np.stack([p.snapshot() for p in paths]),
        "n_paths": np.array([len(p.delays) for p in paths]),
        "line_of_sight": np.array([bool((p.order == 0).any()) for p in paths]),
        "delay_spread_s": np.array([p.delay_spread() for p in paths]),
        "ceilings": np.stack(
            [
                ceilings.measure(p, job.array.element_wavelengths(f)) if tx in job.ceiling_tx else nothing
                for p, f in zip(paths, job.frequencies_hz, strict=True)
            ]
        ),
    }


def check_received(job: Job, folder: Path, done: Sequence[int]) -> bool:
    """Returns whether any transmitter of the finished batches has a path.

    Raises:
        UserError: none has, and there are so many that this is probably a mistake.
    """
    if any(_load(batch_file(folder, batch))["n_paths"].any() for batch in done):
        return True
    silent = sum(len(job.batch(batch)) for batch in done)
    if silent >= min(SILENT, len(job.tx_positions)):
        raise UserError(
            f"no path between the receiver and any of {silent} transmitters, at any frequency; "
            "check the scene (units, up axis, a closed metal box?), the receiver's position and --tx-grid"
        )
    return False


def collect(job: Job, folder: Path) -> Results:
    """Returns the results of all batches combined: the arrays of `Results`, and `read_back_hz` (freq,)."""
    batches = [_load(batch_file(folder, b)) for b in range(job.n_batches)]
    read_back = [b.pop("read_back_hz") for b in batches]
    return {"read_back_hz": read_back[0], **{key: np.concatenate([b[key] for b in batches]) for key in batches[0]}}


def _load(file: Path) -> dict[str, np.ndarray]:
    return read_arrays(file, "batch", "remove it, and the same command computes it again")
