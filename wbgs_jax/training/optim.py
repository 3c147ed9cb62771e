"""The optimiser: Adam, or Muon combined with Adam, for every group of a field's parameters, each with its own learning rate and
a common schedule.

Muon (Jordan et al. 2024) updates matrices in the direction of steepest descent under the spectral norm: the networks need 2,400
steps instead of 6,000 with Adam (docs/history.md).
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from wbgs_jax.config import OptimConfig
from wbgs_jax.fields import Field, Group
from wbgs_jax.fields.base import Params

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
