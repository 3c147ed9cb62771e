"""The paper's field: what its inputs are, what its gradients are, and that it is a pure function of pytrees."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import tiny_settings

from wbgs_jax.data.surface import surface_from_points
from wbgs_jax.fields import wideband
from wbgs_jax.fields.wideband import INITIAL_ATTENUATION
from wbgs_jax.splat import Capacity
from wbgs_jax.types import Query, make_query, make_receiver

N, B = 30, 3
CONFIG = tiny_settings().wideband
RECEIVER = make_receiver((0.2, -0.1, 1.0), (0.9, 0.1, -0.2, 0.3))
render = jax.jit(wideband.render)
init = jax.jit(wideband.init, static_argnums=(2, 3))
plan_within = jax.jit(wideband.plan, static_argnums=2)
ROOM = Capacity(entries=16384, jobs=2048)


@pytest.fixture
def points(rng):
    return rng.uniform([-2, -2, 0.5], [2, 2, 4], (N, 3))


@pytest.fixture
def query(rng):
    return make_query(rng.uniform([-2, -2, 1], [2, 2, 2], (B, 3)), rng.uniform(1e9, 9e10, B))


def start(points, config=CONFIG, capacity=None):
    surface = jax.tree.map(jnp.asarray, surface_from_points(points))
    return init(jax.random.key(0), surface, config, capacity)


def plan_of(params):
    plan = plan_within(params, RECEIVER, ROOM)
    assert not plan.geometry.jobs.overflow
    return plan


def trained(rng, params, spread=0.3):
    """Networks and opacities as after some training: nothing is zero by its initialiser."""

    def stir(a):
        return a + jnp.asarray(spread * rng.normal(size=a.shape), a.dtype)

    gaussians = dataclasses.replace(params.gaussians, opacity_logits=stir(params.gaussians.opacity_logits))
    return dataclasses.replace(params, gaussians=gaussians, networks=jax.tree.map(stir, params.networks))


def double(tree):
    return jax.tree.map(lambda a: a.astype(jnp.float64), tree)


def test_starts_with_gaussians_on_the_surface_of_even_attenuation(points, query):
    params = start(points, capacity=48)
    surface = surface_from_points(points)
    gaussians = params.gaussians
    assert gaussians.alive.tolist() == [1] * N + [0] * (48 - N)
    np.testing.assert_allclose(gaussians.means[:N], points, rtol=1e-6)
    np.testing.assert_allclose(jnp.exp(gaussians.log_scales[:N]), np.tile(surface.spacing[:, None], 3), rtol=1e-5)
    attenuation, signal = wideband.em_features(params, RECEIVER, query)
    assert attenuation.shape == signal.shape == (48, B)
    np.testing.assert_allclose(attenuation, INITIAL_ATTENUATION, rtol=1e-5)
    assert bool((signal > 0).all())


def test_capacity_must_hold_the_points(points):
    with pytest.raises(ValueError, match="capacity 20"):
        start(points, capacity=20)


@pytest.mark.parametrize(("attenuation", "radiance"), [(True, True), (True, False), (False, True), (False, False)])
def test_frequency_switches_remove_the_dependence(rng, points, query, attenuation, radiance):
    config = dataclasses.replace(CONFIG, attenuation_frequency=attenuation, radiance_frequency=radiance)
    params = trained(rng, start(points, config))

    def features(log_frequency):
        return wideband.em_features(params, RECEIVER, Query(query.tx_position, jnp.exp(log_frequency)))

    log_frequency = jnp.log(query.frequency_hz)
    _, (d_attenuation, d_signal) = jax.jvp(features, (log_frequency,), (jnp.ones(B),))
    assert bool((d_attenuation != 0).any()) == attenuation
    assert bool((d_signal != 0).any()) == (attenuation or radiance)  # h carries the attenuation network's frequency onwards


@pytest.mark.parametrize("relative", [True, False])
def test_the_papers_inputs_alone_do_not_know_the_receiver(rng, points, query, relative):
    params = trained(rng, start(points, dataclasses.replace(CONFIG, relative=relative)))
    elsewhere = make_receiver((1.0, 0.5, 1.5))
    here, there = (wideband.em_features(params, receiver, query)[1] for receiver in (RECEIVER, elsewhere))
    assert bool((here != there).any()) == relative


def test_each_query_has_its_own_answer(rng, points, query):
    """No leak between queries of a batch: each feature depends on its own transmitter and frequency."""
    params = trained(rng, start(points))
    moved = Query(query.tx_position.at[1].add(0.5), query.frequency_hz.at[2].multiply(3))
    before, after = (wideband.em_features(params, RECEIVER, q) for q in (query, moved))
    for a, b in zip(before, after, strict=True):
        changed = (a != b).any(0)
        assert changed.tolist() == [False, True, True]


def test_gradients_are_finite_and_agree_with_finite_differences(rng, x64, points, query):
    receiver, query = double(RECEIVER), double(query)
    params = double(trained(rng, start(points, capacity=32)))
    cotangent = jnp.asarray(rng.normal(size=(B, 90, 360)))

    @jax.jit
    def objective(params, tx_position, log_frequency):
        plan = wideband.plan(params, receiver, ROOM)
        return jnp.sum(wideband.render(params, plan, Query(tx_position, jnp.exp(log_frequency))) * cotangent)

    arguments = (params, query.tx_position, jnp.log(query.frequency_hz))
    gradients = jax.jit(jax.grad(objective, argnums=(0, 1, 2)))(*arguments)
    leaves, structure = jax.tree.flatten(arguments)
    centre, step, checked = objective(*arguments), 1e-8, 0
    assert bool(jnp.isfinite(centre))  # NaN: the tile lists overflowed
    for i, (path, gradient) in enumerate(jax.tree_util.tree_leaves_with_path(gradients)):
        name = jax.tree_util.keystr(path)
        assert bool(jnp.isfinite(gradient).all()), name
        if "alive" in name or "frame" in name:
            assert not gradient.any(), name
            continue
        direction = jnp.asarray(rng.normal(size=gradient.shape))

        def at(t, i=i, direction=direction):
            return objective(*jax.tree.unflatten(structure, [a + t * direction if j == i else a for j, a in enumerate(leaves)]))

        # A kink (the edge of a footprint, a ReLU) within the step spoils the difference on one side of the centre only.
        exact, *sides = (
            float(d) for d in (jnp.sum(gradient * direction), (at(step) - centre) / step, (centre - at(-step)) / step)
        )
        assert any(exact == pytest.approx(side, rel=1e-4, abs=1e-4) for side in sides), (name, exact, sides)
        assert bool(gradient.any()), name
        checked += 1
    assert checked >= 10


def test_a_batch_equals_a_vmap_of_single_queries(rng, points, query):
    params = trained(rng, start(points))
    plan = plan_of(params)
    batch = render(params, plan, query)
    assert batch.shape == (B, 90, 360) and float(batch.max()) > 0.05
    assert batch.std(axis=0).max() > 1e-3  # the queries do differ
    one_by_one = jax.vmap(lambda tx, f: wideband.render(params, plan, Query(tx[None], f[None]))[0])
    np.testing.assert_allclose(jax.jit(one_by_one)(query.tx_position, query.frequency_hz), batch, atol=1e-5)


def test_a_plan_serves_many_queries_whatever_its_capacity(rng, points, query):
    params = trained(rng, start(points))
    plan = wideband.plan(params, RECEIVER)  # sizes itself
    anew = plan_of(params)
    assert anew.geometry.jobs.tile.shape != plan.geometry.jobs.tile.shape
    np.testing.assert_allclose(render(params, anew, query), render(params, plan, query), atol=1e-5)
    other = Query(query.tx_position[::-1], query.frequency_hz[::-1])
    np.testing.assert_allclose(render(params, plan, other), render(params, plan, query)[::-1], atol=1e-5)


def test_the_order_of_the_gaussians_and_padding_change_nothing(rng, points, query):
    params = trained(rng, start(points))
    order = rng.permutation(N)
    shuffled = dataclasses.replace(params, gaussians=jax.tree.map(lambda a: a[order], params.gaussians))
    padded = dataclasses.replace(
        params, gaussians=jax.tree.map(lambda a: jnp.pad(a, [(0, 9)] + [(0, 0)] * (a.ndim - 1)), params.gaussians)
    )
    expected = render(params, plan_of(params), query)
    for other in (shuffled, padded):
        np.testing.assert_allclose(render(other, plan_of(other), query), expected, atol=2e-5)


def test_the_configuration_is_static(points):
    params = start(points)
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(params)]
    assert not any("config" in path for path in paths)
    other = start(points, dataclasses.replace(CONFIG, projection="sphere"))
    assert jax.tree.structure(params) != jax.tree.structure(other)
    assert jax.tree.structure(params) == jax.tree.structure(start(points))
    assert jax.tree.map(lambda a: a, params).config == CONFIG


def test_one_key_one_start(points):
    a, b = start(points), start(points)
    assert all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    surface = jax.tree.map(jnp.asarray, surface_from_points(points))
    c = init(jax.random.key(1), surface, CONFIG, None)
    assert not np.array_equal(jax.tree.leaves(a.networks)[-1], jax.tree.leaves(c.networks)[-1])


def test_coinciding_positions_have_finite_gradients(rng, points):
    """Padding lies at the origin; a receiver or a transmitter may lie there, or on a Gaussian, as well."""
    receiver = make_receiver((0, 0, 0))
    points[0] = [1.0, 1.0, 1.0]
    params = trained(rng, start(points, capacity=40))
    query = make_query([[0, 0, 0], [1.0, 1.0, 1.0], [0.5, 0.5, 1.0]], 1e10)

    def total(params, query):
        return sum(jnp.sum(feature) for feature in wideband.em_features(params, receiver, query))

    for gradient in jax.tree.leaves(jax.jit(jax.grad(total, argnums=(0, 1)))(params, query)):
        assert bool(jnp.isfinite(gradient).all())
