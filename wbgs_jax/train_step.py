"""The jitted part of training: pure functions on a `TrainState`.

An epoch is a `lax.scan` over a block of batches with donated state. A step whose tile lists overflowed, or whose loss or
gradient is not finite, commits nothing, and neither do the steps after it: the epoch returns the last good state and says
where it stopped, and the host decides (larger capacity and repeat, or stop with a message).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Complex, Float, Int, UInt8

from wbgs_jax.array import PAS_HEIGHT, PAS_WIDTH, cbf, normalise, pas_directions, steering_vector
from wbgs_jax.config import OptimConfig
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.fields import Field, SampledField
from wbgs_jax.losses import image_loss, pixel_loss, snapshot_loss
from wbgs_jax.pytree import pytree
from wbgs_jax.splat import Capacity
from wbgs_jax.types import Query, Receiver


@pytree
class DensityStats:
    """What density control needs to know about every Gaussian, summed since the last control."""

    gradient_norm: Float[Array, "n"]
    """Norm of the positional gradient on the image, in normalised coordinates (-1..1 across the image)."""
    mean_gradient: Float[Array, "n 3"]
    """Gradient of the loss with respect to the mean (per metre)."""
    visible: Float[Array, "n"]
    """Steps in which the Gaussian touched the image."""


@pytree
class TrainState:
    """Everything that changes during training."""

    params: Any
    optimizer: Any
    density: DensityStats
    step: Int[Array, ""]


@pytree
class TrainingData:
    """All spectra on the device, as 16 complex numbers or 8-bit pixels each; images are made in the step."""

    receiver: Receiver
    query: Query
    snapshots: Complex[Array, "n elements"] | None
    steering: Complex[Array, "90 360 elements"] | None
    images: UInt8[Array, "n 90 360"] | None
    tx_index: Int[Array, "n"]
    """Transmitter of every spectrum."""
    memory: Any = None
    """What the field remembers of the transmitters (`fields.Field.remember`)."""

    def pas(self, index: Int[Array, "b"]) -> Float[Array, "b 90 360"]:
        """Observed spectra."""
        if self.images is not None:
            return self.images[index].astype(jnp.float32) / 255
        assert self.snapshots is not None and self.steering is not None
        return normalise(cbf(self.snapshots[index], self.steering))


@pytree
class EpochReport:
    """What an epoch of K steps tells the host."""

    loss: Float[Array, "k"]
    """NaN for steps that did not run or failed."""
    ssim: Float[Array, "k"]
    """Mean SSIM of the batch (11x11 Gaussian window), as in the loss; NaN where only some pixels were looked at."""
    good_steps: Int[Array, ""]
    """Steps committed, counted from the epoch's start."""
    overflow: Bool[Array, ""]
    """The step after the last good one did not fit its capacity ..."""
    required: Int[Array, "2"]
    """... and needed this many entries and jobs (the largest seen)."""
    stopped: Bool[Array, ""]
    """The epoch ended early, by overflow or a loss or gradient that is not finite."""


def training_data(dataset: Dataset) -> TrainingData:
    """Move a dataset to the device."""
    everything = np.arange(len(dataset))
    steering = None
    if dataset.snapshots is not None:
        steering = jax.jit(steering_vector)(dataset.receiver.element_positions, jnp.asarray(pas_directions(), jnp.float32))
        assert steering.shape[:2] == (PAS_HEIGHT, PAS_WIDTH)
    return TrainingData(
        receiver=dataset.receiver,
        query=dataset.query(everything),
        snapshots=None if dataset.snapshots is None else jnp.asarray(dataset.snapshots, jnp.complex64),
        steering=steering,
        images=None if dataset.images is None else jnp.asarray(dataset.images),
        tx_index=jnp.asarray(dataset.tx_index, jnp.int32),
    )


def empty_density_stats(n: int) -> DensityStats:
    """Zero statistics of n Gaussians."""
    return DensityStats(jnp.zeros(n), jnp.zeros((n, 3)), jnp.zeros(n))


def gaussian_count(params: Any) -> int:
    """Room for Gaussians; 0 for a field without them, to which density control does not apply."""
    return params.gaussians.means.shape[0] if hasattr(params, "gaussians") else 0


def init_state(params: Any, optimizer: optax.GradientTransformation) -> TrainState:
    """The state before the first step."""
    density = empty_density_stats(gaussian_count(params))
    return TrainState(params, optimizer.init(params), density, jnp.zeros((), jnp.int32))


def loss_and_gradients(
    field: Field,
    params: Any,
    data: TrainingData,
    index: Int[Array, "b"],
    capacity: Capacity | None,
    optim: OptimConfig,
    step: Int[Array, ""] | int = 0,
):
    """((loss, (ssim, jobs)), (d params, d means2d)) of one batch; jobs are None for a field that does not splat.

    A field that looks at some directions only gets those that the number of the step draws; its SSIM is NaN.
    """
    probe = jnp.zeros((gaussian_count(params), 2))

    def objective(params, probe):
        query = jax.tree.map(lambda a: a[index], data.query)
        if isinstance(field, SampledField):
            pixels = field.choose_pixels(params, jax.random.fold_in(jax.random.key(0), step))
            truth = data.pas(index).reshape(len(index), -1)[:, pixels]
            loss = pixel_loss(field.observe_pixels(params, data.receiver, query, pixels), truth, optim.pixel_loss)
            return loss, (jnp.full((), jnp.nan), None)
        seen = field.observe(params, data.memory, data.receiver, query, data.tx_index[index], capacity, probe)
        loss, ssim = image_loss(seen.pas, data.pas(index), optim.ssim_weight)
        if seen.snapshots is not None and data.snapshots is not None:
            unlike, louder = snapshot_loss(seen.snapshots, data.snapshots[index])
            loss += optim.snapshot_weight * unlike + optim.power_weight * louder
        return loss + seen.penalty, (ssim, seen.jobs)

    return jax.value_and_grad(objective, argnums=(0, 1), has_aux=True)(params, probe)


def _add_density(stats: DensityStats, gradients: Any, means2d_gradient: Float[Array, "n 2"]) -> DensityStats:
    if not stats.visible.size:
        return stats
    to_normalised = jnp.array([PAS_WIDTH / 2, PAS_HEIGHT / 2])
    norm = jnp.linalg.norm(means2d_gradient * to_normalised, axis=-1)
    mean_gradient = stats.mean_gradient + gradients.gaussians.means
    return DensityStats(stats.gradient_norm + norm, mean_gradient, stats.visible + (norm > 0))


def _all_finite(tree: Any) -> Bool[Array, ""]:
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()


EpochFunction = Callable[[TrainState, TrainingData, Int[Array, "k b"], Int[Array, ""]], tuple[TrainState, EpochReport]]


def make_epoch(
    field: Field, optimizer: optax.GradientTransformation, capacity: Capacity | None, optim: OptimConfig
) -> EpochFunction:
    """A jitted epoch: (state, data, batches (K, B), first step to run) -> (state, report). The state is donated."""

    def step(data: TrainingData, first: Int[Array, ""], carry, batch):
        state, good, stopped, overflow, required = carry
        index, position = batch

        def run(state: TrainState):
            (loss, (ssim, jobs)), (gradients, probe) = loss_and_gradients(
                field, state.params, data, index, capacity, optim, state.step
            )
            overflow, needed = jnp.zeros((), bool), jnp.zeros(2, jnp.int32)
            if jobs is not None:
                overflow, needed = jobs.overflow, jnp.stack([jobs.required_entries, jobs.required_jobs])
            ok = _all_finite((loss, gradients)) & ~overflow
            updates, optimizer_state = optimizer.update(gradients, state.optimizer, state.params)
            density = _add_density(state.density, gradients, probe)
            new = TrainState(optax.apply_updates(state.params, updates), optimizer_state, density, state.step + 1)
            state = jax.tree.map(lambda a, b: jnp.where(ok, a, b), new, state)
            return state, loss, ssim, ok, overflow, needed

        def pass_by(state: TrainState):
            nan = jnp.full((), jnp.nan)
            return state, nan, nan, jnp.zeros((), bool), overflow, jnp.zeros(2, jnp.int32)

        active = (position >= first) & ~stopped
        state, loss, ssim, ok, overflowed, needed = jax.lax.cond(active, run, pass_by, state)
        carry = (state, good + ok, stopped | (active & ~ok), overflowed, jnp.maximum(required, needed))
        return carry, (jnp.where(ok, loss, jnp.nan), ssim)

    @partial(jax.jit, donate_argnums=0)
    def epoch(state: TrainState, data: TrainingData, batches: Int[Array, "k b"], first: Int[Array, ""]):
        nothing, false = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        carry = (state, nothing, false, false, jnp.zeros(2, jnp.int32))
        steps = (batches, jnp.arange(batches.shape[0]))
        (state, good, stopped, overflow, required), (loss, ssim) = jax.lax.scan(partial(step, data, first), carry, steps)
        return state, EpochReport(loss, ssim, good, overflow, required, stopped)

    return epoch
