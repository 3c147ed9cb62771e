"""The settings of a job: the preset of its profile, what profile and variant change, schedules in proportion to the steps."""

import dataclasses
from typing import Any

from experiments.faults import Fault
from experiments.jobs import BASELINES, ONE_FREQUENCY, Job
from experiments.profiles import PROFILES
from experiments.variants import VARIANTS
from wbgs_jax.config import Settings, changed, to_dict
from wbgs_jax.fields import get_field

HOUSEKEEPING = ("loop.evaluate_every", "loop.evaluate_spectra", "loop.checkpoint_every", "loop.keep_checkpoints")
"""Settings that change no result."""
FAULT_NAMES = {"displaced_m": "mesh.displacement"}
"""Names of faults in older result files."""


def settings(job: Job) -> Settings:
    """Returns the settings of every model of a job."""
    profile, variant, preset = PROFILES[job.profile], VARIANTS[job.variant], preset_of(job)
    base = changed(preset, {**profile.changes, "field": profile.fields.get(job.field, {})})
    block = base.loop.epoch_steps
    steps = (variant.steps if job.profile != "smoke" else None) or whole(wanted_steps(job), block)
    rates = {name: variant.rates * value for name, value in vars(base.field).items() if name.endswith("_lr")}
    changes: dict[str, dict[str, Any]] = {
        "field": rates,
        "optim": {"steps": steps, "min_steps": steps},
        "loop": {"evaluate_spectra": 0, "checkpoint_every": max(steps // 5, 100), "keep_checkpoints": 1},
    }
    if base.density:
        control = {name: getattr(base.density, name) for name in ("every", "start", "reset_every")}
        share = steps / preset.optim.steps
        changes["density"] = {name: whole(count * share, block) for name, count in control.items() if count}
    return changed(changed(base, changes), variant.changes)


def preset_of(job: Job) -> Settings:
    """Returns the preset that a job's settings start from."""
    return get_field(job.field).presets[PROFILES[job.profile].preset]


def wanted_steps(job: Job) -> float:
    """Returns the steps of one model of a job, by its profile."""
    profile = PROFILES[job.profile]
    if job.field == "wave":
        return profile.wave_steps
    steps = profile.steps * job.budget
    return steps / len(job.test_ghz) if job.field in ONE_FREQUENCY else steps


def whole(count: float, block: int) -> int:
    """Returns the nearest multiple of `block`, at least one."""
    return max(1, round(count / block)) * block


def differences(job: Job) -> dict[str, Any]:
    """Returns what determines a job's result and is not the preset's, as JSON has it."""
    if job.field == BASELINES:
        return {}
    found = unlike_preset(job, _flat(settings(job), job.field))
    for name, value in dataclasses.asdict(VARIANTS[job.variant].fault).items():
        if value != getattr(Fault(), name):
            found[FAULT_NAMES.get(name, f"fault.{name}")] = value
    return found


def unlike_preset(job: Job, values: dict[str, Any]) -> dict[str, Any]:
    """Returns settings without those that the preset has, and those that change no result."""
    if job.field == BASELINES:
        return values
    base = _flat(preset_of(job), job.field)
    return {name: value for name, value in values.items() if name not in HOUSEKEEPING and value != base.get(name)}


def _flat(values: Settings, field: str) -> dict[str, Any]:
    return {f"{section}.{name}": plain(value) for section, own in to_dict(values, field).items() for name, value in own.items()}


def plain(value: Any) -> Any:
    """Returns a setting as JSON has it."""
    return list(value) if isinstance(value, tuple) else value
