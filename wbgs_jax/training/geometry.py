"""Surfaces of a mesh that is wrong by millimetres to centimetres, put where the spectra say they are, on the host.

A length that is off by a tenth of a wavelength is hardly seen, one that is off by a whole one cannot be told from right. So low
frequencies come first, and each narrows it down for the next: every mover of the facets, and the receiver, gets a small rigid
motion whose effect on phases is first-order (propagation/motion.py), with steps in proportion to the wavelength; now and then
things are moved and paths traced again. All the while waves are as coherent as places are known by then: snapshots are compared
with what they may be if every surface still stands a twentieth of a wavelength off (`losses.surprise`). Materials are named in
the same way, since powers tell where phases cannot, and once more by phases in the end. A prior keeps what no path sees where
it was. What comes out is kept if it says training spectra surely better than the mesh as it was, each with as much doubt as
suits it.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from wbgs_jax.config import SearchConfig
from wbgs_jax.fields.base import compare
from wbgs_jax.fields.losses import surprise
from wbgs_jax.propagation.facets import centres
from wbgs_jax.propagation.motion import Motion
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.data import TrainingData
from wbgs_jax.training.materials import search_materials
from wbgs_jax.training.placement import search_placement
from wbgs_jax.training.scores import Compared, Scores, make_scores, surely_better
from wbgs_jax.types import Links

STEP = 0.012
"""Learning rate, in wavelengths of the highest frequency, at most ..."""
LONGEST_STEP = 2e-3
"""... so many metres."""
UNSEEN = 3e-3
"""Gradient of the loss, per radian of a path's phase, of a surface that is hardly seen: below it, steps shrink with it."""
SPREAD = 0.05
"""How far surfaces are taken to be off, in wavelengths of the highest frequency; at most as far as the prior says."""
TRACED_AGAIN = 5.0
"""Ratio of frequencies after which surfaces are moved and paths traced again."""
WIDTHS = {"turn": 1e-3, "receiver": 1e-3, "receiver_turn": 2e-3}
"""Standard deviations (radians, metres) of how far surfaces are turned, and the receiver stands elsewhere and is turned. What
seems to be the receiver's is mostly what all walls have in common: where it is free to go, it goes away with them."""
BATCH = 8
SURE = 2.0
"""As many standard errors over transmitters as the gain has to be sure by (`surely_better`): the mesh is doubted already."""
SHORTEST_ARM = 0.05
"""Metres: smaller things turn like one of this size."""
RATE = 5e-3
"""Of the materials and corrections that are learned beside ..."""
SEARCHED = ("transmitter", "element", "placement", "thick", "curved")
"""... these, which are searched elsewhere and stay as they were found."""


@dataclass(frozen=True)
class GeometryReport:
    """What was moved."""

    before: float
    """Mean score of training spectra with the mesh as it was ..."""
    after: float
    """... and with things moved."""
    kept: bool
    """Whether they stay there."""
    typical_mm: float
    """Root mean square of the shifts of movers, along all axes together ..."""
    largest_mm: float
    """... and the largest; ..."""
    largest_deg: float
    """... and by how much any of them was turned."""
    receiver_mm: float
    """How far the receiver was moved ..."""
    receiver_deg: float
    """... and turned."""


@dataclass(frozen=True)
class Place:
    """A field in which things stand somewhere, with the paths of some transmitters there."""

    field: Any
    """A field that can be `moved`."""
    params: Any
    cache: Any


@dataclass(frozen=True)
class _Told:
    """Some training spectra, and what they say of a place."""

    data: TrainingData
    spectra: Int[np.ndarray, " n"]
    config: SearchConfig
    rng: np.random.Generator

    def scores(self, now: Place, count: int, compared: Compared) -> Scores:
        """Returns the function that scores candidates for a place's parameters on a few of them, drawn anew."""
        chosen = self.rng.choice(self.spectra, min(count, len(self.spectra)), replace=False)
        return make_scores(now.field, now.cache, self.data, jnp.asarray(chosen), compared)

    def named(self, now: Place, rounds: int, compared: Compared = "covariances") -> Place:
        """Names the materials: as far as places are believed, or as if all of them were known."""
        count = self.config.geometry_spectra if compared == "covariances" else self.config.spectra
        once = dataclasses.replace(self.config, rounds=rounds)
        params, _ = search_materials(now.params, self.scores(now, count, compared), once)
        return dataclasses.replace(now, params=params)

    def guessed(self, now: Place, compared: Compared = "covariances") -> Place:
        """Believes places as far as spectra say."""
        params, _ = search_placement(now.params, self.scores(now, self.config.placement_spectra, compared))
        return dataclasses.replace(now, params=params)


def learn_geometry(
    place: Place, data: TrainingData, train: Int[np.ndarray, " n"], config: SearchConfig, rng: np.random.Generator
) -> tuple[Place, GeometryReport]:
    """Returns the field with its surfaces where training spectra say they are, its materials named there, and the paths of all
    transmitters; as it was, where that explains spectra no worse."""
    frequency, tx = np.asarray(data.links.query.frequency_hz), np.asarray(data.links.tx_index)
    some_tx = rng.permutation(np.unique(tx[train]))[: config.geometry_tx]
    own = train[np.isin(tx[train], some_tx)]
    links = jax.tree.map(lambda leaf: leaf[own], data.links)
    alike = dataclasses.replace(place.params, materials=place.field.init(jax.random.key(0)).materials)
    now = _traced(place.field, alike, links, data)
    told, told_by_all = _Told(data, own, config, rng), _Told(data, train, config, rng)
    now = told.named(_doubted(now, config.geometry_width), config.rounds)
    traced_at, none = float(frequency[own].min()), jax.tree.map(jnp.zeros_like, place.field.motion)
    motion = none
    for highest in np.unique(frequency[own]):
        if highest > TRACED_AGAIN * traced_at:
            now, motion = _traced(now.field.moved(motion), now.params, links, data), none
            now = told.named(now, 1)
            traced_at = float(highest)
        pool = own[frequency[own] <= highest * (1 + 1e-6)]
        batches = jnp.asarray(rng.choice(pool, (config.geometry_steps, min(BATCH, len(pool)))), jnp.int32)
        wavelength = SPEED_OF_LIGHT / float(highest)
        now = _doubted(now, min(SPREAD * wavelength, config.geometry_width))
        rate, unseen = min(STEP * wavelength, LONGEST_STEP), UNSEEN * 2 * np.pi / wavelength
        prior = _prior(now.field.motion, config.geometry_width, len(pool) * data.receivers.element_positions.shape[-2])
        params, motion = _steps(now.field, now.params, motion, now.cache, data, batches, rate, unseen, prior)
        now = dataclasses.replace(now, params=params)
    moved = _traced(now.field.moved(motion), _fresh(now.params, place.params), data.links, data)
    moved = told_by_all.named(told_by_all.guessed(moved), 1)
    return _judged(place, [moved, told_by_all.named(moved, config.rounds, "snapshots")], told_by_all)


def _judged(place: Place, moved: list[Place], told: _Told) -> tuple[Place, GeometryReport]:
    """Returns the best place, with its uncertainty. A moved one has to be surely better at what counts in the end, spectra: the
    likelihood of snapshots forgives a wrong mesh that is doubted enough."""
    spectra = told.rng.choice(told.spectra, min(told.config.spectra, len(told.spectra)), replace=False)
    as_it_was, *others = (told.guessed(one, "spectra") for one in (place, *moved))
    before, *after = (
        make_scores(one.field, one.cache, told.data, jnp.asarray(spectra), "spectra")([one.params])[0]
        for one in (as_it_was, *others)
    )
    best = int(np.argmin([own.mean() for own in after]))
    kept = surely_better(before - after[best], np.asarray(told.data.links.tx_index)[spectra], SURE)
    sizes = _sizes(others[best].field.motion)
    report = GeometryReport(float(before.mean()), float(after[best].mean()), kept, **sizes)
    return others[best] if kept else as_it_was, report


def _sizes(motion: Motion) -> dict[str, float]:
    """Returns how far things were moved."""
    size = jax.tree.map(lambda leaf: np.linalg.norm(np.asarray(leaf), axis=-1), motion)
    return {
        "typical_mm": float(1e3 * np.sqrt(np.mean(size.shift**2))),
        "largest_mm": float(1e3 * size.shift.max()),
        "largest_deg": float(np.rad2deg(size.turn.max())),
        "receiver_mm": float(1e3 * size.receiver),
        "receiver_deg": float(np.rad2deg(size.receiver_turn)),
    }


def _traced(field: Any, params: Any, links: Links, data: TrainingData) -> Place:
    return Place(field, params, field.prepare(links, data.receivers))


def _doubted(now: Place, spread: float) -> Place:
    """Believes that every surface may be off by so many metres (standard deviation); transmitters are where they are said."""
    placement = now.params.placement
    spreads = jnp.full_like(placement, np.log(spread)).at[-1].set(placement[-1])
    return dataclasses.replace(now, params=dataclasses.replace(now.params, placement=spreads))


def _fresh(learned: Any, initial: Any) -> Any:
    """Returns parameters as they were before, but for the materials and how far places are believed."""
    return dataclasses.replace(initial, materials=learned.materials, placement=learned.placement)


@jax.jit
def _steps(
    field: Any,
    params: Any,
    motion: Motion,
    cache: Any,
    data: TrainingData,
    batches: Int[Array, "k b"],
    rate: Any,
    unseen: Any,
    prior: Motion,
) -> tuple[Any, Motion]:
    """Learns a motion, with materials and corrections beside it, on some batches."""
    others, reach = optax.adam(RATE), _reach(field)
    # Steps of motions shrink to a tenth over the batches.
    shifts = optax.adam(optax.cosine_decay_schedule(1.0, batches.shape[0], 0.1), eps=unseen)

    def objective(learned: Any, index: Int[Array, " b"]) -> Float[Array, ""]:
        params, metres = learned
        batch = data.batch(index, jax.random.key(0))
        motion = _by(metres, reach)
        plan = field.displaced(field.plan(params, batch.receiver, cache=cache), motion)
        seen = field.render_links(params, plan, cache, batch.links)
        if seen.covariance is None or batch.snapshots is None:
            loss, _ = compare(seen, batch)
        else:
            loss = jnp.mean(surprise(seen.covariance, batch.snapshots))
        total = jax.tree.map(jnp.add, field.motion, motion)
        pulled = jax.tree.map(lambda stiffness, far: 0.5 * jnp.sum(stiffness * far**2), prior, total)
        return loss + field.penalty(params) + sum(jax.tree.leaves(pulled))

    def step(carry: Any, index: Int[Array, " b"]) -> tuple[Any, None]:
        (params, metres), (own, shift) = carry
        gradient, pull = jax.grad(objective)((params, metres), index)
        still = {name: jax.tree.map(jnp.zeros_like, getattr(gradient, name)) for name in SEARCHED}
        gradient = dataclasses.replace(gradient, **still)
        updates, own = others.update(gradient, own)
        moves, shift = shifts.update(pull, shift)
        metres = jax.tree.map(lambda leaf, move: leaf + rate * move, metres, moves)
        return ((optax.apply_updates(params, updates), metres), (own, shift)), None

    metres = jax.tree.map(lambda leaf, one: leaf * one, motion, reach)
    ((params, metres), _), _ = jax.lax.scan(step, ((params, metres), (others.init(params), shifts.init(metres))), batches)
    return params, _by(metres, reach)


def _prior(motion: Motion, width: float, numbers: int) -> Motion:
    """Returns how stiffly everything is held where the data say it stands: the curvature of its normal prior, beside a loss
    that is a mean over so many numbers."""
    widths = {"shift": width} | WIDTHS
    return Motion(**{name: jnp.full_like(getattr(motion, name), 1 / (far**2 * numbers)) for name, far in widths.items()})


def _reach(field: Any) -> Motion:
    """Returns how far (metres) a motion of 1 metre or radian moves what it moves; the receiver's turn moves no more than phases
    along its array, and counts like metres."""
    facets, movers = field.facets, len(field.motion.shift)
    arms = jnp.linalg.norm(facets.corners - centres(facets, movers)[facets.mover][:, None], axis=-1)
    radius = jnp.full(movers, SHORTEST_ARM).at[facets.mover].max(jnp.max(arms, -1))
    one = jnp.ones(3)
    return Motion(jnp.ones((movers, 3)), jnp.broadcast_to(radius[:, None], (movers, 3)), one, one)


def _by(metres: Motion, reach: Motion) -> Motion:
    return jax.tree.map(lambda leaf, far: leaf / far, metres, reach)
