"""Diffraction against special functions and the exact solution of the half plane."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import fresnel, wofz

from wbgs_jax.propagation.utd import faddeeva, transition, wedge_coefficients


def test_the_faddeeva_function_equals_scipys(rng):
    z = rng.uniform(-20, 20, 500) + 1j * rng.uniform(0, 20, 500)
    np.testing.assert_allclose(faddeeva(jnp.asarray(z, jnp.complex64)), wofz(z), atol=1e-5)


def test_the_transition_function_equals_its_integral(rng):
    """F(x) = 2 j sqrt(x) exp(j x) int_sqrt(x)^inf exp(-j t^2) dt."""
    x = rng.uniform(0.01, 30, 100)
    s, c = fresnel(np.sqrt(2 * x / np.pi))
    tail = np.sqrt(np.pi / 2) * ((0.5 - c) - 1j * (0.5 - s))
    root = np.sqrt(x)
    np.testing.assert_allclose(
        root * np.asarray(transition(jnp.asarray(root, jnp.float32))), 2j * root * np.exp(1j * x) * tail, atol=2e-5
    )


def half_plane(phi_in, phi_out, rho, wavenumber, soft):
    """Sommerfeld's exact total field of a plane wave at a perfectly conducting half plane."""

    def u(angle):
        root = np.sqrt(2 * wavenumber * rho) * np.cos(angle / 2)
        s, c = fresnel(np.sqrt(2 / np.pi) * root)
        below = np.sqrt(np.pi / 2) * ((0.5 + c) - 1j * (0.5 + s))  # int_-inf^root exp(-j t^2) dt
        return np.exp(1j * wavenumber * rho * np.cos(angle)) * np.exp(1j * np.pi / 4) / np.sqrt(np.pi) * below

    return u(phi_out - phi_in) + (-1 if soft else 1) * u(phi_out + phi_in)


def test_a_half_plane_equals_sommerfelds_solution(rng):
    """Geometrical optics plus diffraction, in shadow and light and at their borders."""
    wavenumber, rho, n = 2 * np.pi, 30.0, 2.0
    for soft in (True, False):
        sign = -1 if soft else 1
        phi_in = rng.uniform(0.3, np.pi - 0.3, 200)
        phi_out = rng.uniform(0.1, 2 * np.pi - 0.1, 200)
        # Not nearer than float32 can tell on which side.
        aside = rng.choice([-1, 1], 100) * rng.uniform(1e-5, 0.05, 100)
        phi_out[:50] = phi_in[:50] + np.pi + aside[:50]  # about the shadow's border
        phi_out[50:100] = np.pi - phi_in[50:100] + aside[50:]  # about the reflection's
        arguments = [
            jnp.asarray(np.broadcast_to(a, 200), jnp.float32) for a in (phi_in, phi_out, n, 1.0, wavenumber * rho, wavenumber)
        ]
        incident, d_n, d_0 = (np.asarray(d) for d in wedge_coefficients(*arguments))
        diffracted = incident + sign * (d_n + d_0)
        field = diffracted * np.exp(-1j * wavenumber * rho) / np.sqrt(rho)
        field = field + np.where(phi_out - phi_in < np.pi, np.exp(1j * wavenumber * rho * np.cos(phi_out - phi_in)), 0)
        field = field + sign * np.where(phi_out + phi_in < np.pi, np.exp(1j * wavenumber * rho * np.cos(phi_out + phi_in)), 0)
        np.testing.assert_allclose(field, half_plane(phi_in, phi_out, rho, wavenumber, soft), atol=5e-3)


@pytest.mark.heavy
def test_gradients_are_finite_at_a_border():
    def total(phi_out):
        ones = jnp.ones(())
        parts = wedge_coefficients(jnp.array(0.5), phi_out, 1.5 * ones, ones, 100 * ones, 50 * ones)
        return sum(part.real + part.imag for part in parts)

    for phi_out in (0.5 + np.pi, np.pi - 0.5, 1.0, 4.0):
        assert np.isfinite(jax.grad(total)(jnp.asarray(phi_out, jnp.float32)))


def test_on_a_border_half_of_the_wave_is_diffracted():
    """Half of the incident wave on the border of the shadow, and half of the reflected one on the border of the reflection."""
    wavenumber, rho = 2 * np.pi, 30.0
    for border, part in ((np.pi + 0.5, 0), (np.pi - 0.5, 2)):
        arguments = (0.5, border, 2.0, 1.0, wavenumber * rho, wavenumber)
        found = wedge_coefficients(*(jnp.asarray(a, jnp.float32) for a in arguments))[part]
        np.testing.assert_allclose(abs(found) / np.sqrt(rho), 0.5, atol=0.03)  # the first sums the terms of two borders
