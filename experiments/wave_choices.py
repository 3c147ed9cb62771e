"""What the parts of the coherent field are worth: one changed at a time.

    python -m experiments.wave_choices --data SCENE [--steps 1000] [--seeds 0 1] [--only order_1 phase_blind ...]

Trains the wave field, scores all held-out spectra, and writes experiments/results/wave_choices_<dataset>.json after every run;
what is there already is skipped. docs/wave.md quotes it.
"""

import dataclasses
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.choices import measure
from wbgs_jax.config import Settings, preset_settings
from wbgs_jax.data import load_dataset
from wbgs_jax.errors import UserError, run_command
from wbgs_jax.eval import environment
from wbgs_jax.files import read_json, write_json

RESULTS = Path(__file__).parent / "results"
Change = dict[str, Any]
NO_EDGES: Change = {"diffracted_tried": 1, "diffracted_kept": 1}

CHANGES: dict[str, tuple[Change, Change]] = {
    # name: changes of (the field, the optimiser)
    "default": ({}, {}),
    "phase_blind": ({"coherent": False}, {}),
    "order_0": ({"mirror_areas": ()} | NO_EDGES, {}),
    "order_1": ({"mirror_areas": (0.0,)} | NO_EDGES, {}),
    "order_2": ({"mirror_areas": (0.0, 0.05)} | NO_EDGES, {}),
    "no_diffraction": (NO_EDGES, {}),
    "materials_alone": ({}, {"residual_lr": 0.0}),
    "residuals_alone": ({}, {"materials_lr": 0.0, "thickness_lr": 0.0}),
    "no_curriculum": ({}, {"curriculum": 0.0}),
    "no_snapshot_loss": ({}, {"snapshot_weight": 0.0, "power_weight": 0.0}),
    "more_candidates": ({"diffracted_tried": 4096, "diffracted_kept": 512, "mirror_areas": (0.0, 0.02, 0.3)}, {}),
    "untrained": ({}, {"materials_lr": 0.0, "thickness_lr": 0.0, "residual_lr": 0.0}),
}


@dataclass(frozen=True)
class Command:
    """Train variants of the wave field and score them."""

    data: str
    """Scene number, scene file or folder."""
    steps: int = 1000
    seeds: tuple[int, ...] = (0,)
    only: tuple[str, ...] = ()
    """Names of changes; all by default."""
    out: Path = RESULTS


def changed_settings(name: str, steps: int) -> Settings:
    """The `cpu` preset of the wave field with one change."""
    base, (field, optim) = preset_settings("cpu", "wave"), CHANGES[name]
    changed: Change = {"steps": steps, "min_steps": steps} | optim
    return dataclasses.replace(
        base,
        wave=dataclasses.replace(base.wave, **field),
        optim=dataclasses.replace(base.optim, **changed),
        loop=dataclasses.replace(base.loop, evaluate_every=10 * steps, checkpoint_every=10 * steps),
    )


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.wave_choices")
    names = command.only or tuple(CHANGES)
    if unknown := [name for name in names if name not in CHANGES]:
        raise UserError(f"unknown change {unknown[0]!r}; choose among: {', '.join(CHANGES)}")
    dataset = load_dataset(command.data)
    path = command.out / f"wave_choices_{dataset.name}.json"
    report: dict[str, Any] = (
        read_json(path) if path.exists() else {"dataset": dataset.name, "steps": command.steps, "changes": {}}
    )
    if report["steps"] != command.steps:
        raise UserError(f"{path} holds runs of {report['steps']} steps; move it away or use --steps {report['steps']}")
    for seed in command.seeds:
        for name in names:
            runs = report["changes"].setdefault(name, {"runs": []})["runs"]
            if any(run["seed"] == seed for run in runs):
                continue
            runs.append(measure(dataset, changed_settings(name, command.steps), seed, "wave") | environment())
            report["changes"][name]["median_of_medians"] = statistics.median(run["median_ssim"] for run in runs)
            write_json(path, report)
            print(f"{name:18} {runs[-1]['median_ssim']:.3f} / {runs[-1]['mean_ssim']:.3f}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    run_command(main)
