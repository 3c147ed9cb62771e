"""Positional and frequency encodings of the EM feature networks (paper, section 4.2)."""

import math
from typing import Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.types import MAX_FREQUENCY_HZ, MIN_FREQUENCY_HZ

FrequencyScale = Literal["log", "ghz"]
"""The logarithm maps the band of the paper to -1..1 and extrapolates smoothly beyond."""


def positional_encoding(x: Float[Array, "*n d"], octaves: int) -> Float[Array, "*n d_out"]:
    """Returns (x, sin(2^k x), cos(2^k x), k = 0..octaves-1), input included: d_out = d (1 + 2 octaves)  (NeRF, equation 4)."""
    scaled = x[..., None, :] * (2.0 ** jnp.arange(octaves, dtype=x.dtype))[:, None]
    waves = jnp.concatenate([jnp.sin(scaled), jnp.cos(scaled)], -2)
    return jnp.concatenate([x, waves.reshape((*x.shape[:-1], -1))], -1)


def scale_frequency(frequency_hz: Float[Array, "*n"], scale: FrequencyScale = "log") -> Float[Array, "*n"]:
    """Returns a frequency as a network input: "log" maps 1..100 GHz to -1..1 by its logarithm, "ghz" gives raw gigahertz."""
    if scale == "ghz":
        return frequency_hz / 1e9
    middle = 0.5 * (math.log(MIN_FREQUENCY_HZ) + math.log(MAX_FREQUENCY_HZ))
    half = 0.5 * (math.log(MAX_FREQUENCY_HZ) - math.log(MIN_FREQUENCY_HZ))
    return (jnp.log(frequency_hz) - middle) / half


def frequency_encoding(frequency_hz: Float[Array, "*n"], octaves: int, scale: FrequencyScale = "log") -> Float[Array, "*n d"]:
    """Returns the positional encoding of the scaled frequency: d = 1 + 2 octaves."""
    return positional_encoding(scale_frequency(frequency_hz, scale)[..., None], octaves)


def legendre(x: Float[Array, "*n"], degree: int) -> Float[Array, "*n d"]:
    """Returns the Legendre polynomials P_1 ... P_degree of numbers in -1..1: d = degree."""
    values = [jnp.ones_like(x), x]
    for k in range(1, degree):
        values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
    return jnp.stack(values[1 : degree + 1], -1)


def check_octaves(name: str, config: Any, inputs: tuple[str, ...]) -> None:
    """Raises a `UserError` for settings with an encoding of fewer than no octaves; `name` is that of the field."""
    for part in inputs:
        if getattr(config, f"{part}_octaves") < 0:
            raise UserError(f"--{name}.{part}-octaves is negative; give 0 or more")
