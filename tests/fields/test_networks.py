"""The EM feature networks against the plain layers they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.fields.networks import (
    AttenuationNetwork,
    PartwiseDense,
    RadianceNetwork,
    attenuation_activation,
    signal_activation,
)

N, B = 5, 4


@pytest.fixture
def parts(rng):
    """One part of the Gaussian, one of the query, one of both."""
    return [jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((N, 1, 3), (1, B, 2), (N, B, 6))]


def concatenated(parts):
    return np.concatenate([np.broadcast_to(part, (N, B, part.shape[-1])) for part in parts], -1)


def stacked_kernel(layer):
    return np.concatenate([layer[f"kernel_{i}"] for i in range(len(layer) - 1)])


def randomised(rng, params):
    """Every parameter drawn anew: nothing is zero by its initialiser."""
    return jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape), a.dtype), params)


def test_partwise_dense_is_a_dense_layer_on_the_concatenation(rng, parts):
    layer = PartwiseDense(7)
    params = randomised(rng, layer.init(jax.random.key(0), parts))
    expected = concatenated(parts) @ stacked_kernel(params["params"]) + params["params"]["bias"]
    np.testing.assert_allclose(layer.apply(params, parts), expected, rtol=1e-4, atol=1e-4)


def test_partwise_dense_starts_like_one_layer_of_the_whole_fan_in():
    parts = [jnp.zeros((1, 1, n)) for n in (30, 90)]
    params = PartwiseDense(400).init(jax.random.key(1), parts)["params"]
    for kernel in (params["kernel_0"], params["kernel_1"]):
        assert float(kernel.std()) == pytest.approx((2 / 120) ** 0.5, rel=0.03)


@pytest.mark.parametrize(("skip", "fusion"), [(1, 0), (2, 0), (9, 0), (1, 1), (1, 2), (2, 1), (9, 2)])
def test_attenuation_network_layer_by_layer(rng, parts, skip, fusion):
    network = AttenuationNetwork(width=8, depth=3, skip=skip, fusion=fusion)
    params = randomised(rng, network.init(jax.random.key(0), parts[:1], parts[1:]))
    layers = params["params"]
    own, query = concatenated(parts[:1]), concatenated(parts[1:])
    hidden = np.zeros((N, B, 0))
    for i in range(3):
        entering = [hidden, *[own] * (i in (0, skip)), *[query] * (i == fusion or (i == skip and i > fusion))]
        layer, entering = layers[f"PartwiseDense_{i}"], np.concatenate(entering, -1)
        assert stacked_kernel(layer).shape == (entering.shape[-1], 8)
        hidden = np.maximum(entering @ stacked_kernel(layer) + layer["bias"], 0)
    got_hidden, got_delta = network.apply(params, parts[:1], parts[1:])
    np.testing.assert_allclose(got_hidden, hidden, rtol=1e-3, atol=1e-3)
    expected = (hidden @ layers["Dense_0"]["kernel"] + layers["Dense_0"]["bias"])[..., 0]
    np.testing.assert_allclose(got_delta, expected, rtol=1e-3, atol=1e-3)


def test_layers_before_the_fusion_are_evaluated_once_a_gaussian(parts):
    def operations(fusion):
        network = AttenuationNetwork(width=64, depth=4, skip=9, fusion=fusion)
        params = network.init(jax.random.key(0), parts[:1], parts[1:])
        cost = jax.jit(network.apply).lower(params, parts[:1], parts[1:]).compile().cost_analysis()
        return cost["flops"]

    assert operations(3) < 0.6 * operations(0)


def test_delta_f_is_zero_at_the_start_but_can_learn(parts):
    network = AttenuationNetwork(width=8, depth=3, skip=1)
    params = network.init(jax.random.key(0), parts[:1], parts[1:])
    hidden, delta_f = network.apply(params, parts[:1], parts[1:])
    assert delta_f.shape == (N, B)
    assert not delta_f.any() and hidden.any()
    gradient = jax.grad(lambda p: network.apply(p, parts[:1], parts[1:])[1].sum())(params)["params"]["Dense_0"]["kernel"]
    assert gradient.any()


def test_radiance_network_layer_by_layer(rng, parts):
    network = RadianceNetwork((8, 6))
    params = randomised(rng, network.init(jax.random.key(0), parts))
    layers = params["params"]
    hidden = concatenated(parts)
    for name in ("PartwiseDense_0", "PartwiseDense_1"):
        hidden = np.maximum(hidden @ stacked_kernel(layers[name]) + layers[name]["bias"], 0)
    expected = (hidden @ layers["Dense_0"]["kernel"] + layers["Dense_0"]["bias"])[..., 0]
    np.testing.assert_allclose(network.apply(params, parts), expected, rtol=1e-3, atol=1e-3)


def test_activations_keep_their_bounds_for_any_logit():
    logits = jnp.array([[-1e4, -50.0, 0.0, 50.0, 1e4]])
    signal = signal_activation(logits)
    assert bool(jnp.isfinite(signal).all()) and bool((signal >= 0).all()) and float(signal[0, 2]) > 0.1
    delta = attenuation_activation(jnp.array([0.0]), logits, 0.99)
    assert bool((delta >= 0).all()) and bool((delta <= 0.99).all())
    assert float(attenuation_activation(jnp.array([-1.5]), jnp.array([[0.7]]), 0.99)[0, 0]) == pytest.approx(
        0.99 / (1 + np.exp(0.8))
    )
