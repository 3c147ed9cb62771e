"""Complex functions in real arithmetic against NumPy's in double precision, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax._util.complex_math import phasor, quotient, root


def complex_normal(rng, n):
    return (rng.normal(size=n) + 1j * rng.normal(size=n)).astype(np.complex64)


def test_phasors_go_round(rng):
    turns = np.concatenate([rng.uniform(-3, 3, 2000), rng.uniform(-1e4, 1e4, 2000), np.arange(-8, 9) / 8]).astype(np.float32)
    np.testing.assert_allclose(phasor(jnp.asarray(turns)), np.exp(2j * np.pi * turns.astype(float)), atol=4e-7)


def test_phasors_in_double_precision(rng):
    with jax.enable_x64(True):
        turns = rng.uniform(-3, 3, 100)
        np.testing.assert_allclose(phasor(jnp.asarray(turns)), np.exp(2j * np.pi * turns), atol=1e-14)


def test_phasors_change_across_themselves(rng):
    turns, step = (jnp.asarray(rng.normal(size=50), jnp.float32) for _ in range(2))
    _, change = jax.jvp(phasor, (turns,), (step,))
    np.testing.assert_allclose(change, 2j * np.pi * np.asarray(step) * np.asarray(phasor(turns)), rtol=1e-5, atol=1e-5)
    weight = jnp.asarray(rng.normal(size=(2, 50)), jnp.float32)
    gradient = jax.grad(lambda t: jnp.sum(weight[0] * phasor(t).real + weight[1] * phasor(t).imag))(turns)
    angle = 2 * np.pi * np.asarray(turns, float)
    expected = 2 * np.pi * (np.asarray(weight[1]) * np.cos(angle) - np.asarray(weight[0]) * np.sin(angle))
    np.testing.assert_allclose(gradient, expected, atol=1e-4)


def test_quotients(rng):
    a, b = complex_normal(rng, 500), complex_normal(rng, 500)
    np.testing.assert_allclose(quotient(jnp.asarray(a), jnp.asarray(b)), a.astype(complex) / b, rtol=1e-6)


def test_roots_right_of_the_imaginary_axis(rng):
    z = (rng.uniform(1e-3, 10, 500) - 1j * 10 ** rng.uniform(-6, 7, 500)).astype(np.complex64)
    np.testing.assert_allclose(root(jnp.asarray(z)), np.sqrt(z.astype(complex)), rtol=1e-6)


@pytest.mark.parametrize("function", [quotient, lambda a, b: root(a * a.conj() + 1j * b.real) * b])
def test_gradients_are_those_of_the_library(rng, function):
    """The same expressions by XLA's own functions."""
    a, b = (jnp.asarray(complex_normal(rng, 20)) for _ in range(2))
    library = (lambda a, b: a / b) if function is quotient else (lambda a, b: jnp.sqrt(a * a.conj() + 1j * b.real) * b)

    def loss(of):
        return lambda a, b: jnp.sum(jnp.sin(of(a, b).real) + of(a, b).imag ** 2)

    found, expected = (jax.grad(loss(of), (0, 1))(a, b) for of in (function, library))
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-3, atol=1e-3 * float(jnp.abs(other).max()))
