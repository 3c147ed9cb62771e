"""The jitted part of training: pure functions on a `TrainState`.

An epoch is a `lax.scan` over a block of batches with donated state. A step that overflowed its field's capacity, or whose loss
or gradient is not finite, commits nothing, and neither do the steps after it: the epoch returns the last good state and says
where it stopped, and the host decides (a larger capacity and repeat, or stop with a message).
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, Key

from wbgs_jax._util.devices import averaged
from wbgs_jax._util.pytree import pytree
from wbgs_jax.fields import Aux, Field
from wbgs_jax.fields.base import Params
from wbgs_jax.training.batches import TrainingData
from wbgs_jax.training.hooks import Hook, probe_of


@pytree
class TrainState:
    """Everything that changes during training."""

    params: Params
    optimizer: Any
    statistics: tuple[Any, ...]
    """What every hook has watched since it last acted."""
    step: Int[Array, ""]


@pytree
class EpochReport:
    """What an epoch of K steps tells the host."""

    loss: Float[Array, " k"]
    """NaN for steps that did not run or failed."""
    metrics: dict[str, Float[Array, " k"]]
    """Figures of the steps, such as the mean SSIM of the batch; NaN where they mean nothing."""
    good_steps: Int[Array, ""]
    """Steps committed, counted from the epoch's start."""
    overflow: Bool[Array, ""]
    """The step after the last good one did not fit its capacity ..."""
    required: Int[Array, " r"] | None
    """... and required this much (the largest seen); None for a field without a capacity."""
    stopped: Bool[Array, ""]
    """The epoch ended early, by overflow or a loss or gradient that is not finite."""


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
    """Returns ((loss, aux), (gradient of the parameters, gradient of the probe)) of one batch. The devices of a mesh divide
    the links evenly; the loss is the mean of theirs."""

    def loss(index, params, probe, field, prepared, data, key):
        return field.loss(params, prepared, data.batch(index, key), capacity, probe)

    shared = averaged(loss, mesh, divided=0)

    def objective(params, probe):
        return shared(index, params, probe, field, prepared, data, key)

    return jax.value_and_grad(objective, argnums=(0, 1), has_aux=True)(params, probe)


def _all_finite(tree: Any) -> Bool[Array, ""]:
    """Returns whether all numbers are finite: looked at together, since a GPU takes as long for a leaf as for all of them."""
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
    """Runs the batches of an epoch from number `first` on; `key` is that of the run. Gives the state away. With a mesh all
    arguments are on all of its devices, and so are the results. Where `stopped`, the epoch before ended early: no step runs.

    Without `branches` steps that are passed by are computed in vain: of a branch a GPU waits for the host in every step, and
    they are rare.
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
