"""The optimiser: Adam for every group of a field's parameters, each with its own learning rate; all rise and decay together."""

import functools
from typing import Any

import optax

from wbgs_jax.config import OptimConfig
from wbgs_jax.fields import Field, Group


@functools.lru_cache
def make_optimizer(field: type[Field], config: Any, optim: OptimConfig) -> optax.GradientTransformation:
    """Returns the optimiser of a field with some settings. Equal arguments share one, and with it the compiled epoch."""
    groups = {name: _adam(group, optim) for name, group in field.groups(config).items()}
    return optax.multi_transform(groups, field.labels)


def _adam(group: Group, optim: OptimConfig) -> optax.GradientTransformation:
    rate = schedule(group.learning_rate, optim)
    if group.weight_decay:
        return optax.adamw(rate, eps=group.eps, weight_decay=group.weight_decay)
    return optax.adam(rate, eps=group.eps)


def schedule(peak: float, optim: OptimConfig) -> optax.Schedule:
    """Returns a learning rate as a function of the step: a linear rise over the warm-up, then a cosine."""
    rise = round(optim.warmup * optim.steps)
    decay = optax.cosine_decay_schedule(peak, max(optim.steps - rise, 1), optim.final_fraction)
    return optax.join_schedules([optax.linear_schedule(peak / (rise + 1), peak, rise), decay], [rise]) if rise else decay
