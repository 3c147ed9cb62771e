"""Corrections of a trained field if few transmitters were measured: simple methods, the weight of the field, and prediction
intervals, all from cross-validation (host).

A validation part of a few transmitters is not sufficient to decide anything. If there are fewer than 20, simple methods may be
part of the mixture (training/fit_mixture.py). A field without paths is cross-validated over all transmitters, in blocks
(`held_out_blocks`): it is trained briefly several times, each time without a block of transmitters. A field with paths takes
too long for that; only its predictions for the validation part are used.

The transmitters of a block are adjacent in space, so that its centre is as far from the data as queries from elsewhere are.
Random transmitters would lie between those that are trained.
"""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from wbgs_jax._util.files import atomic_write, read_arrays
from wbgs_jax.config import Settings
from wbgs_jax.data.dataset import VALIDATION, Dataset, places_of, training_links
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params
from wbgs_jax.inference.intervals import Confidence, features
from wbgs_jax.inference.kriging import Mixture
from wbgs_jax.inference.predictor import as_observed, predict_spectra
from wbgs_jax.training.batches import knows_no_paths
from wbgs_jax.training.fit_intervals import FEWEST, confidence_of
from wbgs_jax.training.fit_mixture import Found, HeldOut, Known, learn_mixture
from wbgs_jax.training.hooks import Say
from wbgs_jax.training.loop import train

FOLDS = 4
"""Number of blocks; if there are fewer transmitters, each is a block."""
FOLDER = "folds"


def blocks(positions: Float[np.ndarray, "n 3"], tx_index: Int[np.ndarray, " n"], count: int = FOLDS) -> Int[np.ndarray, " n"]:
    """Returns the block (0, 1, ...) of every link: the largest part of the transmitters is halved along the axis of its largest
    extent until there are `count` parts. `positions` are those of the transmitters, metres."""
    transmitters, first = np.unique(tx_index, return_index=True)
    places = positions[first]
    parts = [np.arange(len(transmitters))]
    while len(parts) < min(count, len(transmitters)):
        largest = parts.pop(int(np.argmax([len(part) for part in parts])))
        axis = np.ptp(places[largest], axis=0).argmax()
        ordered = largest[np.argsort(places[largest, axis], kind="stable")]
        parts += [ordered[: len(ordered) // 2], ordered[len(ordered) // 2 :]]
    block = np.empty(len(transmitters), int)
    for number, part in enumerate(parts):
        block[part] = number
    return block[np.searchsorted(transmitters, tx_index)]


def held_out_blocks(
    dataset: Dataset, field: str, settings: Settings, seed: int, folder: Path, devices: int, say: Callable[[str], None]
) -> HeldOut:
    """Returns the predictions of a field for blocks of measured links that were left out of short trainings; there are none for
    a single transmitter.

    Finished blocks are stored in `folder` until all are finished.

    Args:
        dataset: data of one receiver.
        field: name of the field.
        settings: settings of the short trainings (`shortened`).
        seed: seed of the training.
        folder: folder of the run.
        devices: number of devices that share every batch.
        say: called with a description of each stage.
    """
    known, place = training_links(dataset), folder / FOLDER
    block = blocks(dataset.tx_positions[known], places_of(dataset)[known])
    count = int(block.max()) + 1
    if count < 2:
        return HeldOut(known[:0], np.zeros((0, 90, 360), np.float32), np.zeros((0, len(known)), bool), known[:0])
    answers = []
    for number in range(count):
        say(f"cross-validation: training without block {number + 1} of {count}")
        answers.append(_answers(dataset, known, block == number, field, settings, seed, place / str(number), devices))
    shutil.rmtree(place, ignore_errors=True)
    index = np.concatenate([own for own, _ in answers])
    group = block[np.searchsorted(known, index)]
    return HeldOut(index, np.concatenate([pas for _, pas in answers]), block[None] != group[:, None], group)


def _answers(
    dataset: Dataset,
    known: Int[np.ndarray, " m"],
    left_out: Bool[np.ndarray, " m"],
    field: str,
    settings: Settings,
    seed: int,
    place: Path,
    devices: int,
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 90 360"]]:
    """Returns links of a block, and their spectra predicted by a field that was trained without this block."""
    answered = 60  # maximum number of links per block for which predictions are made
    index = np.sort(np.random.default_rng(4).permutation(known[left_out])[:answered])
    done = place.with_suffix(".npz")
    if done.exists():
        return index, read_arrays(done, "cross-validation", "remove it; --resume creates it again")["pas"].astype(np.float32)
    part = dataclasses.replace(dataset, train=known[~left_out], validation=known[left_out])
    place.mkdir(parents=True, exist_ok=True)
    trained = train(part, field, settings, seed, place, resume=True, devices=devices, shown=False)
    pas = predict_spectra(trained.field, trained.params, dataset, index).astype(np.float16)
    with atomic_write(done) as stream:
        np.savez_compressed(stream, pas=pas)
    shutil.rmtree(place, ignore_errors=True)
    return index, pas.astype(np.float32)  # as it is read after an interruption


def shortened(settings: Settings, steps: int) -> Settings:
    """Returns settings with a fraction of a number of steps, rounded to whole epochs, without evaluation and with few
    checkpoints."""
    block = settings.loop.epoch_steps
    # Steps of each of these trainings, relative to the whole training; a field that is trained for longer is not worse.
    share = 0.25
    steps = max(round(share * steps / block), 1) * block
    optim = dataclasses.replace(settings.optim, steps=steps, min_steps=0, max_epochs=1e9)
    loop = dataclasses.replace(settings.loop, evaluate_spectra=0, checkpoint_every=10 * steps)
    return dataclasses.replace(settings, optim=optim, loop=loop)


class Training(NamedTuple):
    """The arguments of the training of a field."""

    field: str
    settings: Settings
    steps: int
    """Number of steps that were done."""
    seed: int
    folder: Path
    devices: int = 0


class Few(NamedTuple):
    """Result of the cross-validation."""

    mixture: Mixture | None
    """Mixture with simple methods; None to use the field alone."""
    confidence: Confidence | None
    """Prediction intervals; None if too few links were held out, or, without a mixture, if they are to be fitted on the
    validation part."""
    line: str
    """Summary for the terminal."""


def is_few(dataset: Dataset) -> bool:
    """Returns whether a dataset has so few spectra that simple methods are part of the mixture."""
    held, known = (len(np.unique(places_of(dataset)[links])) for links in (dataset.validation, training_links(dataset)))
    enough = 20  # validation transmitters, from which on the validation part alone is sufficient
    few = held < enough and known * VALIDATION < enough
    return dataset.has_spectra and dataset.n_receivers == 1 and few


def learn_few(field: Field, params: Params, dataset: Dataset, training: Training, say: Say) -> Few:
    """Returns the mixture and the prediction intervals of a trained field, from cross-validation."""
    no_paths = knows_no_paths(dataset, type(field))
    if not len(dataset.validation) and not no_paths:
        return Few(None, None, "no links were held out: the field, which predicts paths, is used alone")
    known, held = cross_validated(field, params, dataset, training, say)
    dataset = dataclasses.replace(dataset, tx_index=places_of(dataset))  # no paths are looked up below
    found = learn_mixture(dataset, known, held, with_paths=not no_paths)
    if found.alone and not no_paths:
        return Few(None, None, found.line)
    return Few(None if found.alone else found.mixture, _confidence(dataset, held, found), found.line)


def cross_validated(field: Field, params: Params, dataset: Dataset, training: Training, say: Say) -> tuple[Known, HeldOut]:
    """Returns all measured spectra, and held-out predictions of fields that were not trained on some of them."""
    index = training_links(dataset)
    if knows_no_paths(dataset, type(field)) and jax.process_count() == 1:
        settings = shortened(training.settings, training.steps)
        held = held_out_blocks(dataset, training.field, settings, training.seed, training.folder, training.devices, say)
    else:
        held = _validation(field, params, dataset, index)
    return Known(index, dataset.eight_bit(index)), held


def _validation(field: Field, params: Params, dataset: Dataset, known: Int[np.ndarray, " m"]) -> HeldOut:
    """Returns the predictions of a field for its validation part; every transmitter is a group."""
    index = dataset.validation
    pas = as_observed(field, params, predict_spectra(field, params, dataset, index)) if len(index) else np.zeros((0, 90, 360))
    trained = np.isin(known, dataset.train)
    return HeldOut(index, pas.astype(np.float32), np.tile(trained, (len(index), 1)), places_of(dataset)[index])


def _confidence(dataset: Dataset, held: HeldOut, found: Found) -> Confidence | None:
    """Returns prediction intervals of the mixture, from its predictions for held-out links with measurements at their
    frequency; None if these are too few."""
    measured = np.isfinite(found.distance)
    index = held.links[measured]
    if len(index) < FEWEST or len(np.unique(dataset.tx_index[index])) < 2:
        return None
    receiver = dataset.receiver()
    trained = jnp.asarray(np.unique(dataset.tx_positions[training_links(dataset)], axis=0), jnp.float32)
    inputs = features(jnp.asarray(found.answers[measured], jnp.float32), dataset.query(index), receiver.position, trained)
    known = np.array(inputs, np.float64)
    known[:, 0] = 0.5 * np.log(_distances(dataset, held)[measured] ** 2 + 1e-4)
    everywhere = found.alone or bool(np.isnan(found.mixture.frequency_hz).all())
    corrected_hz = () if everywhere else np.unique(dataset.frequencies_hz[training_links(dataset)])
    return confidence_of(known, found.scores[measured], dataset.tx_index[index], receiver.position, trained, corrected_hz)


def _distances(dataset: Dataset, held: HeldOut) -> Float[np.ndarray, " n"]:
    """Returns the distances (metres) of held-out links to the nearest transmitter that was not left out, at any frequency, as
    queries measure them."""
    places = dataset.tx_positions[training_links(dataset)]
    pairs = zip(dataset.tx_positions[held.links], held.known, strict=True)
    return np.array([np.linalg.norm(places[use] - place, axis=-1).min(initial=np.inf) for place, use in pairs])
