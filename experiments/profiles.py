"""Sizes of jobs: a `Profile` gives a job its preset, its steps and what else is smaller than in the preset."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

Changes = Mapping[str, Mapping[str, Any]]
"""Section of the settings ("field", "optim", "density", "calibration", "loop"): what differs."""


@dataclass(frozen=True)
class Profile:
    """A size of jobs."""

    preset: str
    steps: int
    """Steps of a field for all frequencies. Models of one frequency share as many between them."""
    wave_steps: int
    changes: Changes = field(default_factory=dict)
    """Differences from the preset, for every field ..."""
    fields: Changes = field(default_factory=dict)
    """... and by field, of its own settings."""
    scored_tx: int | None = None
    """Transmitters that are scored; None: all that are held out."""
    validation: bool = False
    """Whether it makes a choice: the validation part is scored, and the test is not looked at."""


SCORED_FEW = 24
"""Transmitters that are scored where many trainings are compared; drawn once for all."""
GAUSSIANS = {"gaussians": 1000}
TINY = {"gaussians": 60, "width": 8, "depth": 2, "skip": 1, "radiance_widths": (8,)}
QUICK: dict[str, Any] = {
    "changes": {"loop": {"epoch_steps": 25}},
    "fields": {"wideband": GAUSSIANS, "wrfgs": GAUSSIANS},
}
BY_ADAM: dict[str, Any] = {
    "network_optimizer": "adam",
    "network_lr": 4e-3,
    "ssim_stride": 1,
    "power_weight": 0.0,
    "features": 0,
    "features_lr": 0.0,
    "radiance_widths": (64, 32),
}
"""Settings of the splatting fields before Muon: the series of that time, which chose other settings, keep them."""
STEPS_BY_ADAM = 6000
"""Steps of the `cpu` preset before Muon."""
NERF2_BY_ADAM = {"network_optimizer": "adam", "network_lr": 4e-3}
"""Settings of the NeRF2-style field before Muon."""
QUICK_BY_ADAM = QUICK | {
    "fields": {"wideband": GAUSSIANS | BY_ADAM, "wrfgs": GAUSSIANS | BY_ADAM, "nerf2": NERF2_BY_ADAM},
}
BEFORE = BY_ADAM | {"network_lr": 1e-3, "fusion": 0}
"""Settings of the `cpu` preset when its inputs and sizes were chosen."""
PROFILES = {
    # Of the tables, whose jobs can have any of these.
    "quick": Profile("cpu", 1000, 600, **QUICK),
    "paper": Profile("gpu", 14_000, 4000),
    # Proves within minutes that everything works.
    "smoke": Profile(
        "smoke",
        8,
        4,
        changes={"optim": {"batch": 2}, "loop": {"epoch_steps": 2}},
        fields={"wideband": TINY, "wrfgs": TINY},
    ),
    # Of the series, each its own. `rates` and `rooms` are of today's presets.
    "tuning": Profile("cpu", 1000, 600, **QUICK_BY_ADAM, scored_tx=SCORED_FEW),
    "main": Profile("cpu", 2400, 600, validation=True),
    "rates": Profile("cpu", 1000, 600, **QUICK, validation=True, scored_tx=SCORED_FEW),
    "rooms": Profile("cpu", 1000, 600, **QUICK),
    # The default settings.
    "robustness": Profile("cpu", 2400, 2000),
    "schedules": Profile("cpu", 2000, 600, fields={"wideband": BY_ADAM}, validation=True),
    "frequency": Profile("cpu", 1000, 600, fields={"wideband": BY_ADAM}, validation=True),
    # What an hour on one core allows of the preset `paper`, Gaussians and steps.
    "paper_form": Profile("paper", 30_000, 4000, {"density": {"max_gaussians": 4000}}, {"wideband": {"gaussians": 3000}}),
    "to_ours": Profile(
        "paper",
        4000,
        4000,
        changes=QUICK["changes"] | {"density": {"max_gaussians": 3000}},
        fields={"wideband": GAUSSIANS},
        validation=True,
    ),
    "precision": Profile(
        "paper", 2000, 4000, {"density": {"every": 0}}, {"wideband": {"gaussians": 800}}, validation=True, scored_tx=SCORED_FEW
    ),
    "choices": Profile("cpu", 1500, 600, fields={"wideband": BEFORE}),
    "choices_octaves4": Profile("cpu", 1500, 600, fields={"wideband": BEFORE | {"frequency_octaves": 4}}),
}
TABLE_PROFILES = ("quick", "paper", "smoke")
