"""Trainings: a `Job` is one row of an experiment: data, field, frequencies, transmitters, change, size, seed.

A job knows its data set; `settings.py` gives it its settings. Its name is that of its result, a line
of experiments/results/<profile>.jsonl.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.faults import Fault, faulty
from experiments.paper import COMBINATIONS, DENSE_SCENE, GHZ_10, GHZ_21, SCENES
from experiments.profiles import PROFILES, TABLE_PROFILES
from experiments.variants import VARIANTS
from wbgs_jax.data import Dataset, load_dataset
from wbgs_jax.data.dataset import hold_out_box, hold_out_validation, select_frequencies, unseen_frequencies
from wbgs_jax.fields import default_field

FIXED_SCENE = "2_fixed"
"""Scene 2 seen by an array of fixed size, half a wavelength apart at 10 GHz ..."""
GHZ_FIXED = (2.4, 3.5, 5, 7, 10, 14, 18, 22, 25, 28)
"""... at these frequencies."""
GHZ_CABIN = (1, 1.1, 1.2, 1.3, 1.4, 1.5)
OUTSIDE = {"cabin": GHZ_CABIN, "2_simulator": GHZ_10, "4_simulator": GHZ_10, "2_diffuse": GHZ_10}
"""Truths from outside (docs/dataset.md)."""
OUTSIDE_SCENES = tuple(OUTSIDE)
RELEASED_GHZ = dict.fromkeys(SCENES, GHZ_10) | {DENSE_SCENE: GHZ_21, FIXED_SCENE: GHZ_FIXED} | OUTSIDE
"""Released scenes and their frequencies."""
SEEDS = (0, 1, 2)
"""Seeds of the headline rows."""
ONE_FREQUENCY = ("wrfgs",)
"""Fields that know one frequency: a model for each, all of them one job."""
BASELINES = "baselines"
"""In the place of a field: the predictors that learn nothing."""
SCORED_TRAINED = 200
"""Transmitters that are scored where all have trained; drawn once for all."""
ROOMS = {
    "2": ((1.83, -4.25, 0), (5.5, 0.85, 2.7)),
    "3": ((2.0, -5.0, 0), (6.0, -1.67, 2.6)),
    "4": ((-1.08, -1.15, 0), (3.24, 3.0, 2.8)),
    "5": ((0.35, -4.0, 0), (5.25, 0.0, 3.6)),
}
"""A room of each flat that the receiver does not stand in: lowest and highest corner, metres."""
PICTURED_SCENES = ("1", "4")
"""Scenes of which pictures are kept (figure 4)."""
PICTURED_GHZ = (1, 10, 24.25, 37, 47, 60, 77, 94)


@dataclass(frozen=True)
class Job:
    """One training and its evaluation (of a model for every frequency, if the field supports only one)."""

    scene: str
    """Released scene (1, 2, ..., 1_21f, 2_fixed, cabin), or a scene file or folder of spectra by its path."""
    field: str
    """A field, or `BASELINES`."""
    combination: str = ""
    """Training frequencies, one of `paper.COMBINATIONS`, and tests at the others; none: both at all."""
    all_tx: bool = False
    """Train with all transmitters, as the paper's tables 2 and 6: only the frequency is new to the field."""
    seed: int = 0
    variant: str = ""
    """Variant of the settings, one of `variants.VARIANTS`."""
    profile: str = "quick"
    """Size, one of `profiles.PROFILES`."""

    @property
    def name(self) -> str:
        """Readable, and unique among the jobs on released scenes of a profile: scene4_wideband_C4_alltx_seed0."""
        place = f"scene{self.scene}" if self.scene[0].isdigit() and self.is_released else Path(self.scene).stem
        words = [place, self.field, self.variant, self.combination, "alltx" if self.all_tx else ""]
        return "_".join([word for word in words if word] + [f"seed{self.seed}"])

    @property
    def is_released(self) -> bool:
        """Whether the scene is one of the released ones."""
        return self.scene in RELEASED_GHZ

    @property
    def budget(self) -> float:
        """Number of spectra it sees, as a multiple of the usual number."""
        return VARIANTS[self.variant].budget

    @property
    def known_ghz(self) -> tuple[float, ...]:
        """Frequencies of the data."""
        if self.is_released:
            return tuple(float(f) for f in RELEASED_GHZ[self.scene])
        return tuple((np.unique(load_dataset(self.scene).frequencies_hz) / 1e9).tolist())

    @property
    def train_ghz(self) -> tuple[float, ...]:
        """Training frequencies."""
        return tuple(float(f) for f in COMBINATIONS[self.combination]) if self.combination else self.known_ghz

    @property
    def test_ghz(self) -> tuple[float, ...]:
        """Test frequencies."""
        return tuple(f for f in self.known_ghz if f not in self.train_ghz) if self.combination else self.known_ghz

    @property
    def pictured(self) -> bool:
        """Whether predicted pictures are kept."""
        shown = self.scene in PICTURED_SCENES and not self.variant and not self.combination
        return shown and self.seed == 0 and self.field != BASELINES and self.profile in TABLE_PROFILES

    def sized(self, profile: str) -> "Job":
        """Returns the job of the tables in another size. Jobs of series keep theirs, but `smoke` makes every job small."""
        keeps = self.profile not in TABLE_PROFILES and profile != "smoke"
        return self if keeps else dataclasses.replace(self, profile=profile)

    def dataset(self) -> Dataset:
        """Returns the scene with this job's training and test spectra."""
        dataset = load_dataset(self.scene)
        if PROFILES[self.profile].validation:
            dataset = validation_as_test(dataset)
        if VARIANTS[self.variant].room:
            dataset = hold_out_box(dataset, *ROOMS[self.scene])
        if (fault := VARIANTS[self.variant].fault) != Fault():
            dataset = faulty(dataset, fault, self.seed)
        if self.field == default_field():  # it learns from a validation part whom to trust, as it does for users
            dataset = hold_out_validation(dataset)
        if self.all_tx:
            everything = np.arange(len(dataset))
            dataset = dataclasses.replace(dataset, train=everything, test=everything)
        if self.combination:
            dataset = unseen_frequencies(dataset, self.train_ghz)
        return some_test_transmitters(dataset, SCORED_TRAINED if self.all_tx else PROFILES[self.profile].scored_tx)

    def models(self) -> Iterator[tuple[str, Dataset]]:
        """Yields a name and the data set of every model that is trained."""
        dataset = self.dataset()
        if self.field not in ONE_FREQUENCY:
            yield "all", dataset
            return
        for ghz in self.test_ghz:
            yield f"{ghz:g}GHz", select_frequencies(dataset, [ghz], [ghz])


def some_test_transmitters(dataset: Dataset, count: int | None) -> Dataset:
    """Returns test spectra of `count` transmitters alone (None: of all); larger counts contain the smaller ones."""
    known = np.unique(dataset.tx_index[dataset.test])
    chosen = np.random.default_rng([0, 5]).permutation(known)[:count]
    return dataclasses.replace(dataset, test=dataset.test[np.isin(dataset.tx_index[dataset.test], chosen)])


def validation_as_test(dataset: Dataset) -> Dataset:
    """Returns the data set with the validation part in the place of the test, which is gone."""
    held = hold_out_validation(dataset)
    return dataclasses.replace(held, validation=held.validation[:0], test=held.validation)
