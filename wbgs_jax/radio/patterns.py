"""Element patterns of antennas, and vertical polarisation.

The gain of an element is a power of that of 3GPP TR 38.901, so that one number, the pattern exponent of a receiver, tells
patterns apart: 0 is isotropic, 1 the 8 dBi element of table 7.3-1.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

PATTERN_EXPONENTS = {"tr38901": 1.0, "iso": 0.0, "": 0.0}
"""Pattern exponent by the name of a pattern; the empty name stands for one that is not known."""


def pattern_exponent(pattern: str) -> float:
    """Returns the exponent of a named pattern; a pattern without an entry counts as isotropic."""
    return PATTERN_EXPONENTS.get(pattern, 0.0)


def element_gain(direction: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    """Returns the amplitude gain of the element of 3GPP TR 38.901 (table 7.3-1) in unit directions: boresight +x, 8 dBi."""
    x, y, z = jnp.moveaxis(direction, -1, 0)
    zenith = jnp.degrees(jnp.arccos(jnp.clip(z, -1, 1)))
    azimuth = jnp.degrees(jnp.arctan2(y, x))
    vertical = jnp.minimum(12 * ((zenith - 90) / 65) ** 2, 30.0)
    horizontal = jnp.minimum(12 * (azimuth / 65) ** 2, 30.0)
    return 10 ** ((8 - jnp.minimum(vertical + horizontal, 30.0)) / 20)


def zenith_vector(direction: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Returns the unit vector theta-hat of a unit direction: the electric field of a vertically polarised antenna."""
    x, y, z = jnp.moveaxis(direction, -1, 0)
    horizontal = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-12))
    return jnp.stack([z * x / horizontal, z * y / horizontal, -horizontal], -1)
