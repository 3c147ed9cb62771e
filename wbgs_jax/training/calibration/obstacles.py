"""Bodies that a mesh has and the room does not: furniture that has been carried away, or that stands there twice.

What is not there neither reflects nor shades, as if it were made of air, and that is how it is tried: every mover of the facets
gets a material of its own, and a mover is left out if low frequencies are explained surely better without it. (Its edges still
diffract in that trial, so some go unnoticed.) Then paths are traced and materials named again. That counts if it explains other
snapshots, of all frequencies, surely better, as far as places are known; it lets others be seen, and the movers are gone
through again. High frequencies are not asked: there a body that stands a little elsewhere is worse than none.

Search for clutter: what stands in the way of waves and is not in the mesh (propagation/absorption.py).

Its density is fitted to the spectra of most transmitters by gradient descent, all else being what it is. If those of the others
are explained better with it, and not by chance, training goes on from there and learns it beside everything else; a few
transmitters, or a mesh that lacks nothing, do not show that, and then there is no clutter.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from wbgs_jax._util.pytree import replaced
from wbgs_jax.config import SearchConfig
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import Materials, PreparedPaths, WaveParams
from wbgs_jax.mesh.facets import centres
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.batches import TrainingData, batches_of_one_receiver
from wbgs_jax.training.calibration.antennas import ENDS
from wbgs_jax.training.calibration.material_fit import search_materials, with_properties
from wbgs_jax.training.calibration.objective import Told, surely_better
from wbgs_jax.training.calibration.uncertainty import search_placement
from wbgs_jax.training.hooks import Say, silent

AIR = (1.0001, 1e-9, 0.0, 1e-4)
"""Relative permittivity, c and d of the conductivity c f^d, metres: what reflects nothing and lets everything pass."""
ROUNDS = 3
"""Times that all movers are gone through, at most."""
MOST = 512
"""Movers that are tried, at most: those with the largest facets."""
CLOSELY = 32
"""Movers that are looked at closely: those without which a glance explains spectra best."""
BELIEVED = 0.1
"""Wavelengths: a body that stands no further off than this is better than none."""
LEAST = 1e-3
"""What less than this is gained by (natural logarithm of what is left) is not worth a change."""
SURE, SURE_OF_ONE = 2.0, 2.5
"""As many standard errors over transmitters as the gain of a pass has to be sure by (`surely_better`), and that of a body, of
which there are many."""


@dataclass(frozen=True)
class AbsentReport:
    """What was left out."""

    before: float
    """How badly training snapshots are explained on average (`losses.surprise`), with the mesh as it was ..."""
    after: float
    """... and without the bodies."""
    centres: list[list[float]]
    """Of all that were left out: metres, world frame."""


def search_absent(
    params: WaveParams, told: Told, config: SearchConfig, say: Say = silent
) -> tuple[WaveParams, Told, AbsentReport]:
    """Returns parameters, and the field with its paths, without the bodies whose absence snapshots tell.

    Args:
        params: with materials that have been named, by the first of the spectra.
        told: what training spectra say, with snapshots: spectra alone would cost ten times as much.
        config: `absent_spectra` are looked at, up to the highest frequency at which places are believed.
        say: is told of every pass.
    """
    judged = dataclasses.replace(told, spectra=told.spectra[::-1])  # by other spectra than those that name materials
    tx, where = judged.tx_index(config.spectra), list[list[float]]()
    before = now = _explained(params, judged, config)
    once = dataclasses.replace(config, rounds=1)
    for _ in range(ROUNDS):
        say("search: bodies that are not there")
        movers = absent_movers(params, told, config)
        if not len(movers):
            break
        field = told.field.without(movers)
        fewer = dataclasses.replace(told, field=field, prepared=field.prepare(told.data.links, told.data.receivers))
        others, _ = search_materials(_carried(params, field), fewer, config.spectra, once)
        after = _explained(others, dataclasses.replace(fewer, spectra=judged.spectra), config)
        if not surely_better(now - after, tx, SURE):
            break
        middles = np.asarray(centres(told.field.facets, len(told.field.motion.shift)))[movers]
        where += np.round(middles.astype(float), 3).tolist()
        params, told, now = others, fewer, after
    return params, told, AbsentReport(float(before.mean()), float(now.mean()), where)


def _explained(params: WaveParams, told: Told, config: SearchConfig) -> Float[np.ndarray, " n"]:
    """Returns how badly snapshots are explained, with as much doubt of all places as suits them: phases of what stands a little
    elsewhere are then believed no more, and it is better than nothing."""
    doubted, _ = search_placement(params, told.scores(config.placement_spectra, "covariances"))
    return told.scores(config.spectra, "covariances")([doubted])[0]


def absent_movers(params: WaveParams, told: Told, config: SearchConfig) -> Int[np.ndarray, " k"]:
    """Returns the movers without which snapshots are explained surely better, each without those before it; never all."""
    highest = BELIEVED * SPEED_OF_LIGHT / max(config.geometry_width, 1e-9)
    low = told.frequency_hz() <= highest
    if not low.any():
        return np.zeros(0, int)
    own, params = _each_by_itself(params, told)
    own = dataclasses.replace(own, spectra=own.spectra[low][: config.absent_spectra])
    score, tx = own.scores(), own.tx_index()
    _, first = np.unique(np.asarray(own.field.facets.mover), return_index=True)  # the largest facets come first
    tried = np.asarray(own.field.facets.mover)[np.sort(first)][:MOST].tolist()
    # First those that differ: what is there as it is then needs no program of its own (objective.py).
    without_one = score([_of_air(params, one) for one in tried], config.absent_glance)
    gains = score([params], config.absent_glance) - without_one
    likely = [tried[i] for i in np.argsort(-gains.mean(1))[:CLOSELY] if gains[i].mean() > 0]
    now, gone = score([params])[0], list[int]()
    closely = (now - score([_of_air(params, one) for one in likely])).mean(1) if likely else np.zeros(0)
    for one in np.array(likely, int)[np.argsort(-closely)].tolist():
        without = _of_air(params, one)
        scores = score([without])[0]
        gain = now - scores
        if gain.mean() > LEAST and surely_better(gain, tx, SURE_OF_ONE) and len(gone) + 1 < len(first):
            params, now = without, scores
            gone.append(one)
    return np.sort(np.array(gone, int))


def _each_by_itself(params: WaveParams, told: Told) -> tuple[Told, WaveParams]:
    """Returns the field, its paths and its parameters with every mover of a material of its own, alike to begin with, and of a
    thickness that nobody knows."""
    facets = told.field.facets
    source = np.zeros(len(told.field.motion.shift), int)  # of a large mesh, some have lost all of their facets
    source[np.asarray(facets.mover)] = np.asarray(facets.material)
    thickness = jnp.log(told.field.material_properties(params).thickness[source])
    own: Materials = jax.tree.map(lambda leaf: leaf[source], params.materials)
    own = dataclasses.replace(own, log_thickness=thickness)
    field = replaced(told.field, facets=replaced(facets, material=facets.mover), known_thickness=jnp.zeros_like(thickness))
    surfaces = told.prepared.surfaces
    surfaces = replaced(surfaces, facets=replaced(surfaces.facets, material=facets.mover))
    prepared = replaced(told.prepared, surfaces=surfaces)
    return dataclasses.replace(told, field=field, prepared=prepared), replaced(params, materials=own)


def _of_air(params: WaveParams, mover: int) -> WaveParams:
    return replaced(params, materials=with_properties(params.materials, mover, *AIR))


def _carried(params: WaveParams, field: Calibratable) -> WaveParams:
    """Returns the first parameters of a field with the materials and antennas that were found in another."""
    return replaced(field.init(jax.random.key(0)), **{name: getattr(params, name) for name in ("materials", *ENDS)})


JUDGES = 0.25
"""Share of the transmitters whose spectra say whether clutter is there."""
FEWEST = 6
"""Judges: fewer are never sure."""
SURE_OF_CLUTTER = 1.0
"""As many standard errors over transmitters as the gain has to be sure by (`surely_better`): where there is no clutter, what
was fitted explains other spectra worse, and so long as it does not it does no harm."""
LEAST_CLUTTER = 2e-4
"""Error that clutter has to spare; spectra are at most 1."""
BATCH = 8


@dataclass(frozen=True)
class ClutterReport:
    """What was found."""

    before: float
    """Mean absolute error of the judges' spectra without clutter ..."""
    after: float
    """... and with it, taken or not."""
    taken: bool


def search_clutter(
    params: WaveParams, told: Told, config: SearchConfig, rng: np.random.Generator
) -> tuple[WaveParams, Told, ClutterReport | None]:
    """Returns parameters and field with clutter, if it is there; no report where too few could say so.

    Args:
        params: of a coherent field without clutter.
        told: what training spectra say.
        config: of the search.
        rng: draws who judges, and the batches of the others.
    """
    tx = told.tx_index()
    everyone = rng.permutation(np.unique(tx))
    judges = everyone[: round(JUDGES * len(everyone))]
    if len(judges) < FEWEST:
        return params, told, None
    judge = np.isin(tx, judges)
    judged = dataclasses.replace(told, spectra=told.spectra[judge][: config.clutter_spectra])
    batches = batches_of_one_receiver(told.data, told.spectra[~judge], config.clutter_steps, BATCH, rng)
    field = told.field.with_absorption()
    clutter = _fitted(field, replaced(params, clutter=field.first_clutter), told.prepared, told.data, batches)
    others, fuller = replaced(params, clutter=clutter), dataclasses.replace(told, field=field)
    before, after = _errors(judged, params), _errors(dataclasses.replace(judged, field=field), others)
    gains = before - after
    taken = bool(gains.mean() > LEAST_CLUTTER) and surely_better(gains, judged.tx_index(), SURE_OF_CLUTTER)
    report = ClutterReport(float(before.mean()), float(after.mean()), taken)
    return (others, fuller, report) if taken else (params, told, report)


def _errors(told: Told, params: WaveParams) -> Float[np.ndarray, " n"]:
    """Returns mean absolute errors: of their logarithms, spectra that are right anyway would have most to say."""
    found: Float[np.ndarray, " n"] = np.exp(told.scores(None, "spectra")([params])[0])
    return found


@jax.jit
def _fitted(
    field: Calibratable, params: WaveParams, prepared: PreparedPaths, data: TrainingData, batches: Int[Array, "k b"]
) -> Float[Array, "x y z 2"]:
    """Returns the clutter after a step on every batch."""
    optimizer = optax.adam(optax.cosine_decay_schedule(field.config.clutter_lr, len(batches)))

    def loss(clutter: Float[Array, "x y z 2"], index: Int[Array, " b"]) -> Float[Array, ""]:
        batch = data.batch(index, jax.random.key(0))
        return field.loss(replaced(params, clutter=clutter), prepared, batch)[0]

    def step(carry: Any, index: Int[Array, " b"]) -> tuple[Any, None]:
        clutter, state = carry
        updates, state = optimizer.update(jax.grad(loss)(clutter, index), state)
        return (optax.apply_updates(clutter, updates), state), None

    assert params.clutter is not None, "the field has an absorption grid"
    clutter: Float[Array, "x y z 2"] = params.clutter
    (clutter, _), _ = jax.lax.scan(step, (clutter, optimizer.init(clutter)), batches)
    return clutter
