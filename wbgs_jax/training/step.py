"""The jitted part of training: pure functions on a `TrainState`, and the optimiser.

An epoch is a `lax.scan` over a block of batches with donated state. A step that overflows the capacity of its field, or whose
loss or gradient is not finite, commits nothing, and neither do the steps after it: the epoch returns the last good state and
where it stopped. The host then increases the capacity and repeats the step, or stops with a message.

The optimiser is Adam, or Muon combined with Adam, for every group of a field's parameters, each with its own learning rate and
a common schedule. Muon (Jordan et al. 2024) updates matrices in the direction of steepest descent under the spectral norm: the
networks need 2,400 steps instead of 6,000 with Adam (docs/history.md).
"""

import functools
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, Key

from wbgs_jax._util.devices import averaged
from wbgs_jax._util.pytree import pytree
from wbgs_jax.config import OptimConfig
from wbgs_jax.fields import Aux, Field, Group
from wbgs_jax.fields.base import Params
from wbgs_jax.training.batches import TrainingData
from wbgs_jax.training.hooks import Hook, probe_of


@pytree
class TrainState:
    """Everything that changes during training."""

    params: Params
    optimizer: Any
    statistics: tuple[Any, ...]
    """Statistics of every hook since it last acted."""
    step: Int[Array, ""]


@pytree
class EpochReport:
    """Results of an epoch of K steps."""

    loss: Float[Array, " k"]
    """NaN for steps that did not run or failed."""
    metrics: dict[str, Float[Array, " k"]]
    """Metrics of the steps, such as the mean SSIM of the batch; NaN where undefined."""
    good_steps: Int[Array, ""]
    """Number of committed steps."""
    overflow: Bool[Array, ""]
    """Whether the step after the last good one exceeded the capacity."""
    required: Int[Array, " r"] | None
    """Largest sizes that any step needed; None for a field without a capacity."""
    stopped: Bool[Array, ""]
    """Whether the epoch ended early, by overflow or by a loss or gradient that is not finite."""


def init_state(params: Params, optimizer: optax.GradientTransformation, hooks: tuple[Hook, ...] = ()) -> TrainState:
    """Returns the state before the first step."""
    statistics = tuple(hook.statistics(params) for hook in hooks)
    return TrainState(params, optimizer.init(params), statistics, jnp.zeros((), jnp.int32))


def loss_and_gradients(
    field: Field,
    params: Params,
    prepared: Any,
    data: TrainingData,
    index: Int[Array, " b"],
    capacity: Any,
    key: Key[Array, ""],
    mesh: Mesh | None = None,
    probe: Any = None,
) -> tuple[tuple[Float[Array, ""], Aux], tuple[Any, Any]]:
    """Returns ((loss, aux), (gradient of the parameters, gradient of the probe)) of one batch.

    Args:
        field: field.
        params: its parameters.
        prepared: result of the field's `prepare`.
        data: training data.
        index: indices of the links of the batch, all of one receiver.
        capacity: static sizes of the field.
        key: random key of the step.
        mesh: devices among which the links are divided evenly; the loss is then the mean over the devices.
        probe: zeros whose gradient a hook needs (`hooks.Hook.probe`), or None.
    """

    def loss(index, params, probe, field, prepared, data, key):
        return field.loss(params, prepared, data.batch(index, key), capacity, probe)

    shared = averaged(loss, mesh, divided=0)

    def objective(params, probe):
        return shared(index, params, probe, field, prepared, data, key)

    return jax.value_and_grad(objective, argnums=(0, 1), has_aux=True)(params, probe)


def _all_finite(tree: Any) -> Bool[Array, ""]:
    """Returns whether all numbers are finite. They are checked together, since a GPU takes as long for one leaf as for all."""
    return jnp.isfinite(jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(tree)])).all()


def _where(condition: Bool[Array, ""], yes: Any, no: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


@partial(jax.jit, static_argnames=("optimizer", "hooks", "capacity", "mesh", "branches"), donate_argnames="state")
def run_epoch(
    state: TrainState,
    field: Field,
    prepared: Any,
    data: TrainingData,
    batches: Int[Array, "k b"],
    first: Int[Array, ""],
    key: Key[Array, ""],
    *,
    optimizer: optax.GradientTransformation,
    hooks: tuple[Hook, ...] = (),
    capacity: Any = None,
    mesh: Mesh | None = None,
    stopped: Bool[Array, ""] | None = None,
    branches: bool = True,
) -> tuple[TrainState, EpochReport]:
    """Runs the batches of an epoch and returns the new state with a report.

    Args:
        state: state, which is donated.
        field: field.
        prepared: result of the field's `prepare`.
        data: training data.
        batches: indices of the links of K batches.
        first: number of the first batch to run.
        key: random key of the run.
        optimizer: optimiser.
        hooks: hooks.
        capacity: static sizes of the field.
        mesh: devices that share every batch; all arguments and results are then replicated on all of them.
        stopped: whether the previous epoch ended early, in which case no step runs.
        branches: whether skipped steps are not computed. On a GPU a branch waits for the host in every step; skipped steps are
            rare, so that it is faster to compute them and discard the result.
    """

    def run(state: TrainState, index: Int[Array, " b"]):
        (loss, aux), (gradients, probe) = loss_and_gradients(
            field,
            state.params,
            prepared,
            data,
            index,
            capacity,
            jax.random.fold_in(key, state.step),
            mesh,
            probe_of(hooks, state.params),
        )
        overflow = jnp.zeros((), bool) if aux.overflow is None else aux.overflow
        ok = _all_finite((loss, gradients)) & ~overflow
        updates, moments = optimizer.update(gradients, state.optimizer, state.params)
        watched = zip(hooks, state.statistics, strict=True)
        statistics = tuple(hook.accumulate(seen, gradients, probe) for hook, seen in watched)
        new = TrainState(optax.apply_updates(state.params, updates), moments, statistics, state.step + 1)
        return _where(ok, new, state), loss, aux._replace(overflow=overflow), ok

    shapes: Any = jax.eval_shape(run, state, batches[0])
    nothing: Aux = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes[2])
    nothing = nothing._replace(metrics={name: jnp.full((), jnp.nan) for name in nothing.metrics})

    def step(carry, position_and_batch):
        state, good, stopped, overflow, required = carry
        index, position = position_and_batch

        def pass_by(state: TrainState):
            return state, jnp.full((), jnp.nan), nothing._replace(overflow=overflow), jnp.zeros((), bool)

        active = (position >= first) & ~stopped
        if branches:
            state, loss, aux, ok = jax.lax.cond(active, lambda state: run(state, index), pass_by, state)
        else:
            state, loss, aux, ok = _where(active, run(state, index), pass_by(state))
        required = jax.tree.map(jnp.maximum, required, aux.required)
        carry = (state, good + ok, stopped | (active & ~ok), aux.overflow, required)
        return carry, (jnp.where(ok, loss, jnp.nan), aux.metrics)

    before = jnp.zeros((), bool) if stopped is None else stopped
    carry = (state, jnp.zeros((), jnp.int32), before, jnp.zeros((), bool), nothing.required)
    (state, good, stopped, overflow, required), (loss, metrics) = jax.lax.scan(
        step, carry, (batches, jnp.arange(batches.shape[0]))
    )
    return state, EpochReport(loss, metrics, good, overflow, required, stopped)


ADAMS_RMS = 0.2
"""Root mean square of the entries of Muon's steps, relative to the learning rate: about that of Adam, so that the same rate is
suitable for both (Liu et al. 2025)."""


@functools.lru_cache
def make_optimizer(field: type[Field], config: Any, optim: OptimConfig) -> optax.GradientTransformation:
    """Returns the optimiser of a field with its settings. Equal arguments return the same object, so that the compiled epoch is
    shared."""
    made = {"adam": _adam, "muon": make_muon}
    groups = {name: made[group.optimizer](group, optim) for name, group in field.param_groups(config)[0].items()}
    return optax.multi_transform(groups, lambda params: field.param_groups(config, params)[1])


def make_muon(group: Group, optim: OptimConfig) -> optax.GradientTransformation:
    """Returns Muon for the matrices among a group's parameters, combined with Adam for the others."""
    rate = schedule(group.learning_rate, optim)
    all_axes = {"matrices": optax.contrib.MuonDimensionNumbers(reduction_axis=1, output_axis=2)}
    matrices = optax.contrib.muon(
        rate, consistent_rms=ADAMS_RMS, weight_decay=group.weight_decay, muon_weight_dimension_numbers=all_axes
    )
    kinds = {"matrix": _stacked(matrices), "other": _adam(group, optim)}
    return optax.multi_transform(kinds, lambda tree: jax.tree.map(lambda leaf: "matrix" if leaf.ndim == 2 else "other", tree))


def _stacked(inner: optax.GradientTransformation) -> optax.GradientTransformation:
    """Returns a transformation that is applied to a tree of matrices as one stack, padded with zeros: separate Newton-Schulz
    iterations would take ten seconds to compile. Zeros remain zeros, so that steps are the same except that they scale with the
    longest side of the stack."""

    def init(params: Params) -> Any:
        return inner.init({"matrices": _stack(params)})

    def update(updates: Any, state: Any, params: Params = None) -> tuple[Any, Any]:
        known = None if params is None else {"matrices": _stack(params)}
        steps, state = inner.update({"matrices": _stack(updates)}, state, known)
        leaves, structure = jax.tree.flatten(updates)
        pairs = zip(leaves, steps["matrices"], strict=True)
        return jax.tree.unflatten(structure, [step[: leaf.shape[0], : leaf.shape[1]] for leaf, step in pairs]), state

    return optax.GradientTransformation(init, update)


def _stack(tree: Any) -> Float[Array, "matrices rows columns"]:
    leaves = jax.tree.leaves(tree)
    rows, columns = (max(leaf.shape[axis] for leaf in leaves) for axis in (0, 1))
    return jnp.stack([jnp.pad(leaf, ((0, rows - leaf.shape[0]), (0, columns - leaf.shape[1]))) for leaf in leaves])


def _adam(group: Group, optim: OptimConfig) -> optax.GradientTransformation:
    rate = schedule(group.learning_rate, optim)
    if group.weight_decay:
        return optax.adamw(rate, eps=group.eps, weight_decay=group.weight_decay)
    return optax.adam(rate, eps=group.eps)


def schedule(peak: float, optim: OptimConfig) -> optax.Schedule:
    """Returns a learning rate as a function of the step: linear over the warm-up, then a cosine decay from `peak`."""
    rise = round(optim.warmup * optim.steps)
    decay = optax.cosine_decay_schedule(peak, max(optim.steps - rise, 1), optim.final_fraction)
    return optax.join_schedules([optax.linear_schedule(peak / (rise + 1), peak, rise), decay], [rise]) if rise else decay
