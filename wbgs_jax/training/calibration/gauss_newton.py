"""Where surfaces and the receiver stand, by least squares over snapshots, as surveyors adjust a network.

What a model leaves unexplained of a snapshot is linear in small motions: every path turns by its wavenumber times the change
of its length (propagation/displacement.py). With a normal prior of every motion this gives the normal equations of a
Gauss-Newton step, and with their inverse how well every motion is known by now. What nobody has seen stays where it was.

Nobody knows the common factor of a snapshot: only what is orthogonal to the prediction counts. The noise level of every
snapshot is unknown too (`losses.log_decorrelation`), which gives those that are explained badly less weight. Paths whose
lengths are uncertain by more than a wavelength are expected to cancel, and tell nothing, until lower frequencies have told
where their surfaces are.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float, Int

from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import PreparedPaths, WaveParams, arrivals_at, element_gains
from wbgs_jax.fields.losses import GOOD_MATCH
from wbgs_jax.propagation.displacement import Motion, length_terms
from wbgs_jax.propagation.paths import TracedPaths
from wbgs_jax.propagation.transport import element_voltages
from wbgs_jax.radio.array import EXACT, SPEED_OF_LIGHT, squared_magnitude
from wbgs_jax.radio.channel import FAINTEST, Arrivals
from wbgs_jax.radio.geometry import rotation_matrix
from wbgs_jax.training.batches import TrainingData
from wbgs_jax.types import Links, Receiver

ROUNDS = 3
"""Steps at every frequency."""
AT_ONCE = 8
"""Snapshots."""
ALIKE = 30.0
"""What places do not explain (wrong materials, paths that are missing) is alike in many snapshots: so many say as much as one
whose error is its own."""
LONGEST_STEP = 0.1
"""In wavelengths of the highest frequency: beyond, phases are not linear."""
MOST = 256
"""Movers that are adjusted, at most: a step costs the square of their number. Others stay, and are believed as far as the prior
says."""
ARM = 3.0
"""Metres from its centre at which a turn moves a surface as far as a shift."""


def adjust(
    field: Calibratable,
    params: WaveParams,
    prepared: PreparedPaths,
    motion: Motion,
    covariance: Float[np.ndarray, "q q"],
    widths: Motion,
    numbers: Int[np.ndarray, " q"],
    data: TrainingData,
    pool: Int[np.ndarray, " n"],
    count: int,
    rng: np.random.Generator,
) -> tuple[Motion, Float[np.ndarray, "q q"]]:
    """Returns the motion by which snapshots up to some frequency are explained best, and its covariance.

    Args:
        field, params: a coherent field, which is not moved: the motion is small.
        prepared: paths of the links of the pool.
        motion: the one to start with, of all receivers.
        covariance: of the numbers that are adjusted, by lower frequencies, or by the prior.
        widths: standard deviations of the prior of the whole motion, that of the field included.
        numbers: those of the motion that are adjusted (`adjusted_numbers`).
        data: with snapshots.
        pool: links, up to the highest frequency that counts.
        count: snapshots that a step looks at, drawn anew for each.
        rng: draws them.
    """
    flat, back = ravel_pytree(motion)
    start, moves = np.asarray(ravel_pytree(field.motion)[0], np.float64)[numbers], np.array(flat, np.float64)
    others = np.asarray(ravel_pytree(widths)[0], np.float64) ** 2
    stiffness, others[numbers] = 1 / others[numbers], 0
    known = jnp.asarray(covariance, jnp.float32), jnp.asarray(others, jnp.float32)
    variance = length_variances(prepared, *known, numbers, len(motion.shift))
    frequency = np.asarray(data.links.query.frequency_hz)[pool].max()
    furthest = LONGEST_STEP * SPEED_OF_LIGHT / float(frequency) / _arms(motion)[numbers]
    for _ in range(ROUNDS):
        blocks = -(-min(count, len(pool)) // AT_ONCE)
        some = np.zeros((-(-count // AT_ONCE), AT_ONCE), np.int32)  # of one shape, whatever the pool: compiled once
        some[:blocks] = rng.choice(pool, (blocks, AT_ONCE))
        now = back(jnp.asarray(moves, jnp.float32))
        equations = normal_equations(field, params, now, prepared, data, some, variance, np.int32(blocks), numbers)
        curvature, pull = (np.asarray(a, np.float64) / ALIKE for a in equations)
        precision = curvature + np.diag(stiffness)
        step = np.linalg.solve(precision, pull - stiffness * (start + moves[numbers]))
        moves[numbers] += np.clip(step, -furthest, furthest)
    return back(jnp.asarray(moves, jnp.float32)), np.linalg.inv(precision)


def adjusted_numbers(prepared: PreparedPaths, motion: Motion) -> Int[np.ndarray, " q"]:
    """Returns which numbers of a motion are adjusted, as `ravel_pytree` orders them: those of all receivers, and those of the
    movers that change the lengths of paths most, at most `MOST` of these."""
    movers, size = len(motion.shift), ravel_pytree(motion)[0].size
    if movers <= MOST:
        return np.arange(size, dtype=np.int32)
    felt = np.asarray(_felt(prepared, movers, size))[: 3 * movers].reshape(movers, 3).sum(1)
    chosen = np.sort(np.argsort(-felt, kind="stable")[:MOST])
    shifts = (3 * chosen[:, None] + np.arange(3)).reshape(-1)
    return np.concatenate([shifts, 3 * movers + shifts, np.arange(6 * movers, size)]).astype(np.int32)


def _places(numbers: Int[Array, " q"], size: int) -> Int[Array, " p"]:
    """Returns the place of every number of a motion among those that are adjusted; their count for the others."""
    return jnp.full(size, len(numbers)).at[numbers].set(jnp.arange(len(numbers)))


def _arms(motion: Motion) -> Float[np.ndarray, " p"]:
    """Returns how far every number of a motion moves things, per metre or radian."""
    one = jax.tree.map(np.ones_like, motion)
    return np.asarray(ravel_pytree(Motion(one.shift, ARM * one.turn, one.receiver, one.receiver_turn))[0])


@partial(jax.jit, static_argnames=("movers", "size"))
def _felt(prepared: PreparedPaths, movers: int, size: int) -> Float[Array, " p"]:
    """Returns how strongly the lengths of all paths together depend on every number of a motion."""

    def add(total: Float[Array, " p"], pair: Any) -> tuple[Float[Array, " p"], None]:
        paths, receiver = pair
        number, derivative = _terms(prepared, paths, receiver, movers)
        alive = jnp.concatenate([paths.specular.alive, paths.diffracted.alive])
        return total.at[number].add(jnp.where(alive[:, None], derivative**2, 0)), None

    return jax.lax.scan(add, jnp.zeros(size), (prepared.paths, prepared.receiver_index))[0]


@partial(jax.jit, static_argnames="movers")
def length_variances(
    prepared: PreparedPaths, covariance: Float[Array, "q q"], others: Float[Array, " p"], numbers: Int[Array, " q"], movers: int
) -> Float[Array, "pairs k"]:
    """Returns the variances (square metres) of the lengths of all paths.

    Args:
        prepared: of the paths.
        covariance: of the numbers of the motion that are adjusted.
        others: variances of those that are not; 0 for the rest.
        numbers: those that are adjusted.
        movers: of the motion.
    """
    shared, place = jnp.pad(covariance, (0, 1)), _places(numbers, len(others))

    def of_pair(pair: Any) -> Float[Array, " k"]:
        paths, receiver = pair
        number, derivative = _terms(prepared, paths, receiver, movers)
        own = place[number]
        known = jnp.einsum("ki,kij,kj->k", derivative, shared[own[:, :, None], own[:, None, :]], derivative, precision=EXACT)
        return jnp.maximum(known, 0) + jnp.sum(derivative**2 * others[number], -1)

    variances: Float[Array, "pairs k"] = jax.lax.map(of_pair, (prepared.paths, prepared.receiver_index))
    return variances


def _terms(
    prepared: PreparedPaths, paths: TracedPaths, receiver: Int[Array, ""], movers: int
) -> tuple[Int[Array, "k t"], Float[Array, "k t"]]:
    """Returns the numbers of a motion of all receivers that all paths to one of them depend on, and the derivatives."""
    terms = [length_terms(some, prepared.surfaces, movers) for some in (paths.specular, paths.diffracted)]
    number, derivative = (jnp.concatenate(parts) for parts in zip(*terms, strict=True))
    return jnp.where(number < 6 * movers, number, number + 3 * receiver), derivative


@jax.jit
def normal_equations(
    field: Calibratable,
    params: WaveParams,
    motion: Motion,
    prepared: PreparedPaths,
    data: TrainingData,
    index: Int[Array, "blocks b"],
    variance: Float[Array, "pairs k"],
    blocks: Int[Array, ""],
    numbers: Int[Array, " q"],
) -> tuple[Float[Array, "q q"], Float[Array, " q"]]:
    """Returns the matrix J^T W J and the vector J^T W r of some snapshots, the first so many blocks: what is left of them is
    about r - J (a further motion), in units of its standard deviation. J has the columns of the numbers that are adjusted."""
    movers, receivers, q = len(motion.shift), len(motion.receiver), len(numbers)
    place = _places(numbers, ravel_pytree(motion)[0].size)

    def one(link: Int[Array, ""]) -> tuple[Float[Array, "n p"], Float[Array, " n"]]:
        batch = data.batch(link[None], jax.random.key(0))
        assert batch.snapshots is not None, "phases are what it looks at"
        asked: Links = jax.tree.map(lambda leaf: leaf[0], batch.links)
        plan = field.displaced(field.plan(params, batch.receiver, prepared), motion.of_receiver(asked.receiver_index))
        paths, frequency = prepared.of(asked), asked.query.frequency_hz
        wavenumber = 2 * jnp.pi * frequency / SPEED_OF_LIGHT
        arrived: Arrivals = arrivals_at(params, plan, paths, frequency)
        expected = jnp.exp(-0.5 * wavenumber**2 * variance[prepared.place(asked)])
        arrived = arrived._replace(amplitude=arrived.amplitude * expected)
        voltages = element_voltages(arrived, plan.receiver, frequency)
        if plan.tuning is not None:
            voltages = voltages * element_gains(plan.tuning)
        number, derivative = _terms(prepared, paths, asked.receiver_index, movers)
        lengths = jnp.zeros((len(number), q + 1)).at[jnp.arange(len(number))[:, None], place[number]].add(derivative)
        parts = jnp.concatenate([voltages.real, voltages.imag], -1)  # a real product: lengths are real
        real, imaginary = jnp.split(jnp.matmul(parts.T, lengths[:, :q], precision=EXACT), 2)
        turns = place[6 * movers + 3 * receivers + 3 * asked.receiver_index + jnp.arange(3)]
        turned = _turned(voltages, arrived, plan.receiver, frequency)
        changes = (wavenumber * (imaginary - 1j * real)).at[:, turns].add(turned)
        return _whitened(jnp.sum(voltages, 0), changes, batch.snapshots[0])

    def add(block: Int[Array, ""], total: Any) -> Any:
        changes, left = jax.vmap(one)(index[block])
        changes, left = changes.reshape(-1, changes.shape[-1]), left.reshape(-1)
        curvature = jnp.matmul(changes.T, changes, precision=EXACT)
        return total[0] + curvature, total[1] + jnp.matmul(changes.T, left, precision=EXACT)

    total: Any = jax.lax.fori_loop(0, blocks, add, (jnp.zeros((q, q)), jnp.zeros(q)))
    return total


def _turned(
    voltages: Complex[Array, "k elements"], arrived: Arrivals, receiver: Receiver, frequency_hz: Float[Array, ""]
) -> Complex[Array, "elements 3"]:
    """Returns how the elements' voltages change with the rotation vector (world frame) of the receiver."""
    axes = rotation_matrix(receiver.orientation)  # row i: the world's axis i in the receiver's frame
    aside = -jnp.cross(axes[:, None], arrived.direction)
    phases = jnp.matmul(aside, receiver.element_wavelengths(frequency_hz).T, precision=EXACT)
    return jnp.sum(2j * jnp.pi * phases * voltages, 1).T


def _whitened(
    predicted: Complex[Array, " elements"], changes: Complex[Array, "elements p"], truth: Complex[Array, " elements"]
) -> tuple[Float[Array, "n p"], Float[Array, " n"]]:
    """Returns the Jacobian and what is left of a snapshot, real and imaginary parts one below the other, free of what a common
    factor explains, in units of the standard deviation that is left."""
    faintest = jnp.asarray(FAINTEST, predicted.real.dtype)
    scale, norm = (jnp.maximum(jnp.max(jnp.abs(y)), faintest) for y in (predicted, truth))  # squares of faint ones would vanish
    predicted, changes, truth = predicted / scale, changes / scale, truth / norm
    norm = jnp.sqrt(jnp.sum(squared_magnitude(truth)))
    power = jnp.sum(squared_magnitude(predicted))
    factor = jnp.vdot(predicted, truth) / power
    left = (truth - factor * predicted) / norm
    along = jnp.matmul(predicted.conj(), changes, precision=EXACT) / power
    orthogonal = (changes - predicted[:, None] * along) * factor / norm
    weight = jnp.sqrt(2 * len(truth) / (jnp.sum(squared_magnitude(left)) + GOOD_MATCH))
    both = [jnp.concatenate([part.real, part.imag]) * weight for part in (orthogonal, left)]
    usable = jnp.isfinite(weight) & jnp.isfinite(both[0]).all()
    return jnp.where(usable, both[0], 0), jnp.where(usable, both[1], 0)
