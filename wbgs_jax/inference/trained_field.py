"""A trained field: how it was trained, its parameters, and what was learned beside it."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from wbgs_jax.config import Settings
from wbgs_jax.data.conventions import ConventionName
from wbgs_jax.data.dataset import Dataset, check_data
from wbgs_jax.data.load import load_dataset
from wbgs_jax.data.splits import (
    VALIDATION,
    fewer_transmitters,
    hold_out_box,
    hold_out_validation,
    select_receivers,
    unseen_frequencies,
)
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params
from wbgs_jax.inference.intervals import Confidence, PowerConfidence
from wbgs_jax.inference.kriging import SAME_PLACE_M, Beside
from wbgs_jax.types import Receiver


@dataclass(frozen=True)
class RunConfig:
    """Everything that determines a run."""

    source: str
    """Scene number, scene file or folder; several with commas between them."""
    field: str
    preset: str
    seed: int
    frequency_ghz: float | None
    """Frequency of a single-frequency folder that does not say."""
    settings: Settings
    train_ghz: tuple[float, ...] = ()
    """Train at these frequencies and test at the others; none: train and test at all."""
    train_tx: int = 0
    """Number of training transmitters; 0: all."""
    validation: float = VALIDATION
    """Share of the training transmitters that is held out for validation, where the data name none."""
    test_box: tuple[float, ...] = ()
    """Test at the transmitters in a box, lowest and highest corner (metres), and train elsewhere; none: as the data say."""
    receiver: int | None = None
    """Number of the only receiver that is looked at; None: all."""
    neighbours: bool = True
    """Whether known spectra are asked beside the field, where that gains on validation."""
    convention: ConventionName | None = None
    """In which the pixels of a folder are ordered; None where there is no folder, or as it is not known yet."""

    def other_data(self, source: str, convention: ConventionName | None = None) -> Dataset:
        """Returns data of any name, read as those that the run was trained on."""
        frequency = None if self.frequency_ghz is None else self.frequency_ghz * 1e9
        return load_dataset(source, frequency_hz=frequency, seed=self.seed, convention=convention)

    def dataset(self) -> Dataset:
        """Returns the data that the run was trained on."""
        dataset = self.other_data(self.source, self.convention)
        if self.receiver is not None:
            dataset = select_receivers(dataset, [self.receiver])
        if self.test_box:
            dataset = hold_out_box(dataset, self.test_box[:3], self.test_box[3:])
        if self.train_ghz:
            dataset = unseen_frequencies(dataset, self.train_ghz)
        if self.train_tx:
            dataset = fewer_transmitters(dataset, self.train_tx, self.seed)
        return hold_out_validation(dataset, self.validation) if self.validation else dataset


@dataclass(frozen=True)
class TrainedField:
    """A field with the parameters of a run's newest checkpoint."""

    config: RunConfig
    field: Field
    params: Params
    step: int
    seconds: float
    """Training time."""
    neighbours: Beside = None
    """Known spectra that are asked beside it."""
    confidence: Confidence | None = None
    """How sure its answers are."""
    power_confidence: PowerConfidence | None = None
    """How sure the received powers are that it says."""
    data: str = ""
    """Checksum of the data that it was trained on; empty where nobody has kept it."""

    def dataset(self) -> Dataset:
        """Returns the data that it was trained on; others under the same name are a `UserError`."""
        return check_data(self.config.dataset(), self.data, f"this run ({self.config.source})")

    def origin(self) -> dict[str, Any]:
        """Returns where it comes from: field, preset, seed and step."""
        return {name: getattr(self.config, name) for name in ("field", "preset", "seed")} | {"step": self.step}


def at_receiver(trained: TrainedField, receiver: Receiver, dataset: Dataset | None = None) -> TrainedField:
    """Returns a trained field for another receiver than those of its data: another place, orientation or array. At one of its
    own receivers it is what it was; elsewhere it is the part that holds anywhere (the coherent field), without neighbours and
    without a word on how sure it is, which nobody has measured there. `dataset` is what it was trained on, where it is read
    already.

    Raises:
        UserError: nothing of the field holds elsewhere.
    """
    dataset = trained.dataset() if dataset is None else dataset
    if any(_same(dataset.receiver(number), receiver) for number in range(dataset.n_receivers)):
        return trained
    field, params = trained.field.receiver_independent(trained.params)
    return dataclasses.replace(trained, field=field, params=params, neighbours=None, confidence=None, power_confidence=None)


def at_receivers(trained: TrainedField, dataset: Dataset) -> TrainedField:
    """Returns a trained field for all receivers of other data (`at_receiver`): as it is if it was trained at every one."""
    own = trained.dataset()
    for number in range(dataset.n_receivers):
        if (elsewhere := at_receiver(trained, dataset.receiver(number), own)) is not trained:
            return elsewhere
    return trained


def _same(a: Receiver, b: Receiver) -> bool:
    if np.vdot(a.orientation, b.orientation) < 0:  # a quaternion and its negative are one turn
        b = dataclasses.replace(b, orientation=-b.orientation)
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return a.unit == b.unit and all(x.shape == y.shape and np.allclose(x, y, atol=SAME_PLACE_M) for x, y in leaves)
