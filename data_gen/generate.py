"""Generates a scene file with Sionna RT.

    python -m data_gen.generate --scene 1
    python -m data_gen.generate --scene 1 --frequency-set 21
    python -m data_gen.generate --scene room.glb --materials materials.toml --rx 1,2,1.5 --tx-grid 0,0,1:4,3,2:9,7,3

A killed run loses at most the batches in progress: the same command continues where it stopped and produces the same bytes.
"""

import os
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Int

from data_gen import jobs, statistics
from data_gen.llvm import CUDA, find_backend
from data_gen.options import Options, make_job
from data_gen.own_scene import describe
from data_gen.scenes.base import RX_CLEARANCE, TX_CLEARANCE
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.progress_lines import CountProgress
from wbgs_jax.data.dataset import tx_disjoint_split
from wbgs_jax.data.scene_file import TEST, SceneFile, save_scene

TEST_FRACTION = 0.2
SPLIT_SEED = 0
MAX_WORKERS = 4
"""More would need more memory than a laptop has."""


def generate(options: Options) -> Path:
    """Computes or continues a scene and writes its file.

    Returns:
        the scene file's path.
    """
    job = make_job(options)
    if options.own:
        print(describe(job.spec))
    out = writable(options.out or options.default_out())
    backend, _ = find_backend()
    folder = options.work / f"{job.spec.name}-{job.digest(backend)}"
    _compute(job, folder, *_processes(options, backend), options.cluster)
    save_scene(out, _assemble(job, folder, backend))
    return out


def writable(out: Path) -> Path:
    """Returns the path of a file to be written and creates its folder, so that errors occur now and not after hours.

    Raises:
        UserError: the file cannot be written.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out.parent).close()
    except OSError as error:
        raise UserError(f"cannot write {out}: {error.strerror}; choose another place with --out") from error
    return out


def _processes(options: Options, backend: str) -> tuple[int, int | None]:
    """Returns the number of processes and of threads in each (None: Dr.Jit's default)."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    workers = options.workers or (1 if backend == CUDA else min(max(cores // 2, 1), MAX_WORKERS))
    return workers, options.threads or (None if workers == 1 else -(-cores // workers))


def _compute(job: jobs.Job, folder: Path, workers: int, threads: int | None, cluster: str | None = None) -> None:
    todo = [batch for batch in range(job.n_batches) if not jobs.batch_file(folder, batch).exists()]
    if not todo:
        return
    with CountProgress(f"{job.spec.name}, batches", job.n_batches, job.n_batches - len(todo)) as progress:
        received, done = False, list[int]()
        for batch in jobs.run(job, todo, folder, workers, threads, cluster):
            done.append(batch)
            received = received or jobs.check_received(job, folder, done)
            progress.advance()


def _assemble(job: jobs.Job, folder: Path, backend: str) -> SceneFile:
    spec, found = job.spec, jobs.collect(job, folder)
    reached = (found["n_paths"] > 0).all(1)
    if not reached.any():
        raise UserError(f"no transmitter of {spec.name} has a path at every frequency; raise --samples or --depth")
    read_back = found.pop("read_back_hz")
    found = {key: value[reached] for key, value in found.items()}
    tx, mesh = job.tx_positions[reached], spec.mesh_arrays()
    scene = SceneFile(
        name=spec.name, snapshots=found["snapshots"][:, None], tx_positions=tx, frequencies_hz=np.array(job.frequencies_hz),
        rx_position=np.array([spec.rx_position]), rx_orientation=np.array([spec.rx_orientation]),
        element_positions=job.array.element_positions()[None], element_unit=job.array.unit,
        element_pattern=job.array.named_pattern(),
        split=draw_split(len(tx)),
        vertices=mesh["vertices"], faces=mesh["faces"], face_part=mesh["face_part"], meta=_provenance(job, backend),
    )  # fmt: skip
    scene.meta.update(
        tx_kept=len(tx), tx_without_path=int((~reached).sum()), frequencies_read_back_hz=read_back.tolist(),
        ceilings=statistics.ceiling_table(scene, found), channel=statistics.channel_table(scene, found),
    )  # fmt: skip
    return scene


def draw_split(n_tx: int) -> Int[np.ndarray, " tx"]:
    """Returns the split of a scene file (int8): a fifth of the transmitters, drawn with a fixed seed, are test."""
    split = np.zeros(n_tx, np.int8)
    split[tx_disjoint_split(np.arange(n_tx), TEST_FRACTION, SPLIT_SEED)[1]] = TEST
    return split


def _provenance(job: jobs.Job, backend: str) -> dict[str, Any]:
    # Nothing that differs between runs: no times, no paths, no host name.
    spec, settings = job.spec, job.settings
    interactions = ["line of sight", "specular reflection", "refraction", *["diffraction"] * settings.diffraction]
    interactions += ["diffuse reflection"] * settings.rough
    return {
        "generator": {"name": "data_gen", "simulator": "NVIDIA Sionna RT", "backend": backend, "versions": jobs.versions()},
        "description": spec.description,
        "parts": spec.part_table(),
        "mesh_sha256": spec.mesh_sha256(),
        "solver": settings.record() | {"interactions": interactions, "synthetic_array": True, "deterministic": True},
        "rx_array": asdict(job.array),
        "tx_pattern": "iso", "tx_polarization": "V",
        "split_seed": SPLIT_SEED, "test_fraction": TEST_FRACTION,
        "tx_candidates": len(spec.tx_grid), "tx_accessible": len(job.tx_positions),
        "tx_clearance_m": TX_CLEARANCE, "rx_clearance_m": RX_CLEARANCE, "ceiling_tx": list(job.ceiling_tx),
    }  # fmt: skip


def say_written(work: Callable[[], Path]) -> None:
    """Runs resumable work and prints the path of the file that it wrote."""
    try:
        print(f"wrote {work()}")
    except KeyboardInterrupt:
        raise UserError("interrupted; the same command continues from here") from None


def main() -> None:
    """Runs the command line."""
    options = tyro.cli(Options)
    say_written(lambda: generate(options))


if __name__ == "__main__":
    run_command(main)
