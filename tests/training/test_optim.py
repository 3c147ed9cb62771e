"""Which parameter learns how fast."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import tiny_settings

from wbgs_jax.config import OptimConfig
from wbgs_jax.data.surface import surface_from_points
from wbgs_jax.fields import wideband
from wbgs_jax.training.optim import make_optimizer

RATES = {"means": 0.1, "log_scales": 0.2, "quats": 0.3, "opacity_logits": 0.4, "networks": 0.5, "alive": 0, "frame": 0}
CONFIG = OptimConfig(steps=6, means_lr=0.1, log_scales_lr=0.2, quats_lr=0.3, opacity_lr=0.4, network_lr=0.5, final_fraction=0.1)


@pytest.fixture
def params(rng):
    surface = jax.tree.map(jnp.asarray, surface_from_points(rng.normal(size=(6, 3))))
    return wideband.init(jax.random.key(0), surface, tiny_settings().wideband, 8)


def updates_of(params, config, steps):
    """The updates of some steps under a constant gradient of one, for which Adam moves by the learning rate itself."""
    optimizer = make_optimizer(config)
    state, ones = optimizer.init(params), jax.tree.map(jnp.ones_like, params)
    for _ in range(steps):
        updates, state = optimizer.update(ones, state, params)
        yield {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(updates)}


def rate_of(path):
    (name,) = [name for name in RATES if f".{name}" in path]
    return RATES[name]


def test_every_parameter_has_its_groups_rate_and_decays_by_a_cosine(params):
    for step, updates in enumerate(updates_of(params, CONFIG, 8)):
        cosine = 0.5 * (1 + np.cos(np.pi * min(step / 6, 1)))
        for path, update in updates.items():
            np.testing.assert_allclose(update, -rate_of(path) * (0.9 * cosine + 0.1), rtol=1e-4, err_msg=path)


def test_weight_decay_is_decoupled_and_for_the_networks_only(params):
    (plain,) = updates_of(params, CONFIG, 1)
    (decayed,) = updates_of(params, OptimConfig(**{**vars(CONFIG), "network_weight_decay": 0.01}), 1)
    values = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(params)}
    for path, update in decayed.items():
        shrink = 0.5 * 0.01 * values[path] if "networks" in path else 0
        np.testing.assert_allclose(update, plain[path] - shrink, atol=1e-6, err_msg=path)
