"""Generates a scene file with Sionna RT.

    python -m data_gen.generate --scene 1

A killed run loses at most the chunks in progress: the same command goes on where it stopped and ends with the same bytes.
"""

import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from data_gen import jobs
from data_gen.llvm import find_backend
from data_gen.materials import check_frequency
from data_gen.scenes import SceneSpec, get_scene
from data_gen.settings import SolverSettings
from wbgs_jax.array import planar_array
from wbgs_jax.data.schema import TEST, SceneFile, save_scene
from wbgs_jax.data.splits import tx_disjoint_split
from wbgs_jax.errors import UserError, run_command

HERE = Path(__file__).parent
TEST_FRACTION = 0.2
SPLIT_SEED = 0
SUBSET_SEED = 0
CEILING_TX = 25
"""Number of test transmitters the ceilings are measured on."""


@dataclass(frozen=True)
class Options:
    """Generate a scene file with Sionna RT. The same command continues an interrupted run."""

    scene: int = 1
    """Number of the scene."""
    out: Path | None = None
    """Scene file to write; data_gen/released/scene<N>.npz unless given."""
    frequencies: tuple[float, ...] = ()
    """GHz; those of the scene unless given."""
    samples: int = SolverSettings.samples_per_src
    """Rays that search for paths, for every transmitter."""
    max_tx: int | None = None
    """Take only this many of the transmitters, drawn at random by a fixed seed."""
    depth: int = SolverSettings.max_depth
    """Interactions a path may have."""
    diffraction: bool = True
    """First-order diffraction."""
    ceilings: bool = True
    """Measure what truncated and phase-blind predictors could reach."""
    max_paths: int = SolverSettings.max_paths_per_src
    """Room for candidate paths of one transmitter."""
    workers: int = 1
    """Processes."""
    threads: int | None = None
    """Threads of each process; all cores unless given."""
    work: Path = HERE / "work"
    """Folder for unfinished work."""


def generate(options: Options) -> Path:
    """Compute or continue a scene and write its file.

    Returns:
        the scene file's path.
    """
    _check(options)
    spec = get_scene(options.scene)
    frequencies = tuple(check_frequency(ghz * 1e9) for ghz in options.frequencies) or spec.frequencies_hz
    out = _output(options, spec)
    backend, _ = find_backend()
    job = _job(options, spec)
    folder = options.work / f"{spec.name}-{job.digest(backend)}"
    _compute(job, frequencies, folder, options)
    scene = _assemble(job, frequencies, folder, backend)
    save_scene(out, scene)
    return out


def _check(options: Options) -> None:
    for name in ("samples", "depth", "max_paths", "workers", "threads", "max_tx"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise UserError(f"--{name.replace('_', '-')} is {value}; it must be at least 1")


def _output(options: Options, spec: SceneSpec) -> Path:
    partial = options.max_tx is not None or options.frequencies
    if options.out is None and partial:
        raise UserError("a part of a scene must not replace the released file; give another one with --out")
    out = options.out or HERE / "released" / f"{spec.name}.npz"
    try:  # now, not after the last frequency
        out.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out.parent).close()
    except OSError as error:
        raise UserError(f"cannot write {out}: {error.strerror}; choose another place with --out") from error
    return out


def _job(options: Options, spec: SceneSpec) -> jobs.Job:
    settings = SolverSettings(
        max_depth=options.depth, samples_per_src=options.samples, diffraction=options.diffraction,
        max_paths_per_src=options.max_paths,
    )  # fmt: skip
    tx = spec.accessible_tx()
    if options.max_tx is not None and options.max_tx < len(tx):
        tx = tx[np.sort(np.random.default_rng(SUBSET_SEED).permutation(len(tx))[: options.max_tx])]
    test = np.flatnonzero(_split(len(tx)) == TEST)
    chosen = test[np.unique(np.linspace(0, len(test) - 1, CEILING_TX).round().astype(int))] if options.ceilings else []
    return jobs.Job(spec, settings, tx, tuple(int(i) for i in chosen))


def _split(n_tx: int) -> np.ndarray:
    split = np.zeros(n_tx, np.int8)
    split[tx_disjoint_split(np.arange(n_tx), TEST_FRACTION, SPLIT_SEED)[1]] = TEST
    return split


def _compute(job: jobs.Job, frequencies: tuple[float, ...], folder: Path, options: Options) -> None:
    everything = jobs.chunks(job, frequencies)
    todo = [chunk for chunk in everything if not chunk.file(folder).exists()]
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    with Progress(*columns) as progress:
        task = progress.add_task(job.spec.name, total=len(everything), completed=len(everything) - len(todo))
        for chunk in jobs.run(job, todo, folder, options.workers, options.threads) if todo else ():
            progress.update(task, advance=1, description=f"{job.spec.name} {chunk.frequency_hz / 1e9:g} GHz")


def _assemble(job: jobs.Job, frequencies: tuple[float, ...], folder: Path, backend: str) -> SceneFile:
    spec, found = job.spec, jobs.collect(job, frequencies, folder)
    if lost := int((found["n_paths"] == 0).any(1).sum()):
        total = len(job.tx_positions)
        raise UserError(f"{lost} of {total} transmitters have no path at some frequency; raise --samples or --depth")
    return SceneFile(
        name=spec.name, snapshots=found["snapshots"], tx_positions=job.tx_positions, frequencies_hz=np.array(frequencies),
        rx_position=np.array(spec.rx_position), rx_orientation=np.array(spec.rx_orientation), element_positions=planar_array(),
        split=_split(len(job.tx_positions)), meta=_meta(job, frequencies, found, backend), **spec.mesh_arrays(),
    )  # fmt: skip


def _meta(job: jobs.Job, frequencies: tuple[float, ...], found: dict[str, Any], backend: str) -> dict[str, Any]:
    # Nothing that differs between two runs: no times, no paths, no host.
    interactions = ["line of sight", "specular reflection", "refraction", *["diffraction"] * job.settings.diffraction]
    return {
        "generator": {"name": "data_gen", "simulator": "NVIDIA Sionna RT", "backend": backend, "versions": jobs.versions()},
        "description": job.spec.description,
        "parts": job.spec.part_table(),
        "mesh_sha256": job.spec.mesh_sha256(),
        "solver": asdict(job.settings) | {"interactions": interactions, "synthetic_array": True, "deterministic": True},
        "rx_pattern": "tr38901", "tx_pattern": "iso", "polarization": "V",
        "split_seed": SPLIT_SEED, "test_fraction": TEST_FRACTION,
        "tx_candidates": len(job.spec.tx_grid), "tx_kept": len(job.tx_positions),
        "frequencies_read_back_hz": found["read_back_hz"],
        "median_paths": [float(np.median(n)) for n in found["n_paths"].T],
        "ceilings": [{"frequency_ghz": f / 1e9} | c for f, c in zip(frequencies, found["ceilings"], strict=False)],
        "ceiling_tx": list(job.ceiling_tx),
    }  # fmt: skip


def main() -> None:
    """Command line."""
    options = tyro.cli(Options)
    try:
        print(f"wrote {generate(options)}")
    except KeyboardInterrupt:
        raise UserError("interrupted; the same command goes on from here") from None


if __name__ == "__main__":
    run_command(main)
