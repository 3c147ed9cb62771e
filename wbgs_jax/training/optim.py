"""The optimiser: Adam for every group of a field's parameters, each with its own learning rate; all decay by a cosine."""

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
    rate = optax.cosine_decay_schedule(group.learning_rate, optim.steps, optim.final_fraction)
    if group.weight_decay:
        return optax.adamw(rate, eps=group.eps, weight_decay=group.weight_decay)
    return optax.adam(rate, eps=group.eps)
