"""Positional and frequency encodings of the EM feature networks (paper, section 4.2)."""

import math
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

MIN_FREQUENCY_HZ, MAX_FREQUENCY_HZ = 1e9, 100e9
"""The band of the paper; the log scale maps it to -1..1 and extrapolates smoothly beyond."""

FrequencyScale = Literal["log", "ghz"]


def positional_encoding(x: Float[Array, "*n d"], octaves: int) -> Float[Array, "*n d_out"]:
    """(x, sin(2^k x), cos(2^k x), k = 0..octaves-1), the input included: d_out = d (1 + 2 octaves)  (NeRF, equation 4)."""
    scaled = x[..., None, :] * (2.0 ** jnp.arange(octaves, dtype=x.dtype))[:, None]
    waves = jnp.concatenate([jnp.sin(scaled), jnp.cos(scaled)], -2)
    return jnp.concatenate([x, waves.reshape((*x.shape[:-1], -1))], -1)


def scale_frequency(frequency_hz: Float[Array, "*n"], scale: FrequencyScale = "log") -> Float[Array, "*n"]:
    """A frequency as a network input: "log" maps 1..100 GHz to -1..1 on a logarithmic scale, "ghz" is the raw number of GHz."""
    if scale == "ghz":
        return frequency_hz / 1e9
    middle = 0.5 * (math.log(MIN_FREQUENCY_HZ) + math.log(MAX_FREQUENCY_HZ))
    half = 0.5 * (math.log(MAX_FREQUENCY_HZ) - math.log(MIN_FREQUENCY_HZ))
    return (jnp.log(frequency_hz) - middle) / half


def frequency_encoding(frequency_hz: Float[Array, "*n"], octaves: int, scale: FrequencyScale = "log") -> Float[Array, "*n d"]:
    """Positional encoding of the scaled frequency: d = 1 + 2 octaves."""
    return positional_encoding(scale_frequency(frequency_hz, scale)[..., None], octaves)
