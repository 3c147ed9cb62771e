"""Where surfaces and the receiver stand, by least squares over snapshots, as surveyors adjust a network.

What a model leaves unexplained of a snapshot is linear in small motions: every path turns by its wavenumber times the change
of its length (propagation/motion.py). With a normal prior of every motion this gives the normal equations of a Gauss-Newton
step, and with their inverse how well every motion is known by now. What nobody has seen stays where it was.

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
from jaxtyping import Array, Complex, Float, Inexact, Int

from wbgs_jax.fields.losses import GOOD_MATCH
from wbgs_jax.fields.wave_channel import arrivals_at, element_gains
from wbgs_jax.propagation.motion import Motion, length_jacobian, length_terms
from wbgs_jax.propagation.transport import element_voltages
from wbgs_jax.radio.array import EXACT, SPEED_OF_LIGHT, squared_magnitude
from wbgs_jax.radio.channel import FAINTEST, Arrivals
from wbgs_jax.radio.geometry import rotation_matrix
from wbgs_jax.training.data import TrainingData
from wbgs_jax.types import Receiver

ROUNDS = 3
"""Steps at every frequency."""
AT_ONCE = 8
"""Snapshots."""
ALIKE = 30.0
"""What places do not explain (wrong materials, paths that are missing) is alike in many snapshots: so many say as much as one
whose error is its own."""
LONGEST_STEP = 0.1
"""In wavelengths of the highest frequency: beyond, phases are not linear."""
ARM = 3.0
"""Metres from its centre at which a turn moves a surface as far as a shift."""


def adjust(
    field: Any,
    params: Any,
    cache: Any,
    motion: Motion,
    covariance: Float[np.ndarray, "p p"],
    widths: Motion,
    data: TrainingData,
    pool: Int[np.ndarray, " n"],
    count: int,
    rng: np.random.Generator,
) -> tuple[Motion, Float[np.ndarray, "p p"]]:
    """Returns the motion by which snapshots up to some frequency are explained best, and its covariance.

    Args:
        field, params: a coherent field, which is not moved: the motion is small.
        cache: paths of the links of the pool.
        motion: the one to start with, of all receivers.
        covariance: of all of its numbers (as `ravel_pytree` orders them) by lower frequencies, or by the prior.
        widths: standard deviations of the prior of the whole motion, that of the field included.
        data: with snapshots.
        pool: links, up to the highest frequency that counts.
        count: snapshots that a step looks at, drawn anew for each.
        rng: draws them.
    """
    flat, back = ravel_pytree(motion)
    start = np.asarray(ravel_pytree(field.motion)[0], np.float64)
    moves, stiffness = np.asarray(flat, np.float64), 1 / np.asarray(ravel_pytree(widths)[0], np.float64) ** 2
    variance = length_variances(cache, jnp.asarray(covariance, jnp.float32), len(motion.shift))
    frequency = np.asarray(data.links.query.frequency_hz)[pool].max()
    furthest = LONGEST_STEP * SPEED_OF_LIGHT / float(frequency) / _arms(motion)
    for _ in range(ROUNDS):
        blocks = -(-min(count, len(pool)) // AT_ONCE)
        some = np.zeros((-(-count // AT_ONCE), AT_ONCE), np.int32)  # of one shape, whatever the pool: compiled once
        some[:blocks] = rng.choice(pool, (blocks, AT_ONCE))
        now = back(jnp.asarray(moves, jnp.float32))
        equations = normal_equations(field, params, now, cache, data, jnp.asarray(some), variance, jnp.asarray(blocks))
        curvature, pull = (np.asarray(a, np.float64) / ALIKE for a in equations)
        precision = curvature + np.diag(stiffness)
        step = np.linalg.solve(precision, pull - stiffness * (start + moves))
        moves = moves + np.clip(step, -furthest, furthest)
    return back(jnp.asarray(moves, jnp.float32)), np.linalg.inv(precision)


def _arms(motion: Motion) -> Float[np.ndarray, " p"]:
    """Returns how far every number of a motion moves things, per metre or radian."""
    one = jax.tree.map(np.ones_like, motion)
    return np.asarray(ravel_pytree(Motion(one.shift, ARM * one.turn, one.receiver, one.receiver_turn))[0])


@partial(jax.jit, static_argnames="movers")
def length_variances(cache: Any, covariance: Float[Array, "p p"], movers: int) -> Float[Array, "pairs k"]:
    """Returns the variances (square metres) of the lengths of all paths, from the covariance of the motion."""

    def of_pair(pair: Any) -> Float[Array, " k"]:
        paths, receiver = pair
        terms = [length_terms(some, cache.surfaces, movers) for some in (paths.specular, paths.diffracted)]
        number, derivative = (jnp.concatenate(parts) for parts in zip(*terms, strict=True))
        number = jnp.where(number < 6 * movers, number, number + 3 * receiver)
        shared = covariance[number[:, :, None], number[:, None, :]]
        return jnp.maximum(jnp.einsum("ki,kij,kj->k", derivative, shared, derivative, precision=EXACT), 0)

    variances: Float[Array, "pairs k"] = jax.lax.map(of_pair, (cache.paths, cache.receiver_index))
    return variances


def _jacobian(cache: Any, paths: Any, movers: int) -> Float[Array, "k numbers"]:
    return jnp.concatenate([length_jacobian(some, cache.surfaces, movers) for some in (paths.specular, paths.diffracted)])


def _among_all(own: Inexact[Array, "k numbers"], receiver: Int[Array, ""], receivers: int) -> Inexact[Array, "k p"]:
    """Returns the derivative with respect to a motion of all receivers, from that of one of them: the others' are 0."""
    places, shift, turn = own[:, :-6], own[:, -6:-3], own[:, -3:]
    none = jnp.zeros((len(own), receivers, 3), own.dtype)
    ends = [none.at[:, receiver].set(one).reshape(len(own), 3 * receivers) for one in (shift, turn)]
    return jnp.concatenate([places, *ends], 1)


@jax.jit
def normal_equations(
    field: Any,
    params: Any,
    motion: Motion,
    cache: Any,
    data: TrainingData,
    index: Int[Array, "blocks b"],
    variance: Float[Array, "pairs k"],
    blocks: Int[Array, ""],
) -> tuple[Float[Array, "p p"], Float[Array, " p"]]:
    """Returns the matrix J^T W J and the vector J^T W r of some snapshots, the first so many blocks: what is left of them is
    about r - J (a further motion), in units of its standard deviation."""

    def one(link: Int[Array, ""]) -> tuple[Float[Array, "n p"], Float[Array, " n"]]:
        batch = data.batch(link[None], jax.random.key(0))
        assert batch.snapshots is not None, "phases are what it looks at"
        asked: Any = jax.tree.map(lambda leaf: leaf[0], batch.links)
        plan = field.displaced(field.plan(params, batch.receiver, cache=cache), motion.of_receiver(asked.receiver_index))
        paths, frequency = cache.of(asked), asked.query.frequency_hz
        wavenumber = 2 * jnp.pi * frequency / SPEED_OF_LIGHT
        arrived: Arrivals = arrivals_at(params, plan, paths, frequency)
        expected = jnp.exp(-0.5 * wavenumber**2 * variance[cache.place(asked)])
        arrived = arrived._replace(amplitude=arrived.amplitude * expected)
        voltages = element_voltages(arrived, plan.receiver, frequency)
        if plan.tuning is not None:
            voltages = voltages * element_gains(plan.tuning)
        parts = jnp.concatenate([voltages.real, voltages.imag], -1)  # a real product: lengths are real
        real, imaginary = jnp.split(jnp.matmul(parts.T, _jacobian(cache, paths, len(motion.shift)), precision=EXACT), 2)
        changes = wavenumber * (imaginary - 1j * real)
        changes = changes.at[:, -3:].add(_turned(voltages, arrived, plan.receiver, frequency))
        changes = _among_all(changes, asked.receiver_index, len(motion.receiver))
        return _whitened(jnp.sum(voltages, 0), changes, batch.snapshots[0])

    def add(block: Int[Array, ""], total: Any) -> Any:
        changes, left = jax.vmap(one)(index[block])
        changes, left = changes.reshape(-1, changes.shape[-1]), left.reshape(-1)
        curvature = jnp.matmul(changes.T, changes, precision=EXACT)
        return total[0] + curvature, total[1] + jnp.matmul(changes.T, left, precision=EXACT)

    size = ravel_pytree(motion)[0].size
    total: Any = jax.lax.fori_loop(0, blocks, add, (jnp.zeros((size, size)), jnp.zeros(size)))
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
