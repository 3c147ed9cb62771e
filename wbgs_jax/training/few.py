"""What goes with a trained field where few transmitters were measured: simple methods, the field's share, and intervals, all
from cross-validation (host).

A validation part of three transmitters decides nothing. Where there are fewer than `ENOUGH`, simple methods are members of the
answer from the start (training/mixture.py). A field that knows no paths is cross-validated over all of the transmitters, in
blocks (folds.py). One that knows paths takes too long for that; what it does with its validation part has to do.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from wbgs_jax.config import Settings
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.splits import training_links
from wbgs_jax.fields import Field
from wbgs_jax.inference.confidence import Confidence, features
from wbgs_jax.inference.mixture import Mixture
from wbgs_jax.inference.predictor import as_observed, predict_spectra
from wbgs_jax.training.confidence import confidence_of
from wbgs_jax.training.controls import Say
from wbgs_jax.training.data import knows_no_paths
from wbgs_jax.training.folds import held_out_blocks, shortened
from wbgs_jax.training.mixture import ERRORS, ERRORS_WITH_PATHS, Found, HeldOut, Known, learn_mixture

ENOUGH = 20
"""Validation transmitters from which on they decide alone."""


class Training(NamedTuple):
    """What a field was trained with."""

    field: str
    settings: Settings
    steps: int
    """That it took."""
    seed: int
    folder: Path
    devices: int = 0


class Few(NamedTuple):
    """What was found."""

    mixture: Mixture | None
    """None: the field stands alone."""
    confidence: Confidence | None
    """How sure its answers are; None where what was held out is too little, or is left to the validation part."""
    line: str
    """In words."""


def is_few(dataset: Dataset) -> bool:
    """Returns whether a data set's spectra are so few that simple methods are members of the answer."""
    validation = np.unique(dataset.tx_index[dataset.validation])
    return dataset.kind != "power" and dataset.n_receivers == 1 and len(validation) < ENOUGH


def learn_few(field: Field, params: Any, dataset: Dataset, training: Training, say: Say) -> Few:
    """Returns what goes with a trained field."""
    no_paths = knows_no_paths(dataset, type(field))
    known, held = cross_validated(field, params, dataset, training, say)
    if not len(held.links) and not no_paths:
        return Few(None, None, "nothing was held out: the field, which knows paths, answers alone")
    found = learn_mixture(dataset, known, held, ERRORS if no_paths else ERRORS_WITH_PATHS)
    if found.alone:
        return Few(None, None, found.line)
    return Few(found.mixture, _confidence(dataset, held, found), found.line)


def cross_validated(field: Field, params: Any, dataset: Dataset, training: Training, say: Say) -> tuple[Known, HeldOut]:
    """Returns all known spectra, and what fields answer that were not trained on some of them."""
    index = training_links(dataset)
    held = _validation(field, params, dataset, index)
    if knows_no_paths(dataset, type(field)) and jax.process_count() == 1:
        settings = shortened(training.settings, training.steps)
        with_blocks = held_out_blocks(dataset, training.field, settings, training.seed, training.folder, training.devices, say)
        held = _together(with_blocks, held)
    return Known(index, dataset.eight_bit(index)), held


def _validation(field: Field, params: Any, dataset: Dataset, known: Int[np.ndarray, " m"]) -> HeldOut:
    """Returns what a field answers to its validation part, every transmitter a group of its own."""
    index = dataset.validation
    pas = as_observed(field, params, predict_spectra(field, params, dataset, index)) if len(index) else np.zeros((0, 90, 360))
    trained = np.isin(known, dataset.train)
    return HeldOut(index, pas.astype(np.float32), np.tile(trained, (len(index), 1)), dataset.tx_index[index])


def _together(blocks: HeldOut, validation: HeldOut) -> HeldOut:
    """Returns both, the groups told apart."""
    group = validation.group + 1 + blocks.group.max(initial=0)
    return HeldOut(*map(np.concatenate, zip(blocks, validation._replace(group=group), strict=True)))


def _confidence(dataset: Dataset, held: HeldOut, found: Found) -> Confidence | None:
    """Returns how sure the mixture's answers are, from what it answers to what was held out."""
    if len(np.unique(dataset.tx_index[held.links])) < 2:
        return None
    query, receiver = dataset.query(held.links), dataset.receiver()
    trained = jnp.asarray(np.unique(dataset.tx_positions[training_links(dataset)], axis=0), jnp.float32)
    asked = features(jnp.asarray(found.answers, jnp.float32), query, receiver.position, trained)
    known = np.array(asked, np.float64)
    known[:, 0] = 0.5 * np.log(found.distance**2 + 1e-4)  # from those that were left
    return confidence_of(known, found.scores, dataset.tx_index[held.links], receiver.position, trained)
