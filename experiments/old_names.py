"""Names that settings had in version 0.1: results of that time count as run, and stay as they were written."""

from typing import Any

from experiments.profiles import BY_ADAM, NERF2_BY_ADAM, STEPS_BY_ADAM
from experiments.settings import HOUSEKEEPING, plain
from experiments.variants import AS_IT_IS

MOVED = {
    # Until 0.2 learning rates and weights of all fields were settings of the optimiser.
    **{f"optim.{name}": f"{{field}}.{name}" for name in ("network_lr", "network_weight_decay", "ssim_weight", "pixel_loss")},
    **{f"optim.{name}": f"{{field}}.{name}" for name in ("means_lr", "log_scales_lr", "quats_lr", "opacity_lr")},
    **{f"optim.{name}": f"{{field}}.{name}" for name in ("materials_lr", "thickness_lr", "power_weight")},
    "optim.residual_lr": "wave.corrections_lr",
    "optim.snapshot_weight": "wave.correlation_weight",
    "wave.residual_weight": "wave.correction_weight",
    "wave.plain_tried": "wave.specular_tried",
    "wave.plain_kept": "wave.specular_kept",
    "wave.survival": "wave.excess_amplitude",
}
BEFORE_MUON: dict[str, dict[str, Any]] = {
    "wideband": {
        **{f"wideband.{name}": plain(value) for name, value in BY_ADAM.items()},
        "optim.steps": STEPS_BY_ADAM,
        "density.every": 500,
        "density.start": 500,
    },
}
BEFORE_MUON["wrfgs"] = {name.replace("wideband.", "wrfgs."): value for name, value in BEFORE_MUON["wideband"].items()}
"""What the presets of a field had in the first edition: results that do not say otherwise (`EDITION`) were made so."""
BEFORE_NERF2_BY_MUON = {"nerf2": {f"nerf2.{name}": value for name, value in NERF2_BY_ADAM.items()}}
"""... and in the second."""
EDITION = 3
"""Of the presets; results are written with it."""
NOT_OF = {"density": ("wave", "nerf2"), "search": ("wideband", "wrfgs", "nerf2")}
"""Sections that all fields had, and the fields that took no notice."""


def todays(result: dict[str, Any], field: str) -> dict[str, Any]:
    """Returns the settings of a result by today's names and against today's presets, without those that changed nothing."""
    settings = result.get("settings", {})
    edition = result.get("presets", 1)
    if result.get("preset") != "paper":
        settings = (BEFORE_MUON.get(field, {}) if edition < 2 else {}) | settings
        settings = (BEFORE_NERF2_BY_MUON.get(field, {}) if edition < 3 else {}) | settings
    if edition < 3 and "mesh.displacement" in settings:  # nobody doubted a mesh by then
        settings = {f"search.{name}": value for name, value in AS_IT_IS["search"].items()} | settings
    named = {MOVED.get(name, name).format(field=field): value for name, value in settings.items()}
    return {
        name: value
        for name, value in named.items()
        if name not in HOUSEKEEPING and field not in NOT_OF.get(name.split(".")[0], ())
    }
