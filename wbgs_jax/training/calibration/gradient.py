"""Where surfaces and the receiver stand, by gradient descent, for data that hold spectra and no snapshots.

Steps are in proportion to the wavelength of the highest frequency, and waves as coherent as places are known by then. Materials
and corrections are learned beside the motion. With snapshots `gauss_newton.py` is faster and nearer to the truth.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from wbgs_jax.fields.base import compare, heard_alone
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import PreparedPaths, WaveParams
from wbgs_jax.mesh.facets import centres
from wbgs_jax.propagation.displacement import Motion
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.batches import TrainingData, batches_of_one_receiver

STEP = 0.012
"""Learning rate, in wavelengths of the highest frequency, at most ..."""
LONGEST_STEP = 2e-3
"""... so many metres."""
UNSEEN = 3e-3
"""Gradient of the loss, per radian of a path's phase, of a surface that is hardly seen: below it, steps shrink with it."""
BATCH = 8
SHORTEST_ARM = 0.05
"""Metres: smaller things turn like one of this size."""
RATE = 5e-3
"""Of the materials and corrections that are learned beside ..."""
SEARCHED = ("transmitter", "element", "placement", "thick", "curved")
"""... these, which are searched elsewhere and stay as they were found."""


def descend(
    field: Calibratable,
    params: WaveParams,
    prepared: PreparedPaths,
    motion: Motion,
    widths: Motion,
    data: TrainingData,
    pool: Int[np.ndarray, " n"],
    count: int,
    rng: np.random.Generator,
) -> tuple[WaveParams, Motion]:
    """Returns parameters and a motion after some steps on spectra up to some frequency.

    Args:
        field, params: a coherent field, which is not moved: the motion is small.
        prepared: paths of the links of the pool.
        motion: the one to start with, of all receivers.
        widths: standard deviations of the prior of the whole motion, that of the field included.
        data: with spectra.
        pool: links, up to the highest frequency that counts.
        count: steps.
        rng: draws their batches.
    """
    batches = batches_of_one_receiver(data, pool, count, BATCH, rng)
    wavelength = SPEED_OF_LIGHT / float(np.asarray(data.links.query.frequency_hz)[pool].max())
    rate, unseen = min(STEP * wavelength, LONGEST_STEP), UNSEEN * 2 * np.pi / wavelength
    # The curvature of the normal prior, beside a loss that is a mean over so many numbers.
    numbers = len(pool) * data.receivers.element_positions.shape[-2]
    prior = jax.tree.map(lambda far: 1 / (far**2 * numbers), widths)
    return _steps(field, params, motion, prepared, data, batches, rate, unseen, prior)


@jax.jit
def _steps(
    field: Calibratable,
    params: WaveParams,
    motion: Motion,
    prepared: PreparedPaths,
    data: TrainingData,
    batches: Int[Array, "k b"],
    rate: float | Float[Array, ""],
    unseen: float | Float[Array, ""],
    prior: Motion,
) -> tuple[WaveParams, Motion]:
    """Learns a motion, with materials and corrections beside it, on some batches."""
    others, reach = optax.adam(RATE), _reach(field)
    # Steps of motions shrink to a tenth over the batches.
    shifts = optax.adam(optax.cosine_decay_schedule(1.0, batches.shape[0], 0.1), eps=unseen)

    def objective(learned: tuple[WaveParams, Motion], index: Int[Array, " b"]) -> Float[Array, ""]:
        params, metres = learned
        batch = data.batch(index, jax.random.key(0))
        motion = _by(metres, reach)
        seen_from = motion.of_receiver(batch.links.receiver_index[0])
        plan = field.displaced(field.plan(params, batch.receiver, prepared), seen_from)
        seen = field.render(params, plan, batch.links)
        loss, _ = compare(seen, heard_alone(batch, seen))
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


def _reach(field: Calibratable) -> Motion:
    """Returns how far (metres) a motion of 1 metre or radian moves what it moves; the receiver's turn moves no more than phases
    along its array, and counts like metres."""
    facets, movers = field.facets, len(field.motion.shift)
    arms = jnp.linalg.norm(facets.corners - centres(facets, movers)[facets.mover][:, None], axis=-1)
    radius = jnp.full(movers, SHORTEST_ARM).at[facets.mover].max(jnp.max(arms, -1))
    one = jnp.ones_like(field.motion.receiver)
    return Motion(jnp.ones((movers, 3)), jnp.broadcast_to(radius[:, None], (movers, 3)), one, one)


def _by(metres: Motion, reach: Motion) -> Motion:
    return jax.tree.map(lambda leaf, far: leaf / far, metres, reach)
