"""Surfaces of a mesh that is wrong by millimetres to centimetres, put where the spectra say they are, on the host.

A length that is off by a tenth of a wavelength is hardly seen, one that is off by a whole one cannot be told from right. So low
frequencies come first, and each narrows it down for the next: every mover of the facets gets a shift whose effect on phases is
first-order (propagation/motion.py), with steps in proportion to the wavelength; now and then surfaces are moved and paths
traced again. A prior keeps what no path sees where it was. What comes out is kept if it explains training spectra surely better
than the mesh as it was, at frequencies all together.
"""

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from wbgs_jax.config import SearchConfig
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.data import TrainingData
from wbgs_jax.training.materials import search_materials
from wbgs_jax.training.scores import make_scores, surely_better
from wbgs_jax.types import Links

STEP = 0.012
"""Learning rate, in wavelengths of the highest frequency, at most ..."""
LONGEST_STEP = 2e-3
"""... so many metres."""
UNSEEN = 0.03, 0.01
"""Gradient of the loss, per radian of a path's phase, of a surface that is hardly seen: below it, steps shrink with it. Before
surfaces have been moved for the first time, and afterwards: at the lowest frequencies the field's physics is at its worst."""
TRACED_AGAIN = 5.0
"""Ratio of frequencies after which surfaces are moved and paths traced again."""
PRIOR_WEIGHT = 0.01
BATCH = 8
DOUBT = 0.5
"""How much worse high frequencies must be explained than low ones, in logarithms, for the mesh to be doubted."""
KNOWN_BELOW_HZ = 2.5e9
"""Up to where materials are named before surfaces have been moved."""
SURE = 3.0
"""As many standard errors over transmitters as the gain has to be sure by (`surely_better`)."""
RATE = 5e-3
"""Of the materials and corrections that are learned beside."""


@dataclass(frozen=True)
class GeometryReport:
    """What was moved."""

    before: float
    """Mean score of training spectra with the mesh as it was ..."""
    after: float
    """... and with the surfaces moved."""
    kept: bool
    """Whether they stay there."""
    typical_mm: float
    """Root mean square of the shifts of movers, along all axes together ..."""
    largest_mm: float
    """... and the largest."""


@dataclass(frozen=True)
class Place:
    """A field whose surfaces stand somewhere, with the paths of some transmitters there."""

    field: Any
    """A field whose surfaces can be `moved`."""
    params: Any
    cache: Any


def is_doubtful(scores: Float[np.ndarray, "n"], frequency_hz: Float[np.ndarray, "n"]) -> bool:
    """Returns whether the upper half of the frequencies is explained so much worse than the lowest third that lengths must be
    wrong: an error of lengths is one of phases in proportion to the frequency."""
    known = np.unique(frequency_hz)
    if len(known) < 3:
        return False
    low, high = known[: max(1, len(known) // 3)], known[len(known) // 2 :]
    return bool(scores[np.isin(frequency_hz, high)].mean() - scores[np.isin(frequency_hz, low)].mean() > DOUBT)


def learn_geometry(
    place: Place, data: TrainingData, train: Int[np.ndarray, "n"], config: SearchConfig, rng: np.random.Generator
) -> tuple[Place, GeometryReport]:
    """Returns the field with its surfaces where training spectra say they are, its materials named there, and the paths of all
    transmitters; as it was, where that explains spectra no worse."""
    frequency, tx = np.asarray(data.links.query.frequency_hz), np.asarray(data.links.tx_index)
    some_tx = rng.permutation(np.unique(tx[train]))[: config.geometry_tx]
    own = train[np.isin(tx[train], some_tx)]
    links = jax.tree.map(lambda leaf: leaf[own], data.links)
    total = np.zeros((int(np.asarray(place.field.facets.mover).max()) + 1, 3))
    now = _traced(place, place.field, links, data)
    now = _named(now, data, own[frequency[own] <= max(KNOWN_BELOW_HZ, frequency[own].min())], config, rng)
    traced_at = float(frequency[own].min())
    motion = jnp.zeros(total.shape)
    for highest in np.unique(frequency[own]):
        if highest > TRACED_AGAIN * traced_at:
            total, now, motion = _commit(total, now, motion, place.field, links, data)
            now = _named(now, data, own[frequency[own] <= traced_at * TRACED_AGAIN], config, rng)
            traced_at = float(highest)
        pool = own[frequency[own] <= highest * (1 + 1e-6)]
        batches = jnp.asarray(rng.choice(pool, (config.geometry_steps, min(BATCH, len(pool)))), jnp.int32)
        wavelength = SPEED_OF_LIGHT / float(highest)
        rate, unseen = min(STEP * wavelength, LONGEST_STEP), UNSEEN[bool(total.any())] * 2 * np.pi / wavelength
        params, motion = _steps(now.field, now.params, motion, now.cache, data, batches, rate, unseen, config.geometry_width)
        now = dataclasses.replace(now, params=params)
    total, now, _ = _commit(total, now, motion, place.field, None, data)
    moved = _named(dataclasses.replace(now, params=_fresh(place.params, now.params)), data, train, config, rng)
    return _judged(place, moved, total, data, train, config, rng)


def _judged(
    place: Place,
    moved: Place,
    total: Float[np.ndarray, "m 3"],
    data: TrainingData,
    train: Int[np.ndarray, "n"],
    config: SearchConfig,
    rng: np.random.Generator,
) -> tuple[Place, GeometryReport]:
    """Returns the better place: the moved one has to be surely better."""
    spectra = rng.choice(train, min(config.spectra, len(train)), replace=False)
    before, after = (make_scores(p.field, p.cache, data, jnp.asarray(spectra))([p.params])[0] for p in (place, moved))
    kept = surely_better(before - after, np.asarray(data.links.tx_index)[spectra], SURE)
    sizes = 1e3 * np.linalg.norm(total, axis=-1)
    figures = float(before.mean()), float(after.mean()), kept, float(np.sqrt(np.mean(sizes**2))), float(sizes.max())
    return moved if kept else place, GeometryReport(*figures)


def _commit(
    total: Float[np.ndarray, "m 3"],
    now: Place,
    motion: Float[Array, "m 3"],
    original: Any,
    links: Links | None,
    data: TrainingData,
) -> tuple[Float[np.ndarray, "m 3"], Place, Float[Array, "m 3"]]:
    """Moves the surfaces by what has been learned, and traces paths again (of all transmitters without `links`)."""
    total = total + np.asarray(motion, np.float64)
    field = original.moved(total)
    return total, _traced(now, field, data.links if links is None else links, data), jnp.zeros_like(motion)


def _traced(now: Place, field: Any, links: Links, data: TrainingData) -> Place:
    return Place(field, now.params, field.prepare(links, data.receivers))


def _named(
    now: Place, data: TrainingData, spectra: Int[np.ndarray, "n"], config: SearchConfig, rng: np.random.Generator
) -> Place:
    """Names the materials by some spectra."""
    chosen = rng.choice(spectra, min(config.spectra // 4, len(spectra)), replace=False)
    params, _ = search_materials(now.params, make_scores(now.field, now.cache, data, jnp.asarray(chosen)), config)
    return dataclasses.replace(now, params=params)


def _fresh(initial: Any, learned: Any) -> Any:
    """Returns parameters as they were before, but for the materials."""
    return dataclasses.replace(initial, materials=learned.materials)


@partial(jax.jit, static_argnames=("width",))
def _steps(
    field: Any,
    params: Any,
    motion: Float[Array, "m 3"],
    cache: Any,
    data: TrainingData,
    batches: Int[Array, "k b"],
    rate: Any,
    unseen: Any,
    width: float,
) -> tuple[Any, Float[Array, "m 3"]]:
    """Learns shifts, with materials and corrections beside them, on some batches."""
    others = optax.adam(RATE)
    # Steps of shifts shrink to a tenth over the batches.
    shifts = optax.adam(optax.cosine_decay_schedule(1.0, batches.shape[0], 0.1), eps=unseen)

    def objective(learned: Any, index: Int[Array, "b"]) -> Float[Array, ""]:
        params, motion = learned
        batch = data.batch(index, jax.random.key(0))
        plan = dataclasses.replace(field.plan(params, batch.receiver, cache=cache), motion=motion)
        loss, _ = field.planned_loss(params, plan, cache, batch)
        return loss + PRIOR_WEIGHT * jnp.mean((motion / width) ** 2)

    def step(carry: Any, index: Int[Array, "b"]) -> tuple[Any, None]:
        (params, motion), (own, shift) = carry
        gradient, pull = jax.grad(objective)((params, motion), index)
        antennas = jax.tree.map(jnp.zeros_like, (gradient.transmitter, gradient.element))  # found before, and kept
        gradient = dataclasses.replace(gradient, transmitter=antennas[0], element=antennas[1])
        updates, own = others.update(gradient, own)
        moves, shift = shifts.update(pull, shift)
        return ((optax.apply_updates(params, updates), motion + rate * moves), (own, shift)), None

    (learned, _), _ = jax.lax.scan(step, ((params, motion), (others.init(params), shifts.init(motion))), batches)
    return learned
