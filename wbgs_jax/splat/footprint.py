"""The footprint of a splat: a Gaussian that goes continuously to zero at `SUPPORT` standard deviations.

With q the Mahalanobis distance squared, G(q) = max(0, exp(-q/2) - e0) / (1 - e0), e0 = exp(-SUPPORT^2 / 2). A plain Gaussian
cut off by tile lists or by a threshold would make image and gradients depend on the tiling or jump; this one does neither.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from wbgs_jax.radio.geometry import AZIMUTH_PERIOD
from wbgs_jax.splat.project import SUPPORT

CUT = SUPPORT**2
"""Mahalanobis distance squared at which a footprint ends."""
EDGE = math.exp(-CUT / 2)
"""What a plain Gaussian has there ..."""
GAIN = 1 / (1 - EDGE)
"""... and what makes up for it at the centre."""


def mahalanobis2(dx: Float[Array, "*#n"], dy: Float[Array, "*#n"], conic: Float[Array, "*#n 3"]) -> Float[Array, "*n"]:
    """Returns q of offsets (pixels) from the centre."""
    return conic[..., 0] * dx * dx + conic[..., 2] * dy * dy + 2 * conic[..., 1] * dx * dy


def footprint(q: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns G(q) in 0..1."""
    return jnp.maximum(jnp.exp(-0.5 * q) - EDGE, 0) * GAIN


def windowed_exponential(q: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns -2 dG/dq: the exponential on the support, zero outside."""
    return jnp.where(q < CUT, jnp.exp(-0.5 * q) * GAIN, 0)


def wrap_azimuth(dx: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns the nearest alias of a column offset (pixels)."""
    return dx - AZIMUTH_PERIOD * jnp.round(dx / AZIMUTH_PERIOD)
