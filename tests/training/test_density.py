"""Density control on hand-made Gaussians: who is cloned, split, removed, and what travels along."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_dataset
from builders.toys import GROWING, RippleConfig, RippleField
from scipy.spatial.transform import Rotation

from wbgs_jax.config import DensityConfig
from wbgs_jax.fields.wideband import WidebandField, WidebandParams
from wbgs_jax.training.density import DensityControl, DensityStatistics, choose, control_density, reset_attenuation
from wbgs_jax.training.hooks import Context, Edit, map_moments
from wbgs_jax.training.loop import Run
from wbgs_jax.training.step import TrainState, make_optimizer
from wbgs_jax.types import Gaussians

STEP, SLOTS = 7, 64
NAMES = ("means", "log_scales", "quats", "opacity_logits", "features")
CONFIG = DensityConfig(every=STEP, start=1, gradient_threshold=1.0, split_scale=0.5, prune_attenuation=0.005, max_gaussians=100)
OPTIMIZER = make_optimizer(WidebandField, GROWING.field, GROWING.optim)
CALM, CLONED, SPLIT, USELESS, UNSEEN, DEAD = range(6)  # the Gaussians of `state`


def make_state(rng, means, log_scales, quats, logits, gradient, visible) -> TrainState:
    """Gaussians of the given shapes in 64 slots, with moments that are different everywhere."""

    def padded(values, fill=0.0):
        values = np.asarray(values, np.float32)
        pad = [(0, SLOTS - len(values))] + [(0, 0)] * (values.ndim - 1)
        return jnp.asarray(np.pad(values, pad, constant_values=fill))

    features = padded(rng.normal(size=(len(means), GROWING.field.features)))
    gaussians = Gaussians(padded(means), padded(log_scales), padded(quats), padded(logits, -np.inf), features)
    networks = {"attenuation": {"kernel": jnp.asarray(rng.normal(size=(3, 2)), jnp.float32)}, "radiance": jnp.ones(4)}
    params = WidebandParams(gaussians, networks)
    statistics = DensityStatistics(padded(gradient), padded(rng.normal(size=(len(means), 3))), padded(visible))
    moments = jax.tree.map(
        lambda a: jnp.asarray(rng.uniform(1, 2, a.shape), a.dtype) if a.ndim else a + 7, OPTIMIZER.init(params)
    )
    return TrainState(params, moments, (statistics,), jnp.asarray(STEP, jnp.int32))


@pytest.fixture
def state(rng):
    log_scales = np.log(np.full((6, 3), 0.2)) + 0.1 * rng.normal(size=(6, 3))
    log_scales[SPLIT, 1] = np.log(0.9)  # one long axis is enough
    logits = np.array([0.0, 0.5, -1.0, -9.0, 0.2, -np.inf])
    # Sums over the visible steps: 0.9, 3, 4, 9 and 50 a step; the unseen one has no gradient.
    gradient, visible = np.array([9.0, 6, 8, 18, 0, 50]), np.array([10.0, 2, 2, 2, 0, 1])
    means = rng.normal(size=(6, 3)) * 0.5 + [0, 0, 2.5]  # above the receiver's horizon, where training sees them
    return make_state(rng, means, log_scales, rng.normal(size=(6, 4)), logits, gradient, visible)


class Done(NamedTuple):
    """What a control left."""

    state: TrainState
    report: dict[str, int]


def edited(state, config, seed=0) -> Edit:
    """It looks at nothing but the Gaussians."""
    context: Any = Context(None, None, np.zeros(0, int))
    field, rng = RippleField(RippleConfig()), np.random.default_rng(seed)
    return DensityControl(config).apply(field, state.params, state.statistics[0], context, STEP, rng)


def control(state, config=CONFIG, seed=0) -> Done:
    """As the loop does it."""
    edit = edited(state, config, seed)
    new = TrainState(edit.params, map_moments(state.optimizer, state.params, edit.moments), (edit.statistics,), state.step)
    return Done(new, edit.report["density"])


def rows(gaussians):
    return {name: np.asarray(getattr(gaussians, name)) for name in NAMES}


def per_gaussian(state):
    """Moments and statistics with a row for every Gaussian, by their place in the tree."""
    leaves = jax.tree_util.tree_leaves_with_path(state.optimizer)
    return {
        jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves if ".gaussians." in jax.tree_util.keystr(path)
    }


def test_who_stays_and_who_comes(state):
    new, report = control(state)
    assert report == {"cloned": 1, "split": 1, "pruned": 1, "alive": 6}
    old, got = rows(state.params.gaussians), rows(new.params.gaussians)
    alive = np.asarray(new.params.gaussians.alive)
    assert alive.tolist() == [True] * 6 + [False] * (len(alive) - 6)
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
    gradient = np.asarray(state.statistics[0].mean_gradient[CLONED])
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
        assert report["split"] == n and report["alive"] == 2 * n
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
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(new.statistics))
    np.testing.assert_array_equal(jax.tree.leaves(new.params.networks)[0], jax.tree.leaves(state.params.networks)[0])


def test_the_neediest_come_first_where_room_is_short(state):
    one_more = dataclasses.replace(CONFIG, max_gaussians=5)  # four are useful
    new, report = control(state, one_more)
    assert (report["cloned"], report["split"], report["alive"]) == (0, 1, 5)
    full = dataclasses.replace(CONFIG, max_gaussians=4)
    assert control(state, full).report == {"cloned": 0, "split": 0, "pruned": 1, "alive": 4}
    below = dataclasses.replace(CONFIG, max_gaussians=2)  # never a reason to remove useful ones
    assert control(state, below).report["alive"] == 4
    assert new.params.gaussians.alive.sum() == 5


def test_a_field_of_useless_gaussians_is_not_emptied(state):
    logits = state.params.gaussians.opacity_logits
    gaussians = dataclasses.replace(state.params.gaussians, opacity_logits=jnp.where(jnp.isinf(logits), logits, -20.0))
    keep, clone, split = choose(gaussians, state.statistics[0], CONFIG)
    assert (keep | split).sum() == 5 and not keep[DEAD] and not (clone & split).any()


def test_the_removed_never_return_and_padding_stays_empty(state, rng):
    calm = dataclasses.replace(CONFIG, gradient_threshold=1e9)
    once, report = control(state, calm)
    assert (report["pruned"], report["alive"]) == (1, 4)
    twice, report = control(once, calm)
    assert (report["pruned"], report["alive"]) == (0, 4)
    for name, values in rows(twice.params.gaussians).items():
        np.testing.assert_array_equal(values, rows(once.params.gaussians)[name])


def test_equal_seeds_give_equal_controls(state):
    (a, _), (b, _), (c, _) = control(state, seed=3), control(state, seed=3), control(state, seed=4)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)
    assert (a.params.gaussians.means != c.params.gaussians.means).any()


def test_a_reset_lowers_the_high_and_forgets_their_moments_only(state):
    ceiling = np.log(0.01 / 0.99)
    edit = reset_attenuation(Edit(state.params, state.statistics[0], lambda tree: tree, {}), CONFIG)
    old = np.asarray(state.params.gaussians.opacity_logits)
    np.testing.assert_allclose(edit.params.gaussians.opacity_logits, np.minimum(old, ceiling), rtol=1e-6)
    assert float(edit.params.gaussians.opacity_logits[USELESS]) == -9
    before, after = (
        per_gaussian(state),
        per_gaussian(dataclasses.replace(state, optimizer=map_moments(state.optimizer, state.params, edit.moments))),
    )
    assert before.keys() == after.keys()
    for path, moments in after.items():
        if "opacity_logits" in path.split(".gaussians.")[1]:
            assert not moments.any(), path
        else:
            np.testing.assert_array_equal(moments, before[path], err_msg=path)


def test_a_reset_after_a_control_does_both(state):
    """Where both are due: moments are gathered first, then those of delta_o forgotten, and the statistics start anew."""
    both = dataclasses.replace(CONFIG, reset_every=STEP)
    (alone, _), (new, report) = control(state), control(state, both)
    assert report == {"cloned": 1, "split": 1, "pruned": 1, "alive": 6}
    logits = np.asarray(alone.params.gaussians.opacity_logits)
    np.testing.assert_allclose(new.params.gaussians.opacity_logits, np.minimum(logits, np.log(0.01 / 0.99)), rtol=1e-6)
    np.testing.assert_array_equal(new.params.gaussians.means, alone.params.gaussians.means)
    gathered = per_gaussian(alone)
    for path, moments in per_gaussian(new).items():
        forgotten = "opacity_logits" in path.split(".gaussians.")[1]
        np.testing.assert_array_equal(moments, 0 if forgotten else gathered[path], err_msg=path)
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(new.statistics))


def test_a_reset_alone_leaves_the_statistics(state):
    """They go on being summed for the next control."""
    reset_only = dataclasses.replace(CONFIG, every=2, reset_every=STEP)
    edit = edited(state, reset_only)
    assert edit.report == {} and edit.statistics is state.statistics[0]
    assert float(edit.params.gaussians.opacity_logits[CALM]) == pytest.approx(np.log(0.01 / 0.99), rel=1e-5)


def test_the_schedule():
    every = DensityControl(dataclasses.replace(CONFIG, every=3, start=6, stop_fraction=0.5))
    assert [step for step in range(31) if every.due(step, 30)] == [6, 9, 12, 15]
    resets = DensityControl(dataclasses.replace(CONFIG, every=6, start=1, stop_fraction=1.0, reset_every=4))
    assert [step for step in range(25) if resets.due(step, 24)] == [4, 6, 8, 12, 16, 18, 20, 24]
    off = DensityControl(dataclasses.replace(CONFIG, every=0, reset_every=4))
    assert not any(off.due(step, 24) for step in range(25))
    from_the_start = DensityControl(dataclasses.replace(CONFIG, every=2, start=0, stop_fraction=1.0))
    assert not from_the_start.due(0, 24)


def test_what_was_removed_is_reported_by_the_pure_part_too(state):
    edit = control_density(state.params, state.statistics[0], CONFIG, np.random.default_rng(0))
    assert edit.report == {"density": control(state).report}
    np.testing.assert_array_equal(edit.params.gaussians.means, control(state).state.params.gaussians.means)


@pytest.mark.heavy
def test_training_goes_on_after_a_control_and_leaves_padding_alone(state, tmp_path):
    run = Run(tiny_dataset(), "wideband", GROWING, 0, tmp_path)
    gaussians = control(state).state.params.gaussians
    params = dataclasses.replace(run.state.params, gaussians=gaussians)
    run.state = dataclasses.replace(run.state, params=params)
    before = jax.tree.map(np.array, gaussians)  # the epoch takes its argument's memory
    figures = [run.epoch(), run.epoch()]
    assert run.step == 4 and np.isfinite([f["loss"] for f in figures]).all() and run.compilations == 1
    after = run.state.params.gaussians
    changed = {name: rows(after)[name] != values for name, values in rows(before).items()}
    assert all(mask[:6].any() and not mask[6:].any() for mask in changed.values())
    np.testing.assert_array_equal(after.alive, np.arange(SLOTS) < 6)
    (seen,) = run.state.statistics
    assert float(seen.visible[:6].max()) > 0 and not seen.visible[6:].any()
