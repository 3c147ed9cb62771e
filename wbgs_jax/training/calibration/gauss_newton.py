"""Gauss-Newton alignment of surfaces and receivers: least squares over snapshots, like the adjustment of a survey network.

The residual of a snapshot is linear in small motions: the phase of every path changes by its wavenumber times the change of its
length (propagation/displacement.py). With a normal prior of every motion this gives the normal equations of a Gauss-Newton
step; their inverse is the covariance of the motions. Surfaces that affect no path stay at their positions.

The common factor of a snapshot is unknown, so that only the component orthogonal to the prediction is used. The noise level of
every snapshot is unknown as well (`losses.log_decorrelation`), which gives less weight to those that fit badly. Paths whose
lengths are uncertain by more than a wavelength are expected to cancel and carry no information until lower frequencies have
determined the positions of their surfaces.
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
from wbgs_jax.radio.channel import FAINTEST, Paths
from wbgs_jax.radio.geometry import rotation_matrix
from wbgs_jax.training.batches import TrainingData
from wbgs_jax.types import Links, Receiver

MOST = 256
"""Maximum number of rigid bodies that are adjusted, since the cost of a step is quadratic in it. The others stay at their
positions with the uncertainty of the prior."""


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
    """Returns the motion that fits snapshots up to some frequency best, and its covariance.

    Args:
        field, params: a coherent field, which is not displaced: the motion is small.
        prepared: paths of the links of the pool.
        motion: initial motion, with all receivers.
        covariance: covariance of the adjusted components, from lower frequencies or from the prior.
        widths: prior standard deviations of the total motion, which includes that of the field.
        numbers: indices of the adjusted components of the motion (`adjusted_numbers`).
        data: training data with snapshots.
        pool: indices of links up to the highest frequency in use.
        count: number of snapshots per step, drawn anew for each.
        rng: random numbers.
    """
    flat, back = ravel_pytree(motion)
    start, moves = np.asarray(ravel_pytree(field.motion)[0], np.float64)[numbers], np.array(flat, np.float64)
    others = np.asarray(ravel_pytree(widths)[0], np.float64) ** 2
    stiffness, others[numbers] = 1 / others[numbers], 0
    known = jnp.asarray(covariance, jnp.float32), jnp.asarray(others, jnp.float32)
    variance = length_variances(prepared, *known, numbers, len(motion.shift))
    frequency = np.asarray(data.links.frequency_hz)[pool].max()
    longest_step = 0.1  # longest step, in wavelengths of the highest frequency; beyond it, phases are not linear
    furthest = longest_step * SPEED_OF_LIGHT / float(frequency) / _arms(motion)[numbers]
    rounds = 3  # Gauss-Newton steps at every frequency
    at_once = 8  # number of snapshots that are processed together
    # Number of snapshots that carry as much information as one with independent errors: errors that positions cannot explain
    # (wrong materials, missing paths) are correlated between snapshots
    alike = 30.0
    for _ in range(rounds):
        blocks = -(-min(count, len(pool)) // at_once)
        some = np.zeros((-(-count // at_once), at_once), np.int32)  # the shape is independent of the pool: compiled once
        some[:blocks] = rng.choice(pool, (blocks, at_once))
        now = back(jnp.asarray(moves, jnp.float32))
        equations = normal_equations(field, params, now, prepared, data, some, variance, np.int32(blocks), numbers)
        curvature, pull = (np.asarray(a, np.float64) / alike for a in equations)
        precision = curvature + np.diag(stiffness)
        step = np.linalg.solve(precision, pull - stiffness * (start + moves[numbers]))
        moves[numbers] += np.clip(step, -furthest, furthest)
    return back(jnp.asarray(moves, jnp.float32)), np.linalg.inv(precision)


def adjusted_numbers(prepared: PreparedPaths, motion: Motion) -> Int[np.ndarray, " q"]:
    """Returns the indices of the components of a motion that are adjusted, in the order of `ravel_pytree`: those of all
    receivers, and those of the rigid bodies that change path lengths most, at most `MOST` of them."""
    movers, size = len(motion.shift), ravel_pytree(motion)[0].size
    if movers <= MOST:
        return np.arange(size, dtype=np.int32)
    felt = np.asarray(_felt(prepared, movers, size))[: 3 * movers].reshape(movers, 3).sum(1)
    chosen = np.sort(np.argsort(-felt, kind="stable")[:MOST])
    shifts = (3 * chosen[:, None] + np.arange(3)).reshape(-1)
    return np.concatenate([shifts, 3 * movers + shifts, np.arange(6 * movers, size)]).astype(np.int32)


def _places(numbers: Int[Array, " q"], size: int) -> Int[Array, " p"]:
    """Returns the index of every component of a motion among the adjusted ones; the number of these for the others."""
    return jnp.full(size, len(numbers)).at[numbers].set(jnp.arange(len(numbers)))


def _arms(motion: Motion) -> Float[np.ndarray, " p"]:
    """Returns the displacement (metres) per unit (metre or radian) of every component of a motion."""
    one = jax.tree.map(np.ones_like, motion)
    arm = 3.0  # distance from the centre of a surface, metres, at which a rotation displaces it as far as a shift
    return np.asarray(ravel_pytree(Motion(one.shift, arm * one.turn, one.receiver, one.receiver_turn))[0])


@partial(jax.jit, static_argnames=("movers", "size"))
def _felt(prepared: PreparedPaths, movers: int, size: int) -> Float[Array, " p"]:
    """Returns the sums over all paths of squared derivatives of their lengths with respect to the components of a motion."""

    def add(total: Float[Array, " p"], pair: Any) -> tuple[Float[Array, " p"], None]:
        paths, receiver = pair
        number, derivative = _terms(prepared, paths, receiver, movers)
        return total.at[number].add(jnp.where(paths.alive[:, None], derivative**2, 0)), None

    return jax.lax.scan(add, jnp.zeros(size), (prepared.paths, prepared.receiver_index))[0]


@partial(jax.jit, static_argnames="movers")
def length_variances(
    prepared: PreparedPaths, covariance: Float[Array, "q q"], others: Float[Array, " p"], numbers: Int[Array, " q"], movers: int
) -> Float[Array, "pairs k"]:
    """Returns the variances (square metres) of the lengths of all paths.

    Args:
        prepared: paths of all pairs.
        covariance: covariance of the adjusted components of the motion.
        others: variances of the components that are not adjusted; 0 for the adjusted ones.
        numbers: indices of the adjusted components.
        movers: number of rigid bodies.
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
    """Returns the indices of the components of a motion (with all receivers) that the lengths of paths to one receiver depend
    on, and the derivatives."""
    terms = [length_terms(some, prepared.surfaces, movers) for some in paths.sets]
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
    """Returns the matrix J^T W J and the vector J^T W r of snapshots. Their residual after a further motion m is about r - J m,
    in units of its standard deviation.

    Args:
        field, params: a coherent field.
        motion: current motion, with all receivers.
        prepared: paths of all pairs.
        data: training data with snapshots.
        index: indices of the links, in blocks.
        variance: variances of the path lengths (`length_variances`).
        blocks: number of blocks in use; the others are padding.
        numbers: indices of the adjusted components, the columns of J.
    """
    movers, receivers, q = len(motion.shift), len(motion.receiver), len(numbers)
    place = _places(numbers, ravel_pytree(motion)[0].size)

    def one(link: Int[Array, ""]) -> tuple[Float[Array, "n p"], Float[Array, " n"]]:
        batch = data.batch(link[None], jax.random.key(0))
        assert batch.snapshots is not None, "the alignment needs phases"
        queried: Links = jax.tree.map(lambda leaf: leaf[0], batch.links)
        plan = field.displaced(field.plan(params, batch.receiver, prepared), motion.of_receiver(queried.receiver_index))
        paths, frequency = prepared.of(queried), queried.frequency_hz
        wavenumber = 2 * jnp.pi * frequency / SPEED_OF_LIGHT
        arrived: Paths = arrivals_at(params, plan, paths, queried)
        expected = jnp.exp(-0.5 * wavenumber**2 * variance[prepared.place(queried)])
        arrived = arrived._replace(amplitude=arrived.amplitude * expected)
        voltages = element_voltages(arrived, plan.receiver, frequency)
        if plan.array_gains is not None:
            voltages = voltages * element_gains(plan.array_gains)
        number, derivative = _terms(prepared, paths, queried.receiver_index, movers)
        lengths = jnp.zeros((len(number), q + 1)).at[jnp.arange(len(number))[:, None], place[number]].add(derivative)
        parts = jnp.concatenate([voltages.real, voltages.imag], -1)  # a real product: lengths are real
        real, imaginary = jnp.split(jnp.matmul(parts.T, lengths[:, :q], precision=EXACT), 2)
        turns = place[6 * movers + 3 * receivers + 3 * queried.receiver_index + jnp.arange(3)]
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
    voltages: Complex[Array, "k elements"], arrived: Paths, receiver: Receiver, frequency_hz: Float[Array, ""]
) -> Complex[Array, "elements 3"]:
    """Returns the derivatives of the elements' voltages with respect to the rotation vector (world frame) of the receiver."""
    axes = rotation_matrix(receiver.orientation)  # row i: the world's axis i in the receiver's frame
    aside = -jnp.cross(axes[:, None], arrived.direction)
    phases = jnp.matmul(aside, receiver.element_wavelengths(frequency_hz).T, precision=EXACT)
    return jnp.sum(2j * jnp.pi * phases * voltages, 1).T


def _whitened(
    predicted: Complex[Array, " elements"], changes: Complex[Array, "elements p"], truth: Complex[Array, " elements"]
) -> tuple[Float[Array, "n p"], Float[Array, " n"]]:
    """Returns the Jacobian and the residual of a snapshot, with real parts above imaginary parts, without the component that a
    common factor explains, in units of the standard deviation of the residual."""
    faintest = jnp.asarray(FAINTEST, predicted.real.dtype)
    scale, norm = (jnp.maximum(jnp.max(jnp.abs(y)), faintest) for y in (predicted, truth))  # small squares would underflow
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
