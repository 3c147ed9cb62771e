"""A trained field: the configuration of its run, its parameters, and the corrections and intervals learned afterwards."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.public_names import warn_renamed
from wbgs_jax.config import Settings
from wbgs_jax.data.conventions import ConventionName
from wbgs_jax.data.dataset import (
    VALIDATION,
    Dataset,
    check_data,
    fewer_transmitters,
    hold_out_box,
    hold_out_validation,
    select_receivers,
    unseen_frequencies,
)
from wbgs_jax.data.image_folder import records_frequency
from wbgs_jax.data.load import load_dataset, source_names, source_paths
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params
from wbgs_jax.inference.intervals import Confidence, PowerConfidence
from wbgs_jax.inference.kriging import SAME_PLACE_M, Beside, same_orientation
from wbgs_jax.types import Receiver, check_receiver


@dataclass(frozen=True)
class RunConfig:
    """Everything that determines a run."""

    source: str
    """Scene number, scene file or folder; several are separated by commas."""
    field: str
    preset: str
    seed: int
    frequency_ghz: float | None
    """Frequency of a single-frequency folder that does not record it."""
    settings: Settings
    train_ghz: tuple[float, ...] = ()
    """Frequencies for training, the others being for the test; empty: all frequencies are in both."""
    train_tx: int = 0
    """Number of training transmitters; 0: all."""
    validation: float = VALIDATION
    """Fraction of the training transmitters held out for validation, if the data define no validation part."""
    test_box: tuple[float, ...] = ()
    """Box of the test transmitters (lowest and highest corner, metres), others being for training; empty: split of the data."""
    receiver: int | None = None
    """Index of the only receiver that is used; None: all."""
    neighbours: bool = True
    """Whether measured spectra correct the predictions, if that improves the validation score."""
    convention: ConventionName | None = None
    """Pixel order of a folder's images; None without a folder, or if not yet determined."""

    def other_data(self, source: str) -> Dataset:
        """Returns other data by name, read with the seed of the training data, and with their frequency if they record none."""
        recorded = all(map(records_frequency, source_names(source)))
        return load_dataset(source, frequency_hz=None if recorded else self._frequency_hz, seed=self.seed)

    def dataset(self) -> Dataset:
        """Returns the training data of the run."""
        dataset = load_dataset(self.source, self._frequency_hz, self.seed, convention=self.convention)
        if self.receiver is not None:
            dataset = select_receivers(dataset, [self.receiver])
        if self.test_box:
            dataset = hold_out_box(dataset, self.test_box[:3], self.test_box[3:])
        if self.train_ghz:
            dataset = unseen_frequencies(dataset, self.train_ghz)
        if self.train_tx:
            dataset = fewer_transmitters(dataset, self.train_tx, self.seed)
        return hold_out_validation(dataset, self.validation) if self.validation else dataset

    @property
    def _frequency_hz(self) -> float | None:
        return None if self.frequency_ghz is None else self.frequency_ghz * 1e9


@dataclass(frozen=True)
class TrainedField:
    """A field with the parameters of a run's newest checkpoint."""

    config: RunConfig
    field: Field
    params: Params
    step: int
    seconds: float
    """Training time."""
    correction: Beside = None
    """Measured spectra that correct its predictions: residual kriging, or a mixture with simple methods."""
    intervals: Confidence | None = None
    """Regression for the prediction intervals of spectra."""
    power_intervals: PowerConfidence | None = None
    """Regression for the prediction intervals of received powers."""
    data: str = ""
    """Checksum of the training data; empty if it was not recorded."""

    def dataset(self) -> Dataset:
        """Returns the training data; missing data, or different data of the same name, are a `UserError`."""
        for path in source_paths(self.config.source):
            if path.is_absolute() and not path.exists():
                raise UserError(f"the data of this training, {path}, are missing; put them back there")
        return check_data(self.config.dataset(), self.data, f"this run ({self.config.source})")

    @property
    def neighbours(self) -> Beside:
        """`correction` by its earlier name."""
        warn_renamed("wbgs_jax.TrainedField.neighbours", "correction")
        return self.correction

    @property
    def confidence(self) -> Confidence | None:
        """`intervals` by its earlier name."""
        warn_renamed("wbgs_jax.TrainedField.confidence", "intervals")
        return self.intervals

    @property
    def power_confidence(self) -> PowerConfidence | None:
        """`power_intervals` by its earlier name."""
        warn_renamed("wbgs_jax.TrainedField.power_confidence", "power_intervals")
        return self.power_intervals

    def origin(self) -> dict[str, Any]:
        """Returns its provenance: field, preset, seed and step."""
        return {name: getattr(self.config, name) for name in ("field", "preset", "seed")} | {"step": self.step}


def at_receiver(trained: TrainedField, receiver: Receiver, dataset: Dataset | None = None) -> TrainedField:
    """Returns a trained field for a receiver that may differ from those of its data in position, orientation or array.

    For a receiver of its data, the field is returned unchanged. For any other receiver, its receiver-independent part (the
    coherent field) is returned, without residual kriging or mixture and without prediction intervals, for which there are no
    measurements at that receiver.

    Args:
        trained: a trained field.
        receiver: the receiver to be predicted for.
        dataset: the training data; loaded if not passed.

    Returns:
        The field for this receiver.

    Raises:
        UserError: no part of the field is receiver-independent.
        TypeError, ValueError: the receiver is not a single one, made of arrays.
    """
    check_receiver(receiver)
    dataset = trained.dataset() if dataset is None else dataset
    if receiver_number(dataset, receiver) is not None:
        return trained
    field, params = trained.field.receiver_independent(trained.params)
    return dataclasses.replace(trained, field=field, params=params, correction=None, intervals=None, power_intervals=None)


def at_receivers(trained: TrainedField, dataset: Dataset) -> TrainedField:
    """Returns a trained field for all receivers of other data (`at_receiver`), unchanged if it was trained for all of them."""
    own = trained.dataset()
    for number in range(dataset.n_receivers):
        if (elsewhere := at_receiver(trained, dataset.receiver(number), own)) is not trained:
            return elsewhere
    return trained


def receiver_number(dataset: Dataset, receiver: Receiver) -> int | None:
    """Returns the index of a receiver in the data: the same array at the same place in the same orientation; None if there is
    no such receiver."""
    return next((number for number in range(dataset.n_receivers) if _same(dataset.receiver(number), receiver)), None)


def _same(a: Receiver, b: Receiver) -> bool:
    kind, other = ((jax.tree.structure(one), [np.shape(leaf) for leaf in jax.tree.leaves(one)]) for one in (a, b))
    if kind != other:
        return False
    elements = np.asarray(a.element_positions)
    tolerance = 1e-4 * np.linalg.norm(elements - elements[:1], axis=-1).max(initial=0)  # in the unit of the elements
    antennas = zip(jax.tree.leaves(a.antenna), jax.tree.leaves(b.antenna), strict=True)
    return (
        bool(np.linalg.norm(np.subtract(a.position, b.position)) < SAME_PLACE_M)
        and same_orientation(a.orientation, b.orientation)
        and np.allclose(elements, b.element_positions, atol=tolerance)
        and all(np.allclose(x, y, atol=1e-6) for x, y in antennas)
    )
