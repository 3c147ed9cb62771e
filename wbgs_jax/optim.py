"""One optax group a parameter kind, each with its own learning rate; all decay by a cosine."""

from typing import Any

import jax
import optax

from wbgs_jax.config import OptimConfig

FROZEN = "frozen"
_BY_NAME = {
    "means": "means",
    "log_scales": "log_scales",
    "quats": "quats",
    "opacity_logits": "opacity_logits",
    "log_thickness": "thickness",
    "known_thickness": FROZEN,
    "materials": "materials",
    "residual": "residual",
    "log_survival": "residual",
    "log_gain": "residual",
}


def parameter_group(path: tuple[Any, ...]) -> str:
    """The group of a parameter from its place in the tree; what has no group is not trained."""
    names = [str(getattr(entry, "name", getattr(entry, "key", ""))) for entry in path]
    if "networks" in names:
        return "networks"
    return next((_BY_NAME[name] for name in reversed(names) if name in _BY_NAME), FROZEN)


def make_optimizer(config: OptimConfig) -> optax.GradientTransformation:
    """Adam for every group, decoupled weight decay for the networks."""

    def decay(learning_rate: float) -> optax.Schedule:
        return optax.cosine_decay_schedule(learning_rate, config.steps, config.final_fraction)

    rates = {
        "means": config.means_lr,
        "log_scales": config.log_scales_lr,
        "quats": config.quats_lr,
        "opacity_logits": config.opacity_lr,
        "materials": config.materials_lr,
        "thickness": config.thickness_lr,
        "residual": config.residual_lr,
    }
    groups: dict[str, optax.GradientTransformation] = {name: optax.adam(decay(rate), eps=1e-15) for name, rate in rates.items()}
    groups["networks"] = optax.adamw(decay(config.network_lr), weight_decay=config.network_weight_decay)
    groups[FROZEN] = optax.set_to_zero()
    return optax.multi_transform(
        groups, lambda params: jax.tree_util.tree_map_with_path(lambda path, _: parameter_group(path), params)
    )
