"""The EM feature networks against the plain layers they stand for."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.fields.networks import (
    AttenuationNetwork,
    PartwiseDense,
    RadianceNetwork,
    attenuation_activation,
    product,
    signal_activation,
)

N, B, WIDTH, DEPTH = 5, 4, 8, 3
FORMS = [(skip, fusion) for fusion in (0, 1, 2) for skip in (1, 2, 9)] + [(0, 0)]
"""Inputs enter again before, at and after the layer of the fusion, or never."""


@pytest.fixture
def parts(rng):
    """One part of the Gaussian, one of the query, one of both."""
    return [jnp.asarray(rng.normal(size=shape)) for shape in ((N, 1, 3), (1, B, 2), (N, B, 6))]


def concatenated(parts):
    return np.concatenate([np.broadcast_to(part, (N, B, part.shape[-1])) for part in parts], -1)


def stacked_kernel(layer):
    return np.concatenate([layer[f"kernel_{i}"] for i in range(len(layer) - 1)])


def randomised(rng, module, *inputs):
    """Parameters of which nothing is zero by its initialiser, and nothing is compiled to have them."""
    shapes = jax.eval_shape(module.init, jax.random.key(0), *inputs)
    return jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), shapes)


def in_one_step(network, params, gaussian, query):
    return network.apply(params, gaussian, query)


def in_two_steps(network, params, gaussian, query):
    sums = network.apply(params, gaussian, method="gaussian_sums")
    return network.apply(params, sums, query, len(gaussian), method="of_queries")


@partial(jax.jit, static_argnums=0)
def both_ways(network, params, gaussian, query, weights):
    """Outputs, and gradients of their weighted sum with respect to weights and inputs."""

    def evaluate(way):
        def total(params, gaussian, query):
            outputs = way(network, params, gaussian, query)
            return sum(jnp.sum(w * output) for w, output in zip(weights, outputs, strict=True)), outputs

        return jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True)(params, gaussian, query)

    return evaluate(in_one_step), evaluate(in_two_steps)


def test_partwise_dense_is_a_dense_layer_on_the_concatenation(rng, x64, parts):
    layer = PartwiseDense(7)
    params = randomised(rng, layer, parts)
    expected = concatenated(parts) @ stacked_kernel(params["params"]) + params["params"]["bias"]
    np.testing.assert_allclose(jax.jit(layer.apply)(params, parts), expected, rtol=1e-10)


def test_partwise_dense_can_be_summed_in_several_calls(rng, x64, parts):
    layer = PartwiseDense(7)
    params = randomised(rng, layer, parts)

    @jax.jit
    def in_calls(params, parts):
        total = layer.apply(params, parts[:1])
        return layer.apply(params, parts[1:], 1, total)

    np.testing.assert_allclose(in_calls(params, parts), jax.jit(layer.apply)(params, parts), rtol=1e-10)


def test_partwise_dense_starts_like_one_layer_of_the_whole_fan_in():
    parts = [jnp.zeros((1, 1, n)) for n in (30, 90)]
    params = jax.jit(PartwiseDense(400).init)(jax.random.key(1), parts)["params"]
    for kernel in (params["kernel_0"], params["kernel_1"]):
        assert np.asarray(kernel).std() == pytest.approx((2 / 120) ** 0.5, rel=0.03)


@pytest.mark.parametrize(("skip", "fusion"), FORMS)
def test_attenuation_network_layer_by_layer_and_in_two_steps(rng, x64, parts, skip, fusion):
    """Against plain layers; what is evaluated once a Gaussian and then once a query is the same function with the same
    gradients."""
    network = AttenuationNetwork(width=WIDTH, depth=DEPTH, skip=skip, fusion=fusion)
    params = randomised(rng, network, parts[:1], parts[1:])
    layers = params["params"]
    own, query = concatenated(parts[:1]), concatenated(parts[1:])
    hidden = np.zeros((N, B, 0))
    for i in range(DEPTH):
        entering = [hidden, *[own] * (i in (0, skip)), *[query] * (i == fusion or (i == skip and i > fusion))]
        layer, entering = layers[f"PartwiseDense_{i}"], np.concatenate(entering, -1)
        assert stacked_kernel(layer).shape == (entering.shape[-1], WIDTH)
        hidden = np.maximum(entering @ stacked_kernel(layer) + layer["bias"], 0)
    expected = (hidden @ layers["Dense_0"]["kernel"] + layers["Dense_0"]["bias"])[..., 0]
    weights = [rng.normal(size=(N, B, WIDTH)), rng.normal(size=(N, B))]
    one_step, two_steps = both_ways(network, params, parts[:1], parts[1:], weights)
    for (_, found), _ in (one_step, two_steps):
        np.testing.assert_allclose(found[0], hidden, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found[1], expected, rtol=1e-9, atol=1e-9)
    for (path, got), want in zip(jax.tree_util.tree_leaves_with_path(two_steps), jax.tree.leaves(one_step), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9, err_msg=jax.tree_util.keystr(path))
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(one_step))


@pytest.mark.parametrize(("skip", "fusion"), [(1, 0), (2, 1), (1, 1)])
def test_two_steps_take_several_inputs_of_the_gaussian(rng, x64, parts, skip, fusion):
    gaussian = [parts[0], jnp.asarray(rng.normal(size=(N, 1, 2)))]
    network = AttenuationNetwork(width=WIDTH, depth=DEPTH, skip=skip, fusion=fusion)
    params = randomised(rng, network, gaussian, parts[1:])
    ways = jax.jit(lambda *arguments: [way(network, *arguments) for way in (in_one_step, in_two_steps)])
    for got, want in zip(*ways(params, gaussian, parts[1:]), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9)


def test_layers_before_the_fusion_are_evaluated_once_a_gaussian(parts):
    def operations(fusion):
        network = AttenuationNetwork(width=64, depth=4, skip=9, fusion=fusion)
        params = jax.eval_shape(network.init, jax.random.key(0), parts[:1], parts[1:])
        cost = jax.jit(network.apply).lower(params, parts[:1], parts[1:]).compile().cost_analysis()
        return cost["flops"]

    assert operations(3) < 0.6 * operations(0)


def test_delta_f_is_zero_at_the_start_but_can_learn(parts):
    network = AttenuationNetwork(width=WIDTH, depth=DEPTH, skip=1)

    @jax.jit
    def start(key, parts):
        params = network.init(key, parts[:1], parts[1:])
        gradient = jax.grad(lambda p: network.apply(p, parts[:1], parts[1:])[1].sum())(params)
        return network.apply(params, parts[:1], parts[1:]), gradient["params"]["Dense_0"]["kernel"]

    (hidden, delta_f), gradient = start(jax.random.key(0), [part.astype(jnp.float32) for part in parts])
    assert delta_f.shape == (N, B)
    assert not np.asarray(delta_f).any() and np.asarray(hidden).any() and np.asarray(gradient).any()


def test_radiance_network_layer_by_layer(rng, x64, parts):
    network = RadianceNetwork((8, 6))
    params = randomised(rng, network, parts)
    layers = params["params"]
    hidden = concatenated(parts)
    for name in ("PartwiseDense_0", "PartwiseDense_1"):
        hidden = np.maximum(hidden @ stacked_kernel(layers[name]) + layers[name]["bias"], 0)
    expected = (hidden @ layers["Dense_0"]["kernel"] + layers["Dense_0"]["bias"])[..., 0]
    np.testing.assert_allclose(jax.jit(network.apply)(params, parts), expected, rtol=1e-9, atol=1e-9)


def test_activations_keep_their_bounds_for_any_logit():
    logits = jnp.array([[-1e4, -50.0, 0.0, 50.0, 1e4]])
    signal = np.asarray(jax.jit(signal_activation)(logits))
    assert np.isfinite(signal).all() and (signal >= 0).all() and signal[0, 2] > 0.1
    activation = jax.jit(attenuation_activation, static_argnums=2)
    delta = np.asarray(activation(jnp.array([0.0]), logits, 0.99))
    assert (delta >= 0).all() and (delta <= 0.99).all()
    assert not np.asarray(activation(jnp.array([-jnp.inf]), logits, 0.99)).any()  # an empty slot attenuates nothing
    squashed = activation(jnp.array([-1.5]), jnp.array([[0.7, 0, 0, 0, 0]]), 0.99)[0, 0]
    assert float(squashed) == pytest.approx(0.99 / (1 + np.exp(0.8)))


@pytest.mark.parametrize(("precision", "bits"), [("float32", 23), ("tf32", 10), ("bfloat16", 7)])
def test_layers_multiply_what_their_precision_leaves(precision, bits, rng):
    """On any device, forwards and backwards: numbers are rounded, sums are not."""
    a, b = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((40, 30), (30, 20)))
    cotangent = jnp.asarray(rng.normal(size=(40, 20)), jnp.float32)

    def rounded(array):
        step = 2.0 ** (np.floor(np.log2(np.abs(np.float64(array)))) - bits)
        return np.round(np.float64(array) / step) * step

    multiply = partial(product, dimension_numbers=(((1,), (0,)), ((), ())), precision=precision)
    found, back = jax.vjp(multiply, a, b)
    np.testing.assert_allclose(found, rounded(a) @ rounded(b), atol=3e-6)
    d_a, d_b = back(cotangent)
    away = 2.0 ** -(bits + 1) * 30  # gradients may be rounded once more on their way out
    np.testing.assert_allclose(d_a, rounded(cotangent) @ rounded(b).T, atol=max(away, 1e-5))
    np.testing.assert_allclose(d_b, rounded(a).T @ rounded(cotangent), atol=max(away, 1e-5))
    assert found.dtype == jnp.float32
