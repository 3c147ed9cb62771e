"""Pieces of work that are disturbed: commands on data so small that a training takes seconds. Each goes on where it was."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import wbgs_jax.commands.convert
import wbgs_jax.commands.evaluate
import wbgs_jax.commands.map
import wbgs_jax.commands.measure
import wbgs_jax.commands.predict
import wbgs_jax.commands.train
from builders.synthetic import FIELDS, tiny_scene, tiny_settings
from builders.untrained import make_coherent_run
from data_gen import generate, jobs
from data_gen.settings import ArraySettings, SolverSettings
from wbgs_jax._util import files
from wbgs_jax.commands import export_folder as layout
from wbgs_jax.config import sections
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.evaluation import report
from wbgs_jax.training import checkpoint

files.STALE_S = 0.0
report.environment = lambda: {
    "version": "0",
    "commit": None,
    "device": "cpu",
}  # it asks JAX for its devices when the runner is imported, and JAX must not run before a fork

from experiments import execute, runner  # noqa: E402
from experiments.jobs import Job  # noqa: E402

BLOCK, QUERIES = 4, 30
EVERY_STEP = {"epoch_steps": 1, "checkpoint_every": 1}
"""Of the loop: each of the eight steps is a checkpoint."""


def options(field: str) -> list[str]:
    """Returns the settings of `tiny_settings` as words of a command line."""
    words = []
    for section, part in sections(tiny_settings(field, loop=EVERY_STEP), field).items():
        for name, value in dataclasses.asdict(part).items():
            option = f"{section}.{name}".replace("_", "-")
            if isinstance(value, bool):
                words.append(f"--{option}" if value else f"--{section}.no-{name}".replace("_", "-"))
            else:
                words += [f"--{option}", *(map(str, value) if isinstance(value, tuple) else [str(value)])]
    return words


def train(field: str, folder: Path) -> None:
    """Trains to the end, from wherever it was."""
    words = ["--data", str(folder / "box.npz"), "--out", str(folder / "run"), "--field", field, "--preset", "smoke", "--resume"]
    wbgs_jax.commands.train.main([*words, *options(field)])


def checkpoints(folder: Path) -> None:
    """Writes ten checkpoints, from wherever it was, of which two are kept."""
    checkpoint.tidy(folder / "kept", 2)  # as a training that goes on
    done = checkpoint.checkpoint_steps(folder / "kept")
    for step in range(done[-1] + 1 if done else 1, 11):
        state = {"a": np.random.default_rng(step).random(50_000), "b": np.full((3, 4), step, np.float32)}
        checkpoint.save(folder / "kept", step, state, {}, {"seconds": 0.0, "step": step}, keep=2)


def predict(folder: Path) -> None:
    """Answers queries in eight blocks."""
    wbgs_jax.commands.predict.BLOCK = BLOCK
    words = ["--run", str(folder / "run"), "--queries", str(folder / "queries.csv"), "--what", "power"]
    wbgs_jax.commands.predict.main([*words, "--out", str(folder / "powers.npz"), "--resume"])


class StandIn:
    """In the place of the simulator, which may not be installed: numbers that follow from transmitters and frequencies."""

    def __init__(self, *_: Any):
        self.read_back_hz: dict[float, float] = {}

    def paths(self, positions: np.ndarray, frequencies: tuple[float, ...]) -> list[list[Any]]:
        self.read_back_hz = {f: f for f in frequencies}
        return [[(position, f) for position in positions] for f in frequencies]


def _measured(job: jobs.Job, tx: int, paths: list[Any]) -> jobs.Results:
    waves = [np.exp(1j * f / 1e9 * np.arange(16) * position.sum()) for position, f in paths]
    count = len(paths)
    return {
        "snapshots": np.stack(waves).astype(np.complex64),
        "n_paths": np.ones(count, int),
        "line_of_sight": np.ones(count, bool),
        "delay_spread_s": np.full(count, 1e-9),
        "ceilings": np.full((count, 5), np.nan),
    }


def _start(job: jobs.Job, *_: Any) -> None:
    jobs._simulator, jobs._job = StandIn(), job


def data(folder: Path) -> None:
    """Generates a scene file in seven batches, with `StandIn`."""
    from data_gen.options import Options
    from data_gen.scenes import get_scene

    jobs._start, jobs._measure, jobs.find_backend = _start, _measured, lambda: ("stand-in", "")
    generate.find_backend = jobs.find_backend
    jobs.versions = lambda: {"stand-in": "1"}
    tables = {"ceiling_table": lambda *_: [], "channel_table": lambda *_: []}
    for name, table in tables.items():
        setattr(generate.statistics, name, table)
    positions = get_scene(1).tx_grid[:50]
    job = jobs.Job(get_scene(1), SolverSettings(), positions, (2.4e9, 60e9), ArraySettings())
    generate.make_job = lambda _: job
    generate.generate(Options(out=folder / "scene.npz", work=folder / "work", workers=1))


def experiments(folder: Path) -> None:
    """Runs two jobs of the experiment runner."""
    execute.settings = lambda job: tiny_settings(job.field, loop=EVERY_STEP)
    wanted = [Job(str(folder / "box.npz"), "nerf2", seed=seed, profile="smoke") for seed in (0, 1)]
    command = runner.Command(profile="smoke", results=folder / "results", runs=folder / "runs")
    if failures := runner.run(wanted, command):
        raise wbgs_jax.commands.train.UserError("; ".join(failures))


def prepare(folder: Path) -> None:
    """Lays out what the others work on."""
    save_scene(folder / "box.npz", tiny_scene(12))
    make_coherent_run(folder / "run_base", str(folder / "box.npz"))
    draw = np.random.default_rng(0)
    rows = [
        f"{x:.3f},{y:.3f},1.2,{ghz}" for x, y, ghz in zip(*draw.uniform(-1.5, 1.5, (2, QUERIES)), [5, 28, 60] * 10, strict=True)
    ]
    (folder / "queries.csv").write_text("\n".join(["x,y,z,ghz", *rows]) + "\n")
    (folder / "readings.csv").write_text("x,y,z,rssi_a\n" + "".join(f"{x},{x % 3},1,-{60 + x}\n" for x in range(12)))
    (folder / "receivers.csv").write_text("id,x,y,z\na,0,0,2\n")
    (folder / "walls.csv").write_text("x1,y1,x2,y2\n0,1,9,1\n")


def _asked(folder: Path) -> list[str]:
    return ["--run", str(folder / "run"), "--tx", "1,0,1", "-1,0.5,1.2", "--ghz", "28"]


def _convert(folder: Path, out: str) -> None:
    wbgs_jax.commands.convert.main([*_asked(folder), "--out", str(folder / out)])


WORKS: dict[str, Callable[[Path], None]] = {
    **{f"train {field}": lambda folder, field=field: train(field, folder) for field in FIELDS},
    "write checkpoints": checkpoints,
    "predict": predict,
    "generate data": data,
    "run experiments": experiments,
    "prepare": prepare,
    "evaluate": lambda folder: wbgs_jax.commands.evaluate.main(
        ["--run", str(folder / "run"), "--results", str(folder / "results")]
    ),
    "predict spectra": lambda f: wbgs_jax.commands.predict.main(
        [*_asked(f), "--out", str(f / "x.npz"), "--picture", str(f / "x.png")]
    ),
    "predict powers": lambda f: wbgs_jax.commands.predict.main([*_asked(f), "--what", "power", "--out", str(f / "x.csv")]),
    "export": lambda f: wbgs_jax.commands.predict.main(["--run", str(f / "run"), "--export", str(f / "field.zip")]),
    "map": lambda f: wbgs_jax.commands.map.main(
        ["--run", str(f / "run"), "--ghz", "28", "--step", "1", "--out", str(f / "map.npz"), "--picture", str(f / "map.png")]
    ),
    "convert to paths": lambda f: _convert(f, "paths.npz"),
    "convert to DeepMIMO": lambda f: _convert(f, "scenario"),
    "lay out": lambda f: layout.main([str(f / "box.npz"), str(f / "layout")]),
    "measure": lambda f: wbgs_jax.commands.measure.main(
        ["--data", str(f), "--mesh", str(f / "walls.ply"), "--tx", "1,1,1", "--answers", str(f / "answers.csv")]
    ),
}


def warm() -> None:
    """Imports what pieces of work import on their way; nothing is computed."""
    from jax._src import xla_bridge
    from matplotlib import pyplot
    from orbax.checkpoint import v1

    from wbgs_jax import plotting
    from wbgs_jax.inference import export

    assert pyplot and v1 and export and plotting
    assert not xla_bridge.backends_are_initialized(), "JAX runs already: a fork would hang"
