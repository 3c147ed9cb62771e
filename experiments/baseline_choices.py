"""Learning rates and inputs of the wideband field and the trained baselines: one changed at a time, tuned alike.

    python -m experiments.baseline_choices [--scene 1] [--seeds 0 1] [--only wrfgs_lr_8e-3 ...]

Trains every model with the effort of the `quick` profile and scores the held-out transmitters that all baselines are scored
on. Writes experiments/results/baseline_choices_scene<scene>.json after every run; what is there already is skipped.
docs/baselines.md quotes it.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments.choices import RESULTS, chosen_names, measure, run_series
from experiments.jobs import PROFILES, SCORED_SLOW, Job, changed, settings, some_test_transmitters
from wbgs_jax._util.command import run_command
from wbgs_jax._util.files import read_json

PROFILE = "quick"
RATES = ("1e-3", "2e-3", "8e-3", "1.6e-2", "3.2e-2")
"""Of the networks; the presets' is 4e-3."""


@dataclass(frozen=True)
class Change:
    """A field, and what differs from its settings: values by section."""

    field: str
    values: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)


CHANGES: dict[str, Change] = {
    **{field: Change(field) for field in ("wideband", "wrfgs", "nerf2")},
    **{
        f"{field}_lr_{rate}": Change(field, {"optim": {"network_lr": float(rate)}})
        for field in ("wideband", "wrfgs", "nerf2")
        for rate in RATES
    },
    "wrfgs_no_density_control": Change("wrfgs", {"density": {"every": 0, "reset_every": 0}}),
    "nerf2_l2": Change("nerf2", {"optim": {"pixel_loss": "l2"}}),
    "nerf2_directions_384": Change("nerf2", {"nerf2": {"directions": 384}}),
    "nerf2_not_relative": Change("nerf2", {"nerf2": {"relative": False}}),
}


@dataclass(frozen=True)
class Command:
    """Train variants of the wideband field and the baselines, and score them."""

    scene: str = "1"
    seeds: tuple[int, ...] = (0,)
    only: tuple[str, ...] = ()
    """Names of changes; all by default."""
    out: Path = RESULTS


def measure_change(change: Change, scene: str, seed: int) -> dict[str, Any]:
    """Train all models of a field and average their scores."""
    job = Job(scene, change.field, seed=seed)
    chosen = changed(settings(job, PROFILES[PROFILE]), change.values)
    parts = [measure(some_test_transmitters(dataset, SCORED_SLOW), chosen, seed, change.field) for _, dataset in job.models()]
    means = {name: round(float(np.mean([part[name] for part in parts])), 4) for name in ("median_ssim", "mean_ssim")}
    sums = {name: round(sum(part[name] for part in parts), 1) for name in ("steps", "seconds")}
    return {"seed": seed, **means, **sums, "models": len(parts)}


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.baseline_choices")
    names = chosen_names(command.only, CHANGES, "change")
    path = command.out / f"baseline_choices_scene{command.scene}.json"
    report = {"scene": command.scene, "profile": PROFILE, "changes": {}}
    if path.exists():
        report = read_json(path)
    run_series(path, report, names, command.seeds, lambda name, seed: measure_change(CHANGES[name], command.scene, seed))


if __name__ == "__main__":
    run_command(main)
