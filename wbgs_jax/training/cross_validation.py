"""What goes with a trained field where few transmitters were measured: simple methods, the field's share, and intervals, all
from cross-validation (host).

A validation part of three transmitters decides nothing. Where there are fewer than `ENOUGH`, simple methods are members of the
answer from the start (training/fit_mixture.py). A field that knows no paths is cross-validated over all of the transmitters, in
blocks (`held_out_blocks`). One that knows paths takes too long for that; what it does with its validation part has to do.

What a field answers to links that it was not trained on: short trainings, each without a block of transmitters (host).

A block lies together in space, so that its middle is as far from the data as queries are that come from elsewhere. Random
transmitters would lie between those that are trained.
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
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.splits import training_links
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params
from wbgs_jax.inference.intervals import Confidence, features
from wbgs_jax.inference.mixture import Mixture
from wbgs_jax.inference.predictor import as_observed, predict_spectra
from wbgs_jax.training.batches import knows_no_paths
from wbgs_jax.training.fit_intervals import confidence_of
from wbgs_jax.training.fit_mixture import ERRORS, ERRORS_WITH_PATHS, Found, HeldOut, Known, learn_mixture
from wbgs_jax.training.hooks import Say
from wbgs_jax.training.loop import train

FOLDS = 4
"""Blocks; fewer transmitters than that are left out one at a time."""
SHARE = 0.25
"""Of the steps of a training that each of these has: a field that is trained for longer is no worse."""
ANSWERED = 60
"""Links of a block that are answered, at most."""
FOLDER = "folds"


def blocks(positions: Float[np.ndarray, "n 3"], tx_index: Int[np.ndarray, " n"], count: int = FOLDS) -> Int[np.ndarray, " n"]:
    """Returns the block (0, 1, ...) of every link: transmitters are halved along the axis of their largest extent, and the
    larger part again, until there are so many."""
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
    """Returns what a field answers to blocks of known links that short trainings did without; none of a single transmitter.

    What is done is kept in `folder` until all of it is.

    Args:
        dataset: of one receiver.
        field: its name.
        settings: of the training whose field is to be judged.
        seed: of that training.
        folder: of its run.
        devices: that share every batch.
        say: is called with what goes on.
    """
    known, place = training_links(dataset), folder / FOLDER
    block = blocks(dataset.tx_positions[known], dataset.tx_index[known])
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
    """Returns links of a block and what a field answers that was trained without it."""
    index = np.sort(np.random.default_rng(4).permutation(known[left_out])[:ANSWERED])
    done = place.with_suffix(".npz")
    if done.exists():
        return index, read_arrays(done, "cross-validation", "remove it, and --resume makes it again")["pas"].astype(np.float32)
    part = dataclasses.replace(dataset, train=known[~left_out], validation=known[left_out])
    place.mkdir(parents=True, exist_ok=True)
    trained = train(part, field, settings, seed, place, resume=True, devices=devices, shown=False)
    pas = predict_spectra(trained.field, trained.params, dataset, index)
    with atomic_write(done) as stream:
        np.savez_compressed(stream, pas=pas.astype(np.float16))
    shutil.rmtree(place, ignore_errors=True)
    return index, pas


def shortened(settings: Settings, steps: int) -> Settings:
    """Returns settings with a share of so many steps, a multiple of the epoch; there is nothing to watch and little to save."""
    block = settings.loop.epoch_steps
    steps = max(round(SHARE * steps / block), 1) * block
    optim = dataclasses.replace(settings.optim, steps=steps, min_steps=0, max_epochs=1e9)
    loop = dataclasses.replace(settings.loop, evaluate_spectra=0, checkpoint_every=10 * steps)
    return dataclasses.replace(settings, optim=optim, loop=loop)


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
    return dataset.has_spectra and dataset.n_receivers == 1 and len(validation) < ENOUGH


def learn_few(field: Field, params: Params, dataset: Dataset, training: Training, say: Say) -> Few:
    """Returns what goes with a trained field."""
    no_paths = knows_no_paths(dataset, type(field))
    known, held = cross_validated(field, params, dataset, training, say)
    if not len(held.links) and not no_paths:
        return Few(None, None, "nothing was held out: the field, which knows paths, answers alone")
    found = learn_mixture(dataset, known, held, ERRORS if no_paths else ERRORS_WITH_PATHS)
    if found.alone:
        return Few(None, None, found.line)
    return Few(found.mixture, _confidence(dataset, held, found), found.line)


def cross_validated(field: Field, params: Params, dataset: Dataset, training: Training, say: Say) -> tuple[Known, HeldOut]:
    """Returns all known spectra, and what fields answer that were not trained on some of them."""
    index = training_links(dataset)
    held = _validation(field, params, dataset, index)
    if knows_no_paths(dataset, type(field)) and jax.process_count() == 1:
        settings = shortened(training.settings, training.steps)
        with_blocks = held_out_blocks(dataset, training.field, settings, training.seed, training.folder, training.devices, say)
        held = _together(with_blocks, held)
    return Known(index, dataset.eight_bit(index)), held


def _validation(field: Field, params: Params, dataset: Dataset, known: Int[np.ndarray, " m"]) -> HeldOut:
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
