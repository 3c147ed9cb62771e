"""Gradient alignment of surfaces and receivers, for data with spectra but without snapshots.

Steps are proportional to the wavelength of the highest frequency, and the coherence of waves follows from the current
uncertainty of positions. Materials and corrections are learned together with the motion. With snapshots, `gauss_newton.py` is
faster and more accurate.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from wbgs_jax.fields.base import compare, without_unreceived
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import PreparedPaths, WaveParams
from wbgs_jax.mesh.facets import centres
from wbgs_jax.propagation.displacement import Motion
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.batches import TrainingData, batches_of_one_receiver

STEP = 0.012
"""Learning rate of motions, in wavelengths of the highest frequency."""
LONGEST_STEP = 2e-3
"""Upper bound of this learning rate, metres."""
UNSEEN = 3e-3
"""Gradient of the loss, per radian of a path's phase, below which steps shrink with the gradient, since the surface has hardly
any effect."""
BATCH = 8
"""Links per step."""
SHORTEST_ARM = 0.05
"""Minimum lever arm of rotations, metres, for small bodies."""
RATE = 5e-3
"""Learning rate of the materials and corrections."""
SEARCHED = ("transmitter", "element", "placement", "thick", "curved")
"""Parameters that other parts of the calibration determine; they are not changed here."""


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
    """Returns parameters and a motion after a number of steps on spectra up to some frequency.

    Args:
        field, params: a coherent field, which is not displaced: the motion is small.
        prepared: paths of the links of the pool.
        motion: initial motion, with all receivers.
        widths: prior standard deviations of the total motion, which includes that of the field.
        data: training data with spectra.
        pool: indices of links up to the highest frequency in use.
        count: number of steps.
        rng: random numbers.
    """
    batches = batches_of_one_receiver(data, pool, count, BATCH, rng)
    wavelength = SPEED_OF_LIGHT / float(np.asarray(data.links.frequency_hz)[pool].max())
    rate, unseen = min(STEP * wavelength, LONGEST_STEP), UNSEEN * 2 * np.pi / wavelength
    # Curvature of the normal prior, relative to a loss that is a mean over this number of values.
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
    """Returns the parameters and the motion after one step on every batch."""
    others, reach = optax.adam(RATE), _reach(field)
    # The steps of motions decay to a tenth over the batches.
    shifts = optax.adam(optax.cosine_decay_schedule(1.0, batches.shape[0], 0.1), eps=unseen)

    def objective(learned: tuple[WaveParams, Motion], index: Int[Array, " b"]) -> Float[Array, ""]:
        params, metres = learned
        batch = data.batch(index, jax.random.key(0))
        motion = _by(metres, reach)
        seen_from = motion.of_receiver(batch.links.receiver_index[0])
        plan = field.displaced(field.plan(params, batch.receiver, prepared), seen_from)
        seen = field.render(params, plan, batch.links)
        loss, _ = compare(seen, without_unreceived(batch, seen))
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
    """Returns the displacement (metres) caused by 1 metre or radian of every component of a motion. The rotation of a receiver
    only changes phases along its array, and is treated like metres."""
    facets, movers = field.facets, len(field.motion.shift)
    arms = jnp.linalg.norm(facets.corners - centres(facets, movers)[facets.mover][:, None], axis=-1)
    radius = jnp.full(movers, SHORTEST_ARM).at[facets.mover].max(jnp.max(arms, -1))
    one = jnp.ones_like(field.motion.receiver)
    return Motion(jnp.ones((movers, 3)), jnp.broadcast_to(radius[:, None], (movers, 3)), one, one)


def _by(metres: Motion, reach: Motion) -> Motion:
    return jax.tree.map(lambda leaf, far: leaf / far, metres, reach)
