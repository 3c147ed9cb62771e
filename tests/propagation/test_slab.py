"""Slabs against the textbook."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.propagation.materials import DAMPING, complex_permittivity, slab_coefficients
from wbgs_jax.radio.array import SPEED_OF_LIGHT

FREQUENCY = 10e9


def fresnel(cosine, permittivity):
    """Half space: (TE, TM)."""
    inner = np.sqrt(permittivity - (1 - cosine**2) + 0j)
    return (cosine - inner) / (cosine + inner), (permittivity * cosine - inner) / (permittivity * cosine + inner)


def test_conductivity_is_the_imaginary_part_of_itu(rng):
    """ITU-R P.2040-3, equation 29: 17.98 sigma / f, with the frequency in GHz."""
    ghz, real, conductivity = rng.uniform(1, 100, 20), rng.uniform(1, 8, 20), rng.uniform(1e-3, 5, 20)
    found = complex_permittivity(jnp.asarray(real), jnp.asarray(conductivity), jnp.asarray(1e9 * ghz))
    np.testing.assert_allclose(found, real - 17.98j * conductivity / ghz, rtol=1e-3)


def test_a_thick_lossy_slab_is_a_half_space(rng):
    cosine, permittivity = rng.uniform(0.05, 1, 20), rng.uniform(2, 8, 20) - 1j * rng.uniform(0.5, 5, 20)
    found = slab_coefficients(jnp.asarray(cosine), jnp.asarray(permittivity), jnp.full(20, 3.0), jnp.full(20, FREQUENCY))
    te, tm = fresnel(cosine, permittivity)
    np.testing.assert_allclose(found.reflect_te, te, atol=1e-5)
    np.testing.assert_allclose(found.reflect_tm, tm, atol=1e-5)
    assert np.abs(found.transmit_te).max() < 1e-6


def test_without_loss_the_power_is_kept(rng):
    cosine, thickness = rng.uniform(0.1, 1, 50), rng.uniform(0.001, 0.3, 50)
    permittivity = jnp.asarray(rng.uniform(1.2, 8, 50), jnp.complex64)
    found = slab_coefficients(
        jnp.asarray(cosine), permittivity, jnp.asarray(thickness), jnp.asarray(rng.uniform(1e9, 1e11, 50))
    )
    loss = 200 * (1 - DAMPING)  # of a slab that rings
    for reflected, transmitted in ((found.reflect_te, found.transmit_te), (found.reflect_tm, found.transmit_tm)):
        np.testing.assert_allclose(np.abs(reflected) ** 2 + np.abs(transmitted) ** 2, 1, atol=loss)


def test_half_a_wavelength_is_invisible_and_a_quarter_reflects_most():
    permittivity = 4.0
    wavelength = SPEED_OF_LIGHT / FREQUENCY / np.sqrt(permittivity)
    thickness = jnp.array([wavelength / 2, wavelength / 4])
    found = slab_coefficients(jnp.ones(2), jnp.full(2, permittivity + 0j), thickness, jnp.full(2, FREQUENCY))
    np.testing.assert_allclose(np.abs(found.reflect_te), [0, (permittivity - 1) / (permittivity + 1)], atol=1e-3)


def test_nothing_and_metal():
    air = slab_coefficients(jnp.array(0.7), jnp.array(4.0 + 0j), jnp.array(0.0), jnp.array(FREQUENCY))
    np.testing.assert_allclose(air.transmit_te, 1, atol=1e-3)
    metal = complex_permittivity(jnp.array(1.0), jnp.array(1e7), jnp.array(FREQUENCY))
    mirror = slab_coefficients(jnp.array(0.7), metal, jnp.array(0.002), jnp.array(FREQUENCY))
    np.testing.assert_allclose([mirror.reflect_te, mirror.reflect_tm, mirror.transmit_te], [-1, 1, 0], atol=2e-3)


def test_in_nature_a_slab_of_air_is_nothing_and_tracers_count_it_twice(rng):
    cosine, thickness, frequency = rng.uniform(0.1, 1, 20), rng.uniform(0.001, 0.3, 20), rng.uniform(1e9, 1e10, 20)
    given = [jnp.asarray(x, jnp.float32) for x in (cosine, np.ones(20), thickness, frequency)]
    given[1] = given[1].astype(jnp.complex64)
    nature, tracer = (slab_coefficients(*given, air) for air in (1.0, 0.0))
    for name in ("transmit_te", "transmit_tm"):
        np.testing.assert_allclose(getattr(nature, name), 1, atol=2e-3)
        extra = np.exp(-2j * np.pi * frequency / SPEED_OF_LIGHT * thickness * cosine)
        np.testing.assert_allclose(getattr(tracer, name), extra, atol=2e-3)
    np.testing.assert_array_equal(nature.reflect_te, tracer.reflect_te)


@pytest.mark.parametrize("cosine", [1e-4, 0.02, 0.5, 1.0])
def test_gradients_are_finite_over_the_band(cosine):
    def total(log_susceptibility, log_conductivity, log_thickness, frequency):
        permittivity = complex_permittivity(1 + jnp.exp(log_susceptibility), jnp.exp(log_conductivity), frequency)
        return sum(
            jnp.sum(c.real + c.imag)
            for c in slab_coefficients(jnp.array(cosine), permittivity, jnp.exp(log_thickness), frequency)
        )

    gradient = jax.jit(jax.vmap(jax.grad(total, argnums=(0, 1, 2)), (0, 0, 0, 0)))
    grid = np.meshgrid([-3.0, 0.0, 3.0], [-12.0, 0.0, 11.5], [-7.0, -2.0, 0.0], np.geomspace(1e9, 1e11, 5))
    for found in gradient(*(jnp.asarray(g.ravel(), jnp.float32) for g in grid)):
        assert np.isfinite(found).all()


def test_air_at_grazing_incidence_is_finite():
    for cosine in (0.0, 1e-4, 1e-2):
        found = slab_coefficients(jnp.asarray(cosine), jnp.asarray(1 + 0j), jnp.asarray(0.1), jnp.asarray(FREQUENCY))
        assert np.isfinite(np.array(found)).all()
