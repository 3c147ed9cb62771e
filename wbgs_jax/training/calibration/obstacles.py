"""Calibration of obstacles: removal of spurious bodies, and the absorption grid.

Spurious bodies are in the mesh but not in reality, such as furniture that has been removed or that is contained twice. A body
that does not exist neither reflects nor obstructs waves, as if it were made of air, and is tested in this way: every rigid body
gets a material of its own, and a body is removed if low frequencies fit significantly better without it. (Its edges still
diffract in this test, so that some spurious bodies are not found.) Paths are then traced again and materials are chosen again.
The removal is kept if other snapshots, of all frequencies, fit significantly better, given the position uncertainty. It may
reveal further spurious bodies, so that the test is repeated. High frequencies are not used in it: there a body that is slightly
displaced fits worse than none.

The absorption grid stands for objects that attenuate waves and are not in the mesh (propagation/transport.py). Its density is
fitted to the spectra of most transmitters by gradient descent, with everything else fixed. If those of the others fit
significantly better with it, the grid is kept, and training refines it together with all other parameters. A grid with which
they fit worse after a quarter of the steps is given up. With few transmitters, or with a complete mesh, there is no such
evidence, and the grid is not used.
"""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from wbgs_jax._util.pytree import replaced
from wbgs_jax.config import CalibrationConfig
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import Materials, PreparedPaths, WaveParams
from wbgs_jax.mesh.facets import centres
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.batches import TrainingData, batches_of_one_receiver
from wbgs_jax.training.calibration.antennas import ENDS
from wbgs_jax.training.calibration.material_fit import search_materials, with_properties
from wbgs_jax.training.calibration.objective import CalibrationProblem, search_placement, surely_better
from wbgs_jax.training.hooks import Say, silent

AIR = (1.0001, 1e-9, 0.0, 1e-4)
"""Relative permittivity, c and d of the conductivity c f^d, and thickness (metres) of a slab that transmits everything."""
ROUNDS = 3
"""Maximum number of passes over all rigid bodies."""
MOST = 512
"""Maximum number of rigid bodies that are tested, those with the largest facets."""
CLOSELY = 32
"""Number of rigid bodies that are tested on all spectra: those without which the first few fit best."""


@dataclass(frozen=True)
class AbsentReport:
    """Result of the search for spurious bodies."""

    before: float
    """Mean negative log-likelihood of training snapshots (`losses.surprise`) with the complete mesh."""
    after: float
    """Mean negative log-likelihood of training snapshots without the removed bodies."""
    centres: list[list[float]]
    """Centres of the removed bodies, world frame, metres."""


def search_absent(
    params: WaveParams, problem: CalibrationProblem, config: CalibrationConfig, say: Say = silent
) -> tuple[WaveParams, CalibrationProblem, AbsentReport]:
    """Returns parameters, and the field with its paths, without spurious bodies. The problem needs snapshots,
    since spectra alone would take ten times as long.

    Args:
        params: parameters with materials that have been chosen with the first of the spectra.
        config: settings of the calibration; `spurious_spectra` are used, up to the highest frequency at which positions are
            sufficiently accurate.
        say: called with a description of every pass.
    """
    held_out = dataclasses.replace(
        problem, spectra=problem.spectra[::-1]
    )  # spectra other than those that materials are chosen with
    tx, where = held_out.tx_index(config.spectra), list[list[float]]()
    before = now = _explained(params, held_out, config)
    once = dataclasses.replace(config, rounds=1)
    for _ in range(ROUNDS):
        say("calibration: objects of the mesh that the room lacks")
        movers = absent_movers(params, problem, config)
        if not len(movers):
            break
        field = problem.field.without(movers)
        fewer = dataclasses.replace(problem, field=field, prepared=field.prepare(problem.data.links, problem.data.receivers))
        others, _ = search_materials(_carried(params, field), fewer, config.spectra, once)
        after = _explained(others, dataclasses.replace(fewer, spectra=held_out.spectra), config)
        if not surely_better(now - after, tx, config.spurious_n_sigma):
            break
        middles = np.asarray(centres(problem.field.facets, len(problem.field.motion.shift)))[movers]
        where += np.round(middles.astype(float), 3).tolist()
        params, problem, now = others, fewer, after
    return params, problem, AbsentReport(float(before.mean()), float(now.mean()), where)


def _explained(params: WaveParams, problem: CalibrationProblem, config: CalibrationConfig) -> Float[np.ndarray, " n"]:
    """Returns the negative log-likelihoods of snapshots with the position uncertainty that fits best: phases of slightly
    displaced bodies then have little effect, and such a body fits better than none."""
    uncertain, _ = search_placement(params, problem.scores(config.position_std_spectra, "covariances"))
    return problem.scores(config.spectra, "covariances")([uncertain])[0]


def absent_movers(params: WaveParams, problem: CalibrationProblem, config: CalibrationConfig) -> Int[np.ndarray, " k"]:
    """Returns the rigid bodies without which snapshots fit significantly better, each tested without the previous ones; never
    all bodies."""
    accurate = 0.1  # displacement, in wavelengths, up to which a body fits better than none
    highest = accurate * SPEED_OF_LIGHT / max(config.geometry_width, 1e-9)
    low = problem.frequency_hz() <= highest
    if not low.any():
        return np.zeros(0, int)
    own, params = each_by_itself(params, problem)
    own = dataclasses.replace(own, spectra=own.spectra[low][: config.spurious_spectra])
    score, tx = own.scores(), own.tx_index()
    _, first = np.unique(np.asarray(own.field.facets.mover), return_index=True)  # the largest facets come first
    tried = np.asarray(own.field.facets.mover)[np.sort(first)][:MOST].tolist()
    without_one = score([of_air(params, one) for one in tried], config.spurious_glance)
    gains = score([params], config.spurious_glance) - without_one
    likely = [tried[i] for i in np.argsort(-gains.mean(1))[:CLOSELY] if gains[i].mean() > 0]
    now, gone = score([params])[0], list[int]()
    closely = (now - score([of_air(params, one) for one in likely])).mean(1) if likely else np.zeros(0)
    of_one = config.spurious_n_sigma + 0.5  # for a single body: more standard errors than for a pass, since bodies are many
    least = 1e-3  # minimum gain (natural logarithm of the decorrelation) for the removal of a body
    for one in np.array(likely, int)[np.argsort(-closely)].tolist():
        without = of_air(params, one)
        scores = score([without])[0]
        gain = now - scores
        if gain.mean() > least and surely_better(gain, tx, of_one) and len(gone) + 1 < len(first):
            params, now = without, scores
            gone.append(one)
    return np.sort(np.array(gone, int))


def each_by_itself(params: WaveParams, problem: CalibrationProblem) -> tuple[CalibrationProblem, WaveParams]:
    """Returns the field, its paths and its parameters with a separate material for every rigid body, equal to its current one
    but with a thickness that is a parameter."""
    facets = problem.field.facets
    source = np.zeros(len(problem.field.motion.shift), int)  # bodies of a large mesh may have lost all of their facets
    source[np.asarray(facets.mover)] = np.asarray(facets.material)
    thickness = jnp.log(problem.field.material_properties(params).thickness[source])
    own: Materials = jax.tree.map(lambda leaf: leaf[source], params.materials)
    own = dataclasses.replace(own, log_thickness=thickness)
    field = replaced(problem.field, facets=replaced(facets, material=facets.mover), known_thickness=jnp.zeros_like(thickness))
    surfaces = problem.prepared.surfaces
    surfaces = replaced(surfaces, facets=replaced(surfaces.facets, material=facets.mover))
    prepared = replaced(problem.prepared, surfaces=surfaces)
    return dataclasses.replace(problem, field=field, prepared=prepared), replaced(params, materials=own)


def of_air(params: WaveParams, mover: int) -> WaveParams:
    return replaced(params, materials=with_properties(params.materials, mover, *AIR))


def _carried(params: WaveParams, field: Calibratable) -> WaveParams:
    """Returns the initial parameters of a field, with the materials and antennas that were found for another field."""
    return replaced(field.init(jax.random.key(0)), **{name: getattr(params, name) for name in ("materials", *ENDS)})


FEWEST = 6
"""Minimum number of these transmitters; fewer are never significant."""
PARTS = 4
"""Parts of the fit: after the first one, a grid with which other spectra fit worse is given up."""


@dataclass(frozen=True)
class ClutterReport:
    """Result of the fit of an absorption grid."""

    before: float
    """Mean absolute error of the test spectra without the grid."""
    after: float
    """Mean absolute error of the test spectra with the grid, whether it is used or not."""
    taken: bool
    """Whether the grid is used."""


def search_clutter(
    params: WaveParams, problem: CalibrationProblem, config: CalibrationConfig, rng: np.random.Generator
) -> tuple[WaveParams, CalibrationProblem, ClutterReport | None]:
    """Returns parameters and field with an absorption grid if it fits significantly better, else unchanged, and a report, which
    is None if there are too few transmitters.

    Args:
        params: parameters of a coherent field without an absorption grid.
        config: settings of the calibration.
        rng: random numbers for the test transmitters, and for the batches of the others.
    """
    tx = problem.tx_index()
    everyone = rng.permutation(np.unique(tx))
    tested = 0.25  # fraction of the transmitters on whose spectra the absorption grid is tested
    testers = everyone[: round(tested * len(everyone))]
    if len(testers) < FEWEST:
        return params, problem, None
    of_testers = np.isin(tx, testers)
    held_out = dataclasses.replace(problem, spectra=problem.spectra[of_testers][: config.absorption_spectra])
    batch = 8  # links per step
    batches = batches_of_one_receiver(problem.data, problem.spectra[~of_testers], config.absorption_steps, batch, rng)
    field = problem.field.with_absorption()
    others, fuller = replaced(params, clutter=field.first_clutter), dataclasses.replace(problem, field=field)
    state = _optimizer(field, len(batches)).init(field.first_clutter)
    before, after = _errors(held_out, params), np.zeros(0)
    for number, part in enumerate(np.array_split(np.asarray(batches), PARTS)):
        others, state = _fitted(field, others, state, problem.prepared, problem.data, jnp.asarray(part), len(batches))
        if number in (0, PARTS - 1):
            after = _errors(dataclasses.replace(held_out, field=field), others)
            if np.mean(after) >= np.mean(before):
                break
    gains = before - after
    least_clutter = 2e-4  # minimum reduction of the mean absolute error; spectra are at most 1
    taken = bool(gains.mean() > least_clutter) and surely_better(gains, held_out.tx_index(), config.absorption_n_sigma)
    report = ClutterReport(float(before.mean()), float(after.mean()), taken)
    return (others, fuller, report) if taken else (params, problem, report)


def _errors(problem: CalibrationProblem, params: WaveParams) -> Float[np.ndarray, " n"]:
    """Returns mean absolute errors; their logarithms would be dominated by spectra that are accurate anyway."""
    found: Float[np.ndarray, " n"] = np.exp(problem.scores(None, "spectra")([params])[0])
    return found


@functools.partial(jax.jit, static_argnames="steps")
def _fitted(
    field: Calibratable,
    params: WaveParams,
    state: optax.OptState,
    prepared: PreparedPaths,
    data: TrainingData,
    batches: Int[Array, "k b"],
    steps: int,
) -> tuple[WaveParams, optax.OptState]:
    """Returns parameters after one step of the grid on every batch, and the state of the optimiser; `steps` is the number of
    steps in all."""
    optimizer = _optimizer(field, steps)

    def loss(clutter: Float[Array, "x y z 2"], index: Int[Array, " b"]) -> Float[Array, ""]:
        batch = data.batch(index, jax.random.key(0))
        return field.loss(replaced(params, clutter=clutter), prepared, batch)[0]

    def step(carry: Any, index: Int[Array, " b"]) -> tuple[Any, None]:
        clutter, state = carry
        updates, state = optimizer.update(jax.grad(loss)(clutter, index), state)
        return (optax.apply_updates(clutter, updates), state), None

    assert params.clutter is not None, "the field has an absorption grid"
    (clutter, state), _ = jax.lax.scan(step, (params.clutter, state), batches)
    return replaced(params, clutter=clutter), state


def _optimizer(field: Calibratable, steps: int) -> optax.GradientTransformation:
    return optax.adam(optax.cosine_decay_schedule(field.config.clutter_lr, steps))
