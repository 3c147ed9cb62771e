"""Choices made by measurement: one setting changed at a time, several seeds, everything else equal.

    python -m experiments.choices --data FOLDER|SCENE --steps 1000 --seeds 0 1 2 [--only relative_off area ...]
    python -m experiments.choices --data 1 --seconds 60 --label batch --only default batch_4 batch_16

Trains the `cpu` preset with fewer steps, or each variant for the same time, scores all held-out spectra, and writes
experiments/results/choices_<dataset>[_label].json (equal_time_... where --seconds is given) after every run; what is already
there is skipped, so that an interrupted series goes on. docs/decisions.md and docs/performance.md quote it.
"""

import dataclasses
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from wbgs_jax.evaluation import metrics
from wbgs_jax.config import PRESETS, DensityConfig, OptimConfig, Settings, WidebandConfig
from wbgs_jax.data import load_dataset
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.splits import unseen_frequencies
from wbgs_jax._util.command import run_command
from wbgs_jax._util.errors import UserError
from wbgs_jax.eval import environment
from wbgs_jax.fields import get_field
from wbgs_jax._util.files import read_json, write_json
from wbgs_jax.inference.predictor import predict_spectra
from wbgs_jax.training.loop import Run, train

RESULTS = Path(__file__).parent / "results"
Change = dict[str, Any]


def batch(size: int) -> Change:
    """Another batch; Adam's learning rates follow its square root."""
    base = PRESETS["cpu"].optim
    rates = ("network_lr", "means_lr", "log_scales_lr", "quats_lr", "opacity_lr")
    return {"batch": size} | {rate: getattr(base, rate) * (size / base.batch) ** 0.5 for rate in rates}


CHANGES: dict[str, tuple[Change, Change, Change]] = {
    # name: changes of (the field, the optimiser, density control)
    "default": ({}, {}, {}),
    "paper_inputs": ({"relative": False}, {}, {}),
    "raw_gigahertz": ({"frequency_scale": "ghz"}, {}, {}),
    "sphere": ({"projection": "sphere"}, {}, {}),
    "area": ({"sampling": "area"}, {}, {}),
    "no_density_control": ({}, {}, {"every": 0, "reset_every": 0}),
    "density_with_reset": ({}, {}, {"reset_every": 300}),
    "octaves_10": ({"gaussian_octaves": 10, "tx_octaves": 10, "frequency_octaves": 10}, {}, {}),
    "frequency_octaves_1": ({"frequency_octaves": 1}, {}, {}),
    "frequency_octaves_4": ({"frequency_octaves": 4}, {}, {}),
    "octaves_3_2": ({"gaussian_octaves": 3, "tx_octaves": 2}, {}, {}),
    "gaussians_1000": ({"gaussians": 1000}, {}, {}),
    "gaussians_4000": ({"gaussians": 4000}, {}, {}),
    "width_128": ({"width": 128, "radiance_widths": (128, 64)}, {}, {}),
    "fusion_0": ({"fusion": 0}, {}, {}),
    "fusion_2": ({"fusion": 2}, {}, {}),
    "fusion_3": ({"fusion": 3}, {}, {}),
    "batch_4": ({}, batch(4), {}),
    "batch_16": ({}, batch(16), {}),
    "network_lr_3e-3": ({}, {"network_lr": 3e-3}, {}),
    "weight_decay_0.1": ({}, {"network_weight_decay": 0.1}, {}),
    "fixed_means": ({}, {"means_lr": 0.0}, {}),
    "no_attenuation_frequency": ({"attenuation_frequency": False}, {}, {}),
    "no_radiance_frequency": ({"radiance_frequency": False}, {}, {}),
    "no_frequency": ({"attenuation_frequency": False, "radiance_frequency": False}, {}, {}),
}


@dataclasses.dataclass(frozen=True)
class Command:
    """Train variants of the `cpu` preset and score them."""

    data: str
    """Scene number, scene file or folder."""
    steps: int = 1000
    seconds: float | None = None
    """Train every change for about this long instead (compilation not counted), so that cheaper steps are more steps."""
    seeds: tuple[int, ...] = (0, 1, 2)
    only: tuple[str, ...] = ()
    """Names of changes; all by default."""
    train_ghz: tuple[float, ...] = ()
    """Train on these frequencies alone and score the others (held-out transmitters, unseen frequencies)."""
    label: str = ""
    """Appended to the file's name."""
    out: Path = RESULTS


def changed_settings(name: str, steps: int) -> Settings:
    """The `cpu` preset with one change and fewer steps; schedules that count steps shrink with them."""
    base = PRESETS["cpu"]
    field, optim, density = CHANGES[name]
    scale = steps / base.optim.steps
    block = base.loop.epoch_steps

    def shrink(count: int) -> int:
        return max(block, round(count * scale / block) * block) if count else 0

    wideband: WidebandConfig = dataclasses.replace(base.wideband, **field)
    changed: Change = {"steps": steps, "min_steps": steps} | optim
    optimiser: OptimConfig = dataclasses.replace(base.optim, **changed)
    shrunk = {key: shrink(getattr(base.density, key)) for key in ("every", "start", "reset_every")}
    control: DensityConfig = dataclasses.replace(base.density, **shrunk | density)
    loop = dataclasses.replace(base.loop, evaluate_every=10 * steps, checkpoint_every=10 * steps)
    return dataclasses.replace(base, wideband=wideband, optim=optimiser, density=control, loop=loop)


def steps_within(dataset: Dataset, name: str, seconds: float, seed: int) -> int:
    """How many steps of a change take this long, in whole epochs."""
    settings = changed_settings(name, PRESETS["cpu"].optim.steps)
    with tempfile.TemporaryDirectory() as folder:
        run = Run(dataset, "wideband", settings, seed, Path(folder))
        run.epoch()  # compiles
        begin = time.perf_counter()
        run.epoch()
        run.epoch()
    block = settings.loop.epoch_steps
    return max(1, round(seconds / (time.perf_counter() - begin) * 2)) * block


def measure(dataset: Dataset, settings: Settings, seed: int, field: str = "wideband") -> dict[str, Any]:
    """Train once and score all held-out spectra."""
    with tempfile.TemporaryDirectory() as folder:
        result = train(dataset, field, settings, seed, Path(folder))
    predicted = predict_spectra(get_field(field), result.params, dataset, dataset.test)
    ssim = metrics.ssim(predicted, np.asarray(dataset.pas(dataset.test)))
    scores = {"median_ssim": round(float(np.median(ssim)), 4), "mean_ssim": round(float(np.mean(ssim)), 4)}
    return {
        "seed": seed,
        **scores,
        "steps": result.steps,
        "seconds": round(result.seconds, 1),
        "gaussians": result.gaussians,
    }


def chosen_names(only: tuple[str, ...], known: dict[str, Any], kind: str) -> tuple[str, ...]:
    """What a command line asks for, all by default; an unknown name is a `UserError`."""
    if unknown := [name for name in only if name not in known]:
        raise UserError(f"unknown {kind} {unknown[0]!r}; choose among: {', '.join(known)}")
    return only or tuple(known)


Measurement = Callable[[str, int], dict[str, Any]]
"""(name, seed) -> scores of one training."""


def run_series(path: Path, report: dict[str, Any], names: tuple[str, ...], seeds: tuple[int, ...], run: Measurement) -> None:
    """Measure what the report does not hold yet, by name and seed; write it after every run."""
    origin = environment()
    for seed in seeds:
        for name in names:
            runs = report["changes"].setdefault(name, {"runs": []})["runs"]
            if any(done["seed"] == seed for done in runs):
                continue
            begin = time.perf_counter()
            runs.append(run(name, seed) | origin)
            report["changes"][name]["median_of_medians"] = statistics.median(done["median_ssim"] for done in runs)
            write_json(path, report)
            scores = f"{runs[-1]['median_ssim']:.3f} / {runs[-1]['mean_ssim']:.3f}"
            print(f"{name:32} {scores}  {time.perf_counter() - begin:.0f} s", file=sys.stderr, flush=True)


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.choices")
    names = chosen_names(command.only, CHANGES, "change")
    dataset = load_dataset(command.data)
    if command.train_ghz:
        dataset = unseen_frequencies(dataset, command.train_ghz)
    name = dataset.name
    timed = command.seconds is not None
    path = command.out / f"{'equal_time' if timed else 'choices'}_{name}{'_' * bool(command.label)}{command.label}.json"
    effort, amount = ("seconds", command.seconds) if timed else ("steps", command.steps)
    report: dict[str, Any] = {"dataset": name, effort: amount, "changes": {}}
    if path.exists():
        report = read_json(path)
    if report[effort] != amount:
        raise UserError(
            f"{path} holds runs of {report[effort]:g} {effort}, not {amount:g}; move it away, give it a --label"
            f" or use --{effort} {report[effort]:g}"
        )

    def run(change: str, seed: int) -> dict[str, Any]:
        steps = command.steps if command.seconds is None else steps_within(dataset, change, command.seconds, seed)
        return measure(dataset, changed_settings(change, steps), seed)

    run_series(path, report, names, command.seeds, run)


if __name__ == "__main__":
    run_command(main)
