"""Encodings against their formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.fields import networks

positional_encoding = jax.jit(networks.positional_encoding, static_argnums=1)
scale_frequency = jax.jit(networks.scale_frequency, static_argnums=1)
frequency_encoding = jax.jit(networks.frequency_encoding, static_argnums=(1, 2))


def test_positional_encoding_equals_its_formula(rng, x64):
    x, octaves = rng.normal(size=(4, 5, 3)), 6
    waves = [f(2.0**k * x) for f in (np.sin, np.cos) for k in range(octaves)]
    encoded = positional_encoding(jnp.asarray(x), octaves)
    assert encoded.shape == (4, 5, 3 * (1 + 2 * octaves))
    np.testing.assert_allclose(encoded, np.concatenate([x, *waves], -1), rtol=1e-12, atol=1e-12)


def test_no_octaves_leave_the_input(rng):
    x = jnp.asarray(rng.normal(size=(4, 3)), jnp.float32)
    np.testing.assert_array_equal(positional_encoding(x, 0), x)


def test_the_log_scale_maps_the_band_to_minus_one_and_one():
    scaled = scale_frequency(jnp.array([1e9, 10e9, 100e9]))
    np.testing.assert_allclose(scaled, [-1, 0, 1], atol=1e-6)
    beyond = scale_frequency(jnp.array([0.1e9, 1000e9]))  # a decade is one unit, also outside the band
    np.testing.assert_allclose(beyond, [-2, 2], atol=1e-6)


def test_the_ghz_scale_is_the_number_of_gigahertz():
    np.testing.assert_allclose(scale_frequency(jnp.array([1e9, 2.4e9, 94e9]), "ghz"), [1, 2.4, 94], rtol=1e-6)


@pytest.mark.parametrize("scale", ["log", "ghz"])
def test_frequency_encoding_is_the_positional_one_of_the_scaled_frequency(scale):
    frequency = jnp.array([1e9, 5e9, 60e9])
    encoded = frequency_encoding(frequency, 4, scale)
    np.testing.assert_array_equal(encoded, positional_encoding(scale_frequency(frequency, scale)[:, None], 4))
    assert encoded.shape == (3, 9)


def test_neighbouring_bands_stay_apart_in_single_precision():
    """1 Hz in 100 GHz is beyond float32, 1 MHz is not."""
    frequency = jnp.array([94e9, 94.001e9], jnp.float32)
    assert len(np.unique(frequency_encoding(frequency, 4), axis=0)) == 2


def test_the_gradient_is_finite_over_six_decades():
    frequency = jnp.asarray(np.logspace(6, 12, 50), jnp.float32)
    gradient = np.asarray(jax.jit(jax.grad(lambda f: jnp.sum(networks.frequency_encoding(f, 4))))(frequency))
    assert np.isfinite(gradient).all() and (gradient != 0).all()


@pytest.mark.parametrize("degree", [1, 2, 5])
def test_legendre_polynomials_are_numpys(rng, x64, degree):
    x = rng.uniform(-1, 1, (3, 4))
    found = networks.legendre(jnp.asarray(x), degree)
    assert found.shape == (3, 4, degree)
    np.testing.assert_allclose(found, np.polynomial.legendre.legvander(x, degree)[..., 1:], rtol=1e-12, atol=1e-14)
