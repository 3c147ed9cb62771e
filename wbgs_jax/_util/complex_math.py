"""Complex functions in real arithmetic, restricted to the arguments that occur here.

XLA's own functions cover all arguments, are not vectorised on a CPU, and are recomputed for every result that depends on them:
four times as slow for the coefficients of a slab.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

_SINE = tuple((-1) ** (power // 2) * (2 * math.pi) ** power / math.factorial(power) for power in range(1, 13, 2))
"""Taylor series of sin(2 pi y) in y, y^3, ..., y^11: enough for single precision up to a quarter of a turn."""


@jax.custom_jvp
def phasor(turns: Float[Array, "*n"]) -> Complex[Array, "*n"]:
    """Returns exp(2 pi j turns); `turns` is the phase in cycles."""
    if turns.dtype != jnp.float32:
        return jnp.exp(2j * jnp.pi * turns)
    turns = turns - jnp.round(turns)
    folded = jnp.where(jnp.abs(turns) > 0.25, jnp.copysign(0.5, turns) - turns, turns)
    return jax.lax.complex(_sine(0.25 - jnp.abs(turns)), _sine(folded))


@phasor.defjvp
def _phasor_jvp(primals, tangents):
    value = phasor(*primals)
    rate = 2 * jnp.pi * tangents[0]
    return value, jax.lax.complex(-value.imag * rate, value.real * rate)


def _sine(quarter: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns sin(2 pi y) for y from -1/4 to 1/4."""
    square, total = quarter * quarter, jnp.full_like(quarter, _SINE[-1])
    for coefficient in _SINE[-2::-1]:
        total = total * square + coefficient
    return quarter * total


def quotient(a: Complex[Array, "*#n"], b: Complex[Array, "*#n"]) -> Complex[Array, "*#n"]:
    """Returns a / b, for |b|^2 within the range of single precision."""
    size = 1 / (b.real * b.real + b.imag * b.imag)
    return a * jax.lax.complex(b.real * size, -b.imag * size)


def root(z: Complex[Array, "*n"]) -> Complex[Array, "*n"]:
    """Returns the square root of numbers with a non-negative real part and |z|^2 within the range of single precision. Value
    and gradient are finite at 0."""
    smallest = 1e-12  # magnitude below which complex numbers count as 0
    size = jnp.sqrt(jnp.maximum(z.real * z.real + z.imag * z.imag, smallest**2))
    real = jnp.sqrt(0.5 * (size + jnp.maximum(z.real, 0)))
    return jax.lax.complex(real, 0.5 * z.imag / real)
