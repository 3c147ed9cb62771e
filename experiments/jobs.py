"""What is trained: a `Job` is one row of an experiment (field, scene, frequencies, seed), a `Profile` the size of everything.

A job knows its data set and its settings; its name is that of its result file, experiments/results/<profile>/<name>.json.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from experiments.paper import COMBINATIONS, DENSE_SCENE, GHZ_10, GHZ_21
from wbgs_jax.config import Settings, preset_settings
from wbgs_jax.data import load_dataset
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.splits import select_frequencies, unseen_frequencies

SEEDS = (0, 1, 2)
"""Of the headline rows."""
ONE_FREQUENCY = ("wrfgs",)
"""Fields that know one frequency: a model for each, all of them one job."""
REFERENCES = "references"
"""In the place of a field: the predictors that learn nothing."""
SLOW = ("nerf2",)
"""Fields that are slow to ask."""
SCORED_TRAINED, SCORED_SLOW = 200, 24
"""Transmitters that are scored where all have trained, and with a slow field; drawn once for all."""
PICTURED_SCENES = ("1", "4")
"""Scenes whose predicted pictures are kept (figure 4)."""
PICTURED_GHZ = (1, 10, 24.25, 37, 47, 60, 77, 94)

OWN = "the field's own"
VARIANTS: dict[str, dict[str, dict[str, Any]]] = {
    # name: section of the settings: what differs
    "": {},
    "long": {},
    "longest": {},
    "fast": {"optim": {"network_lr": 1.6e-2}},
    "no_attenuation": {OWN: {"attenuation_frequency": False}},
    "no_radiance": {OWN: {"radiance_frequency": False}},
    "no_frequency": {OWN: {"attenuation_frequency": False, "radiance_frequency": False}},
}


BUDGETS = {"long": 5, "longest": 10}
"""Variants that see so many times the usual number of spectra."""


@dataclass(frozen=True)
class Job:
    """One training and its evaluation (of a model for every frequency, if the field knows one alone)."""

    scene: str
    field: str
    combination: str = ""
    """Training frequencies, one of `paper.COMBINATIONS`, and tests at the others; none: both at all."""
    all_tx: bool = False
    """Train with all transmitters, as the paper's tables 2 and 6: only the frequency is new to the field."""
    seed: int = 0
    variant: str = ""
    """One of `VARIANTS`."""

    @property
    def name(self) -> str:
        """Readable and unique: scene4_wideband_C4_alltx_seed0."""
        words = [f"scene{self.scene}", self.field, self.variant, self.combination, "alltx" if self.all_tx else ""]
        return "_".join([word for word in words if word] + [f"seed{self.seed}"])

    @property
    def train_ghz(self) -> tuple[float, ...]:
        """Training frequencies."""
        return tuple(float(f) for f in COMBINATIONS[self.combination]) if self.combination else self.known_ghz

    @property
    def test_ghz(self) -> tuple[float, ...]:
        """Frequencies asked for."""
        return tuple(f for f in self.known_ghz if f not in self.train_ghz) if self.combination else self.known_ghz

    @property
    def known_ghz(self) -> tuple[float, ...]:
        """Frequencies of the scene."""
        return tuple(float(f) for f in (GHZ_21 if self.scene == DENSE_SCENE else GHZ_10))

    @property
    def pictured(self) -> bool:
        """Whether predicted pictures are kept."""
        everywhere = self.field not in (REFERENCES, *SLOW) and not self.combination and self.variant != "longest"
        return everywhere and self.scene in PICTURED_SCENES and self.seed == 0

    def dataset(self) -> Dataset:
        """The scene with this job's training and test spectra."""
        dataset = load_dataset(self.scene)
        if self.all_tx:
            everything = np.arange(len(dataset))
            dataset = dataclasses.replace(dataset, train=everything, test=everything)
        if self.combination:
            dataset = unseen_frequencies(dataset, self.train_ghz)
        count = SCORED_TRAINED if self.all_tx else SCORED_SLOW if self.field in SLOW else None
        return some_test_transmitters(dataset, count)

    def models(self) -> Iterator[tuple[str, Dataset]]:
        """A name and the data set of every model that is trained."""
        dataset = self.dataset()
        if self.field not in ONE_FREQUENCY:
            yield "all", dataset
            return
        for ghz in self.test_ghz:
            yield f"{ghz:g}GHz", select_frequencies(dataset, [ghz], [ghz])


def some_test_transmitters(dataset: Dataset, count: int | None) -> Dataset:
    """Test spectra of `count` transmitters alone (None: of all); larger counts contain the smaller ones."""
    known = np.unique(dataset.tx_index[dataset.test])
    chosen = np.random.default_rng([0, 5]).permutation(known)[:count]
    return dataclasses.replace(dataset, test=dataset.test[np.isin(dataset.tx_index[dataset.test], chosen)])


@dataclass(frozen=True)
class Profile:
    """How large everything is."""

    preset: str
    steps: int
    """Of a field for all frequencies. Models of one frequency share as many between them."""
    wave_steps: int
    changes: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Section of the settings: what differs from the preset."""


GAUSSIANS = {"gaussians": 1000}
TINY = {"gaussians": 60, "width": 8, "depth": 2, "skip": 1, "radiance_widths": (8,)}
PROFILES = {
    "quick": Profile("cpu", 1000, 600, {"wideband": GAUSSIANS, "wrfgs": GAUSSIANS, "loop": {"epoch_steps": 25}}),
    "paper": Profile("gpu", 14_000, 4000),
    # Proves within minutes that everything works.
    "smoke": Profile("smoke", 8, 4, {"wideband": TINY, "wrfgs": TINY, "optim": {"batch": 2}, "loop": {"epoch_steps": 2}}),
}


def settings(job: Job, profile: Profile) -> Settings:
    """A job's settings: the preset with the profile's and the variant's changes, schedules that count steps in proportion."""
    base = preset_settings(profile.preset, job.field)
    preset_steps = base.optim.steps
    base = changed(base, profile.changes)
    base = changed(base, {job.field if name == OWN else name: values for name, values in VARIANTS[job.variant].items()})
    block = base.loop.epoch_steps
    steps = whole(wanted_steps(job, profile), block)
    control = {name: getattr(base.density, name) for name in ("every", "start", "reset_every")}
    shrunk = {name: whole(count * steps / preset_steps, block) for name, count in control.items() if count}
    loop = {"evaluate_spectra": 0, "checkpoint_every": max(steps // 5, 100), "keep_checkpoints": 1}
    return changed(base, {"optim": {"steps": steps, "min_steps": steps}, "density": shrunk, "loop": loop})


def differences(job: Job, profile: Profile) -> dict[str, Any]:
    """A job's settings that are not the preset's, as JSON has them."""
    chosen, base = settings(job, profile), preset_settings(profile.preset, job.field)
    pairs = [
        (f"{section}.{name}", value, getattr(getattr(base, section), name))
        for section, values in dataclasses.asdict(chosen).items()
        if section in (job.field, "optim", "density", "search", "loop")
        for name, value in values.items()
    ]
    return {name: list(value) if isinstance(value, tuple) else value for name, value, other in pairs if value != other}


def wanted_steps(job: Job, profile: Profile) -> float:
    """Steps of one model of a job."""
    if job.field == "wave":
        return profile.wave_steps
    steps = profile.steps * BUDGETS.get(job.variant, 1)
    return steps / len(job.test_ghz) if job.field in ONE_FREQUENCY else steps


def changed(settings: Settings, changes: dict[str, dict[str, Any]]) -> Settings:
    """Settings with other values in some sections."""
    sections = {name: dataclasses.replace(getattr(settings, name), **values) for name, values in changes.items()}
    return dataclasses.replace(settings, **sections)


def whole(count: float, block: int) -> int:
    """The nearest multiple of `block`, at least one."""
    return max(1, round(count / block)) * block
