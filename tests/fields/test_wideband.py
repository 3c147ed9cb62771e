"""The paper's field: what its inputs are, what its gradients are, and that it is a pure function of pytrees."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import FIELDS
from scipy.interpolate import RegularGridInterpolator

from wbgs_jax.data.scene import surface_from_points
from wbgs_jax.fields import wideband
from wbgs_jax.fields.em_features import DARK, MAX_ATTENUATION, given_features
from wbgs_jax.fields.wideband import INITIAL_ATTENUATION, WidebandField, make_field
from wbgs_jax.splat.tiles import TileLimits, slots_for
from wbgs_jax.types import Query, make_query, make_receiver

N, B = 30, 3
SLOTS = slots_for(N)
CONFIG = FIELDS["wideband"]
RECEIVER = make_receiver((0.2, -0.1, 1.0), (0.9, 0.1, -0.2, 0.3))
ROOM = TileLimits(entries=16384, jobs=2048)
render = jax.jit(wideband.render)
plan_within = jax.jit(WidebandField.plan, static_argnames="capacity")


@jax.jit
def features(field, params, receiver, query):
    """delta and Sig, of a plan that is made for it."""
    return wideband.em_features(params, WidebandField.plan(field, params, receiver, capacity=ROOM), query)


@pytest.fixture
def points(rng):
    return rng.uniform([-2, -2, 0.5], [2, 2, 4], (N, 3))


@pytest.fixture
def query(rng):
    return make_query(rng.uniform([-2, -2, 1], [2, 2, 2], (B, 3)), rng.uniform(1e9, 9e10, B))


def start(points, config=CONFIG):
    return make_field(jax.tree.map(jnp.asarray, surface_from_points(points)), config)


def plan_of(field, params, receiver=RECEIVER):
    plan = plan_within(field, params, receiver, capacity=ROOM)
    assert not plan.geometry.jobs.overflow
    return plan


def trained(rng, field, spread=0.3):
    """Networks and opacities as after some training: nothing is zero by its initialiser."""

    def stir(a):
        return a + jnp.asarray(spread * rng.normal(size=a.shape), a.dtype)

    params = field.init(jax.random.key(0))
    gaussians = dataclasses.replace(params.gaussians, opacity_logits=stir(params.gaussians.opacity_logits))
    return dataclasses.replace(params, gaussians=gaussians, networks=jax.tree.map(stir, params.networks))


def test_starts_with_gaussians_on_the_surface_of_even_attenuation(points, query):
    field = start(points)
    params, surface = field.init(jax.random.key(0)), surface_from_points(points)
    gaussians = params.gaussians
    assert gaussians.alive.tolist() == [True] * N + [False] * (SLOTS - N)
    np.testing.assert_allclose(gaussians.means[:N], points, rtol=1e-6)
    np.testing.assert_allclose(jnp.exp(gaussians.log_scales[:N]), np.tile(surface.spacing[:, None], 3), rtol=1e-5)
    attenuation, signal = features(field, params, RECEIVER, query)
    assert attenuation.shape == signal.shape == (SLOTS, B)
    np.testing.assert_allclose(attenuation[:N], INITIAL_ATTENUATION, rtol=1e-5)
    np.testing.assert_array_equal(attenuation[N:], 0)  # empty slots take nothing away
    assert bool((signal > 0).all())
    assert field.inspect(params).sizes == {"gaussians": N}


def test_only_what_is_trained_is_a_parameter(points):
    """All leaves are floats, and each belongs to a group of the optimiser."""
    field = start(points)
    params = field.init(jax.random.key(0))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(params))
    groups, labels = field.param_groups(CONFIG, params)
    assert jax.tree.structure(labels) == jax.tree.structure(params)
    assert set(jax.tree.leaves(labels)) == set(groups)


@pytest.mark.parametrize(("attenuation", "radiance"), [(True, True), (True, False), (False, True), (False, False)])
def test_frequency_switches_remove_the_dependence(rng, points, query, attenuation, radiance):
    field = start(points, dataclasses.replace(CONFIG, attenuation_frequency=attenuation, radiance_frequency=radiance))
    params = trained(rng, field)
    # Planned by a field of other settings: features need no geometry, and those of the Gaussians are made anew.
    aware = start(points)
    plan = dataclasses.replace(plan_of(aware, aware.init(jax.random.key(0))), features=None, config=field.config)

    @jax.jit
    def slopes(log_frequency):
        def at(log_frequency):
            return wideband.em_features(params, plan, Query(query.tx_position, jnp.exp(log_frequency)))

        return jax.jvp(at, (log_frequency,), (jnp.ones(B),))[1]

    d_attenuation, d_signal = slopes(jnp.log(query.frequency_hz))
    assert bool((d_attenuation != 0).any()) == attenuation
    assert bool((d_signal != 0).any()) == (attenuation or radiance)  # h holds the attenuation network's frequency, too


@pytest.mark.parametrize("degree", [1, 3])
def test_heads_make_polynomials_of_the_scaled_frequency(rng, points, query, degree):
    """Without the frequency among the inputs, delta's and Sig's logits are exactly of that degree, and no lower one."""
    changes = {"attenuation_frequency": False, "radiance_frequency": False, "frequency_heads": degree}
    field = start(points, dataclasses.replace(CONFIG, **changes))
    params = trained(rng, field)
    ghz = np.geomspace(1, 100, 9)
    asked = Query(jnp.repeat(query.tx_position[:1], len(ghz), 0), jnp.asarray(1e9 * ghz, jnp.float32))
    delta, signal = (np.asarray(values, float)[:N] for values in features(field, params, RECEIVER, asked))
    scaled = np.log10(ghz) - 1
    for logits in (-np.log(MAX_ATTENUATION / delta - 1), np.log(np.expm1(signal))):
        size = np.abs(logits).max()
        residual = [np.abs(logits.T - polynomial(scaled, logits.T, d)).max() / size for d in (degree, degree - 1)]
        assert residual[0] < 1e-3 and residual[1] > 10 * residual[0]


def polynomial(x, y, degree):
    """The least-squares polynomials through the columns of y, at x."""
    powers = np.vander(x, degree + 1)
    return powers @ np.linalg.lstsq(powers, y, rcond=None)[0]


@pytest.mark.parametrize("relative", [True, False])
def test_the_papers_inputs_alone_do_not_know_the_receiver(rng, points, query, relative):
    field = start(points, dataclasses.replace(CONFIG, relative=relative))
    params = trained(rng, field)
    elsewhere = make_receiver((1.0, 0.5, 1.5))
    here, there = (features(field, params, receiver, query)[1] for receiver in (RECEIVER, elsewhere))
    assert bool((here != there).any()) == relative


def test_each_query_has_its_own_answer(rng, points, query):
    """No leak between queries of a batch: each feature depends on its own transmitter and frequency."""
    field = start(points)
    params = trained(rng, field)
    moved = Query(query.tx_position.at[1].add(0.5), query.frequency_hz.at[2].multiply(3))
    before, after = (features(field, params, RECEIVER, q) for q in (query, moved))
    for a, b in zip(before, after, strict=True):
        changed = (a != b)[:N].any(0)
        assert changed.tolist() == [False, True, True]


def test_a_batch_equals_a_vmap_of_single_queries(rng, points, query):
    field = start(points)
    params = trained(rng, field)
    plan = plan_of(field, params)
    batch = render(params, plan, query)
    assert batch.shape == (B, 90, 360) and float(batch.max()) > 0.01
    assert batch.std(axis=0).max() > 1e-3  # the queries do differ
    one_by_one = jax.vmap(lambda tx, f: wideband.render(params, plan, Query(tx[None], f[None]))[0])
    np.testing.assert_allclose(jax.jit(one_by_one)(query.tx_position, query.frequency_hz), batch, atol=1e-5)


def test_a_plan_serves_many_queries_whatever_its_limits(rng, points, query):
    field = start(points)
    params = trained(rng, field)
    plan = field.plan(params, RECEIVER)  # sizes itself
    anew = plan_of(field, params)
    assert anew.geometry.jobs.tile.shape != plan.geometry.jobs.tile.shape
    np.testing.assert_allclose(render(params, anew, query), render(params, plan, query), atol=1e-5)
    other = Query(query.tx_position[::-1], query.frequency_hz[::-1])
    np.testing.assert_allclose(render(params, plan, other), render(params, plan, query)[::-1], atol=1e-5)


def test_a_plan_for_a_file_renders_the_same(rng, points, query):
    """It lacks what the networks make of the Gaussians, which is computed again."""
    field = start(points)
    params = trained(rng, field)
    plan = plan_of(field, params)
    portable = plan.portable()
    assert portable.features is None and plan.features is not None
    np.testing.assert_allclose(render(params, portable, query), render(params, plan, query), atol=1e-6)


def test_limits_hold_all_receivers_and_grow(rng, points):
    field = start(points)
    params = trained(rng, field)
    receivers = [RECEIVER, make_receiver((1.0, 0.5, 1.5))]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *receivers)
    capacity = field.capacity(params, together)
    for receiver in receivers:
        assert not plan_within(field, params, receiver, capacity=capacity).geometry.jobs.overflow
    grown = capacity.grown_to(field.capacity(params, together, np.array([capacity.entries + 1, 3])))
    assert grown.entries > capacity.entries and grown.jobs == capacity.jobs


def test_the_order_of_the_gaussians_changes_nothing(rng, points, query):
    field = start(points)
    params = trained(rng, field)
    order = rng.permutation(SLOTS)  # empty slots among the others
    shuffled = dataclasses.replace(params, gaussians=jax.tree.map(lambda a: a[order], params.gaussians))
    expected = render(params, plan_of(field, params), query)
    np.testing.assert_allclose(render(shuffled, plan_of(field, shuffled), query), expected, atol=2e-5)


def test_what_an_empty_slot_holds_changes_nothing(rng, points, query):
    field = start(points)
    params = trained(rng, field)
    junk = jax.tree.map(lambda a: a.at[N:].set(7.0), params.gaussians)
    junk = dataclasses.replace(junk, opacity_logits=params.gaussians.opacity_logits)
    other = dataclasses.replace(params, gaussians=junk)
    expected = render(params, plan_of(field, params), query)
    np.testing.assert_array_equal(render(other, plan_of(field, other), query), expected)


def test_the_configuration_is_static(points):
    field = start(points)
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(field)]
    assert paths and not any("config" in path for path in paths)
    other = start(points, dataclasses.replace(CONFIG, projection="sphere"))
    assert jax.tree.structure(field) != jax.tree.structure(other)
    assert jax.tree.structure(field) == jax.tree.structure(start(points))
    assert jax.tree.map(lambda a: a, field).config == CONFIG


def test_one_key_one_start(points):
    field = start(points)
    a, b, c = (field.init(jax.random.key(seed)) for seed in (0, 0, 1))
    assert all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    assert not np.array_equal(jax.tree.leaves(a.networks)[-1], jax.tree.leaves(c.networks)[-1])


def test_coinciding_positions_have_finite_gradients(rng, points):
    """Empty slots lie at the origin; a receiver or a transmitter may lie there, or on a Gaussian, as well."""
    points[0] = [1.0, 1.0, 1.0]
    field = start(points)
    params, receiver = trained(rng, field), make_receiver((0, 0, 0))
    query = make_query([[0, 0, 0], [1.0, 1.0, 1.0], [0.5, 0.5, 1.0]], 1e10)

    @jax.jit
    def gradients(params, query):
        def total(params, query):
            return sum(jnp.sum(feature) for feature in features(field, params, receiver, query))

        return jax.grad(total, argnums=(0, 1))(params, query)

    for gradient in jax.tree.leaves(gradients(params, query)):
        assert bool(jnp.isfinite(gradient).all())


def test_networks_see_given_spectra_between_pixels_and_across_the_seam(rng):
    """Against a library's linear interpolation."""
    given = rng.uniform(size=(2, 90, 360))
    pixel = np.stack([rng.uniform(-0.5, 359.5, 50), rng.uniform(0, 100, 50)], -1)
    pixel[:2, 0] = -0.4, 359.3
    around = np.concatenate([given[..., -1:], given, given[..., :1]], -1)
    expected = [
        RegularGridInterpolator((np.arange(90), np.arange(-1, 361)), one)(np.minimum(pixel[:, ::-1], (89, 400)))
        for one in around
    ]
    seen = given_features(jnp.asarray(given), jnp.asarray(pixel))
    np.testing.assert_allclose(seen[..., 0].T, expected, atol=1e-4)
    np.testing.assert_allclose(seen[..., 1].T, np.log(np.array(expected) + DARK), atol=2e-3)
    np.testing.assert_array_equal(seen[..., 2], 1)
    dark = given_features(jnp.asarray(given * [[[0]], [[1]]]), jnp.asarray(pixel))
    np.testing.assert_array_equal(dark[:, 0], 0)  # says nothing
    np.testing.assert_array_equal(dark[:, 1], seen[:, 1])
