"""Density control on hand-made Gaussians: who is cloned, split, removed, and what travels along."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import make_epoch, make_optimizer, tiny_dataset, tiny_settings

from wbgs_jax.config import DensityConfig
from wbgs_jax.data.surface import surface_from_points
from wbgs_jax.training.density import capacity_bucket, choose, control_density, reset_attenuation
from wbgs_jax.fields import wideband
from wbgs_jax.splat import Capacity
from wbgs_jax.training.step import DensityStats, TrainState, init_state, training_data

SETTINGS = tiny_settings()
OPTIMIZER = make_optimizer(SETTINGS.optim)
CONFIG = DensityConfig(gradient_threshold=1.0, split_scale=0.5, prune_attenuation=0.005, max_gaussians=100)
CALM, CLONED, SPLIT, USELESS, UNSEEN, DEAD = range(6)  # the Gaussians of `state`


def make_state(rng, means, log_scales, quats, logits, gradient, visible) -> TrainState:
    """Gaussians of the given shapes padded to 64, with moments that are different everywhere."""
    n = len(means)
    surface = jax.tree.map(jnp.asarray, surface_from_points(rng.normal(size=(n, 3))))
    params = wideband.init(jax.random.key(0), surface, SETTINGS.wideband, 64)

    def put(padded, values):
        return padded.at[:n].set(jnp.asarray(values, jnp.float32))

    gaussians = params.gaussians
    gaussians = dataclasses.replace(
        gaussians,
        means=put(gaussians.means, means),
        log_scales=put(gaussians.log_scales, log_scales),
        quats=put(gaussians.quats, quats),
        opacity_logits=put(gaussians.opacity_logits, logits),
    )
    state = init_state(dataclasses.replace(params, gaussians=gaussians), OPTIMIZER)
    zeros = state.density
    density = DensityStats(
        gradient_norm=put(zeros.gradient_norm, gradient),
        mean_gradient=put(zeros.mean_gradient, rng.normal(size=(n, 3))),
        visible=put(zeros.visible, visible),
    )
    moments = jax.tree.map(lambda a: jnp.asarray(rng.uniform(1, 2, a.shape), a.dtype) if a.ndim else a + 7, state.optimizer)
    return dataclasses.replace(state, optimizer=moments, density=density, step=jnp.asarray(7, jnp.int32))


@pytest.fixture
def state(rng):
    log_scales = np.log(np.full((6, 3), 0.2)) + 0.1 * rng.normal(size=(6, 3))
    log_scales[SPLIT, 1] = np.log(0.9)  # one long axis is enough
    logits = np.array([0.0, 0.5, -1.0, -9.0, 0.2, 0.3])
    # Sums over the visible steps: 0.9, 3, 4, 9 and 50 a step; the unseen one has no gradient.
    gradient, visible = np.array([9.0, 6, 8, 18, 0, 50]), np.array([10.0, 2, 2, 2, 0, 1])
    means = rng.normal(size=(6, 3)) * 0.5 + [0, 0, 2.5]  # above the receiver's horizon, where training sees them
    made = make_state(rng, means, log_scales, rng.normal(size=(6, 4)), logits, gradient, visible)
    gaussians = dataclasses.replace(made.params.gaussians, alive=made.params.gaussians.alive.at[DEAD].set(0))
    return dataclasses.replace(made, params=dataclasses.replace(made.params, gaussians=gaussians))


def control(state, config=CONFIG, seed=0):
    return control_density(state, config, np.random.default_rng(seed))


def rows(gaussians):
    return {name: np.asarray(getattr(gaussians, name)) for name in ("means", "log_scales", "quats", "opacity_logits")}


def per_gaussian(state):
    """Moments and statistics with a row for every Gaussian, by their place in the tree."""
    leaves = jax.tree_util.tree_leaves_with_path(state.optimizer)
    return {
        jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves if ".gaussians." in jax.tree_util.keystr(path)
    }


def test_who_stays_and_who_comes(state):
    new, report = control(state)
    assert dataclasses.asdict(report) == {"cloned": 1, "split": 1, "pruned": 1, "alive": 6}
    old, got = rows(state.params.gaussians), rows(new.params.gaussians)
    alive = np.asarray(new.params.gaussians.alive)
    assert alive.tolist() == [1] * 6 + [0] * (len(alive) - 6)
    survivors = [CALM, CLONED, UNSEEN]
    for name in old:
        np.testing.assert_array_equal(got[name][:3], old[name][survivors], err_msg=name)
        parents = old[name][[CLONED, SPLIT, SPLIT]]
        if name == "log_scales":
            parents = parents - [[0], [np.log(1.6)], [np.log(1.6)]]
        if name != "means":
            np.testing.assert_allclose(got[name][3:6], parents, rtol=1e-6, err_msg=name)


def test_a_clone_steps_downhill_by_half_its_smallest_deviation(state):
    new, _ = control(state)
    step = np.asarray(new.params.gaussians.means[3] - state.params.gaussians.means[CLONED])
    gradient = np.asarray(state.density.mean_gradient[CLONED])
    length = 0.5 * np.exp(np.asarray(state.params.gaussians.log_scales[CLONED]).min())
    np.testing.assert_allclose(step, -length * gradient / np.linalg.norm(gradient), atol=1e-5)


def test_halves_are_drawn_from_the_gaussian_they_replace(rng):
    """Their scatter, over many equal parents, is the parent's covariance."""
    n = 60
    mean, log_scales, quat = rng.normal(size=3), np.log([0.2, 0.6, 1.5]), rng.normal(size=4)
    tiled = [np.tile(a, (n, 1)) for a in (mean, log_scales, quat)]
    state = make_state(rng, *tiled, np.zeros(n), np.full(n, 5.0), np.ones(n))
    draws = []
    for seed in range(20):
        new, report = control(state, dataclasses.replace(CONFIG, max_gaussians=1000), seed)
        assert report.split == n and report.alive == 2 * n
        draws.append(np.asarray(new.params.gaussians.means[: 2 * n]) - mean)
    own_axes = Rotation.from_quat(quat, scalar_first=True).inv().apply(np.concatenate(draws)) / np.exp(log_scales)
    np.testing.assert_allclose(np.cov(own_axes.T), np.eye(3), atol=0.15)
    np.testing.assert_allclose(own_axes.mean(0), 0, atol=0.12)


def test_moments_travel_with_survivors_and_are_zero_for_the_new(state):
    new, _ = control(state)
    before, after = per_gaussian(state), per_gaussian(new)
    assert len(after) >= 8  # two moments of four parameters
    for path, moments in after.items():
        np.testing.assert_array_equal(moments[:3], before[path][[CALM, CLONED, UNSEEN]], err_msg=path)
        assert not moments[3:].any(), path
    others = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(new.optimizer)]
    assert any("networks" in path for path in others)
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(new.optimizer), jax.tree.leaves(state.optimizer), strict=True):
        if ".gaussians." not in jax.tree_util.keystr(path):
            np.testing.assert_array_equal(a, b)


def test_statistics_start_anew_and_the_step_stays(state):
    new, _ = control(state)
    assert int(new.step) == 7
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(new.density))
    np.testing.assert_array_equal(jax.tree.leaves(new.params.networks)[0], jax.tree.leaves(state.params.networks)[0])


def test_the_neediest_come_first_where_room_is_short(state):
    one_more = dataclasses.replace(CONFIG, max_gaussians=5)  # four are useful
    new, report = control(state, one_more)
    assert (report.cloned, report.split, report.alive) == (0, 1, 5)
    full = dataclasses.replace(CONFIG, max_gaussians=4)
    assert dataclasses.asdict(control(state, full)[1]) == {"cloned": 0, "split": 0, "pruned": 1, "alive": 4}
    below = dataclasses.replace(CONFIG, max_gaussians=2)  # never a reason to remove useful ones
    assert control(state, below)[1].alive == 4
    assert new.params.gaussians.alive.sum() == 5


def test_a_field_of_useless_gaussians_is_not_emptied(state):
    gaussians = dataclasses.replace(state.params.gaussians, opacity_logits=jnp.full(64, -20.0))
    keep, clone, split = choose(gaussians, state.density, CONFIG)
    assert (keep | split).sum() == 5 and not keep[DEAD] and not (clone & split).any()


def test_the_removed_never_return_and_padding_stays_empty(state, rng):
    calm = dataclasses.replace(CONFIG, gradient_threshold=1e9)
    once, report = control(state, calm)
    assert (report.pruned, report.alive) == (1, 4)
    twice, report = control(once, calm)
    assert (report.pruned, report.alive) == (0, 4)
    for name, values in rows(twice.params.gaussians).items():
        np.testing.assert_array_equal(values, rows(once.params.gaussians)[name])


def test_equal_seeds_give_equal_controls(state):
    (a, _), (b, _), (c, _) = control(state, seed=3), control(state, seed=3), control(state, seed=4)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)
    assert (a.params.gaussians.means != c.params.gaussians.means).any()


def test_a_reset_lowers_the_high_and_forgets_their_moments_only(state):
    ceiling = np.log(0.01 / 0.99)
    new = reset_attenuation(state, CONFIG)
    old = np.asarray(state.params.gaussians.opacity_logits)
    np.testing.assert_allclose(new.params.gaussians.opacity_logits, np.minimum(old, ceiling), rtol=1e-6)
    assert float(new.params.gaussians.opacity_logits[USELESS]) == -9
    before, after = per_gaussian(state), per_gaussian(new)
    for path, moments in after.items():
        if "opacity_logits" in path.split(".gaussians.")[1]:
            assert not moments.any(), path
        else:
            np.testing.assert_array_equal(moments, before[path], err_msg=path)


def test_capacity_buckets_hold_what_they_must_and_are_few():
    buckets = [capacity_bucket(n) for n in range(1, 5000)]
    assert all(n <= bucket for n, bucket in enumerate(buckets, 1))
    assert all(bucket <= 1.3 * n + 16 for n, bucket in enumerate(buckets[63:], 64))
    assert buckets == sorted(buckets) and len(set(buckets)) < 30
    assert all(bucket % 16 == 0 for bucket in buckets)


def test_training_goes_on_after_a_control_and_leaves_padding_alone(state):
    data = training_data(tiny_dataset())
    epoch = make_epoch(wideband, OPTIMIZER, Capacity(16384, 2048), SETTINGS.optim)
    edited, _ = control(state)
    # The epoch takes its argument's memory.
    before = jax.tree.map(np.array, edited.params.gaussians)
    batches = jnp.asarray(np.arange(8).reshape(4, 2), jnp.int32)
    after, report = epoch(edited, data, batches, jnp.asarray(0, jnp.int32))
    assert int(report.good_steps) == 4
    changed = {name: rows(after.params.gaussians)[name] != values for name, values in rows(before).items()}
    assert all(mask[:6].any() and not mask[6:].any() for mask in changed.values())
    np.testing.assert_array_equal(after.params.gaussians.alive, before.alive)
    assert float(after.density.visible[:6].max()) > 0 and not after.density.visible[6:].any()
