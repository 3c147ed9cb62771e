"""Which parameter learns how fast."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from builders.synthetic import tiny_dataset, tiny_settings

from wbgs_jax.config import OptimConfig
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.fields import Group, get_field
from wbgs_jax.training.step import ADAMS_RMS, make_muon, make_optimizer, schedule

OPTIM = OptimConfig(steps=6, final_fraction=0.1)
RATES = {
    "wideband": {"means": 0.1, "log_scales": 0.2, "quats": 0.3, "opacity": 0.4, "features": 0.6, "network": 0.5},
    "wave": {"materials": 0.1, "thickness": 0.2, "corrections": 0.3, "antennas": 0.4, "placement": 0.5},
    "nerf2": {"network": 0.1},
}
"""The settings that hold a learning rate, NAME_lr, by field."""
PLACES = {
    "wideband": {
        ".gaussians.means": "means",
        ".gaussians.log_scales": "log_scales",
        ".gaussians.quats": "quats",
        ".gaussians.opacity_logits": "opacity",
        ".gaussians.features": "features",
        ".networks": "network",
    },
    "wave": {
        ".materials.log_thickness": "thickness",
        ".materials": "materials",
        ".facet_correction": "corrections",
        ".excess_loss": "corrections",
        ".log_gain": "corrections",
        ".transmitter": "antennas",
        ".element": "antennas",
        ".placement": "placement",
        ".thick": None,
        ".curved": None,
    },
    "nerf2": {"[": "network"},
}
"""Which rate belongs to a place in the parameters: the first that fits; none where nothing is trained."""


def config_of(name, **changes):
    """By Adam, whose steps under a constant gradient are known."""
    rates = {f"{rate}_lr": value for rate, value in RATES[name].items()}
    adam = {} if name == "wave" else {"network_optimizer": "adam"}
    return dataclasses.replace(tiny_settings(name).field, **rates, **(adam | changes))


@pytest.fixture(scope="module")
def params():
    """Parameters by field: their shapes, and made-up values."""
    rng, made = np.random.default_rng(0), {}
    for name in RATES:
        field = get_field(name).build(config_of(name), DatasetScene(tiny_dataset()), 0)
        shapes = jax.eval_shape(field.init, jax.random.key(0))
        made[name] = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype), shapes)
    return made


def by_place(tree):
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def updates_of(name, params, config, steps):
    """The updates of some steps under a constant gradient of one, for which Adam moves by the learning rate itself."""
    optimizer = make_optimizer(get_field(name), config, OPTIM)
    update = jax.jit(optimizer.update)
    state, ones = jax.jit(optimizer.init)(params), jax.tree.map(jnp.ones_like, params)
    for _ in range(steps):
        updates, state = update(ones, state, params)
        yield by_place(updates)


@pytest.mark.parametrize("name", RATES)
def test_every_parameter_has_its_groups_rate_and_decays_by_a_cosine(params, name):
    found = set()
    for step, updates in enumerate(updates_of(name, params[name], config_of(name), 8)):
        cosine = 0.5 * (1 + np.cos(np.pi * min(step / 6, 1)))
        for path, update in updates.items():
            rate = next(rate for place, rate in PLACES[name].items() if path.startswith(place))
            length = RATES[name][rate] if rate else 0.0
            np.testing.assert_allclose(update, -length * (0.9 * cosine + 0.1), rtol=1e-4, err_msg=path)
            found.add(rate)
    assert found - {None} == set(RATES[name])


def test_weight_decay_is_decoupled_and_for_the_networks_only(params):
    (plain,) = updates_of("wideband", params["wideband"], config_of("wideband"), 1)
    (decayed,) = updates_of("wideband", params["wideband"], config_of("wideband", network_weight_decay=0.01), 1)
    values = by_place(params["wideband"])
    for path, update in decayed.items():
        shrink = 0.5 * 0.01 * values[path] if "networks" in path else 0
        np.testing.assert_allclose(update, plain[path] - shrink, atol=1e-6, err_msg=path)


def test_muon_makes_the_singular_values_of_a_step_equal(params, rng):
    """Newton-Schulz's five iterations take them to between 0.7 and 1.2 (Jordan et al. 2024); none of the gradient's is tiny."""
    config, networks = config_of("wideband", network_optimizer="muon"), params["wideband"].networks
    optimizer = make_optimizer(get_field("wideband"), config, OPTIM)

    def skewed(leaf):
        if leaf.ndim == 1:
            return jnp.asarray(rng.normal(size=leaf.shape))
        u, values, vh = np.linalg.svd(rng.normal(size=leaf.shape), full_matrices=False)
        return jnp.asarray((u * 10 ** rng.uniform(-1, 0, values.shape)) @ vh)

    gradients = dataclasses.replace(jax.tree.map(jnp.ones_like, params["wideband"]), networks=jax.tree.map(skewed, networks))
    updates, _ = jax.jit(optimizer.update)(gradients, optimizer.init(params["wideband"]), params["wideband"])
    sides = [leaf.shape for leaf in jax.tree.leaves(networks) if leaf.ndim == 2]
    unit = 0.5 * ADAMS_RMS * np.sqrt(np.max(sides))
    for path, update in by_place(updates.networks).items():
        if update.ndim == 1:
            np.testing.assert_allclose(np.abs(update), 0.5, rtol=1e-3, err_msg=path)  # Adam's first step
            continue
        values = np.linalg.svd(update, compute_uv=False) / unit
        assert values.min() > 0.65 and values.max() < 1.25, path
    for path, update in by_place(updates.gaussians).items():
        np.testing.assert_allclose(update, -RATES["wideband"][PLACES["wideband"][f".gaussians{path}"]], rtol=1e-4)


@pytest.mark.heavy
def test_a_stack_of_matrices_is_moved_like_each_by_itself(rng):
    shapes = ((8, 8), (3, 8), (8, 1), (5, 8))  # one side in common: the unit of a step is the longest
    weights, gradients = ([jnp.asarray(rng.normal(size=shape)) for shape in shapes] for _ in range(2))
    together = make_muon(Group(0.1, weight_decay=0.02), OPTIM)
    alone = optax.contrib.muon(schedule(0.1, OPTIM), consistent_rms=ADAMS_RMS, weight_decay=0.02)
    states = together.init(weights), alone.init(weights)
    for _ in range(3):
        moved, expected = together.update(gradients, states[0], weights), alone.update(gradients, states[1], weights)
        states = moved[1], expected[1]
        for own, other in zip(moved[0], expected[0], strict=True):
            np.testing.assert_allclose(own, other, atol=1e-5)
        gradients = [gradient[::-1] for gradient in gradients]


def test_equal_settings_share_one_optimiser():
    """And with it the compiled epoch."""
    field = get_field("wideband")
    assert make_optimizer(field, config_of("wideband"), OPTIM) is make_optimizer(field, config_of("wideband"), OPTIM)
    other = dataclasses.replace(OPTIM, final_fraction=0.2)
    assert make_optimizer(field, config_of("wideband"), OPTIM) is not make_optimizer(field, config_of("wideband"), other)


def test_a_warm_up_rises_in_a_line_to_where_the_cosine_begins():
    optim = OptimConfig(steps=100, warmup=0.2, final_fraction=0.1)
    rate = np.array([schedule(0.5, optim)(step) for step in range(121)])
    np.testing.assert_allclose(np.diff(rate[:21]), (0.5 - rate[0]) / 20, rtol=1e-3)
    assert 0 < rate[0] < 0.05 and rate.argmax() == 20 and rate[20] == pytest.approx(0.5)
    cosine = 0.5 * (1 + np.cos(np.pi * np.clip((np.arange(121) - 20) / 80, 0, 1)))
    np.testing.assert_allclose(rate[20:], 0.5 * (0.9 * cosine + 0.1)[20:], rtol=1e-4)
    plain = schedule(0.5, dataclasses.replace(optim, warmup=0.0))
    assert plain(0) == 0.5 and plain(100) == pytest.approx(0.05)
