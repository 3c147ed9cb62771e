"""Antennas: polarisation and directional gain.

An antenna is vertically polarised in its own frame, along theta-hat. Its gain is a product of two patterns, each raised to an
exponent: the element of 3GPP TR 38.901, with boresight +x, and the short dipole along z. The two exponents represent the usual
patterns, and values between these can be learned.
"""

import re

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree
from wbgs_jax.radio.array import EXACT
from wbgs_jax.radio.geometry import rotation_matrix, to_local

PATTERN_EXPONENTS = {
    "": (0.0, 0.0),  # unknown
    "iso": (0.0, 0.0),
    "tr38901": (1.0, 0.0),
    "dipole": (0.0, 1.0),
    "hw_dipole": (0.0, 1.2),  # within 0.41 dB wherever the half-wave dipole is above -10 dB
}
"""Exponents of the directional element and of the dipole, by pattern name."""
SPELLINGS = {"isotropic": "iso", "tr38901": "tr38901", "38901": "tr38901", "3gpp38901": "tr38901"}
SPELLINGS |= {
    "3gpptr38901": "tr38901",
    "shortdipole": "dipole",
    "halfwavedipole": "hw_dipole",
    "halfwavelengthdipole": "hw_dipole",
}
SPELLINGS |= {re.sub("[^a-z0-9]", "", name): name for name in PATTERN_EXPONENTS}
"""Pattern names by their spellings in lower case without separators."""
POLE = 1e-12
"""Squared sine of the zenith angle below which a direction counts as vertical."""


@pytree
class Antenna:
    """Orientation and pattern of an antenna."""

    orientation: Float[Array, "4"]
    """Quaternion (wxyz) of any non-zero length that rotates the antenna's own frame into that of the directions."""
    exponents: Float[Array, "2"]
    """Exponents of the gains of the TR 38.901 element and of the short dipole."""


def upright(exponents: Float[Array, "2"]) -> Antenna:
    """Returns an unrotated antenna; exponents of zero make it isotropic."""
    return Antenna(jnp.array([1, 0, 0, 0], exponents.dtype), exponents)


def pattern_exponents(pattern: str) -> tuple[float, float]:
    """Returns the exponents of a named pattern, in any usual spelling.

    Raises:
        UserError: an unknown pattern.
    """
    plain = re.sub(r"[^a-z0-9]", "", pattern.lower())
    if plain not in SPELLINGS:
        choices = ", ".join(filter(None, PATTERN_EXPONENTS))
        raise UserError(f"unknown antenna pattern {pattern[:40]!r}; choose {choices}, or an empty name if it is unknown")
    return PATTERN_EXPONENTS[SPELLINGS[plain]]


@jax.jit
def antenna_field(antenna: Antenna, direction: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Returns the polarised amplitude gain of an antenna in unit directions: theta-hat of its own frame times its gain."""
    own = to_local(direction, antenna.orientation)
    directional, dipole = antenna.exponents
    gain = element_gain(own) ** directional * dipole_gain(own) ** dipole
    turn = rotation_matrix(antenna.orientation)
    return gain[..., None] * jnp.matmul(zenith_vector(own), turn.T, precision=EXACT)


def element_gain(direction: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    """Returns the amplitude gain of the element of 3GPP TR 38.901 (table 7.3-1) in unit directions: boresight +x, 8 dBi.

    In the vertical directions, where the azimuth is undefined, gain and gradient are those of azimuth 0.
    """
    x, y, z = jnp.moveaxis(direction, -1, 0)
    squared = x * x + y * y
    pole = squared < POLE
    zenith = jnp.degrees(jnp.arctan2(jnp.sqrt(jnp.maximum(squared, POLE)), z))
    azimuth = jnp.degrees(jnp.arctan2(jnp.where(pole, 0, y), jnp.where(pole, 1, x)))
    vertical = jnp.minimum(12 * ((zenith - 90) / 65) ** 2, 30.0)
    horizontal = jnp.minimum(12 * (azimuth / 65) ** 2, 30.0)
    return 10 ** ((8 - jnp.minimum(vertical + horizontal, 30.0)) / 20)


def dipole_gain(direction: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    """Returns the amplitude gain of a short dipole along z in unit directions, sqrt(1.5) sin(zenith): 1.8 dBi."""
    x, y, _ = jnp.moveaxis(direction, -1, 0)
    return jnp.sqrt(1.5 * jnp.maximum(x * x + y * y, POLE))


def zenith_vector(direction: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Returns the unit vector theta-hat of a unit direction: the electric field direction of a vertically polarised antenna."""
    x, y, z = jnp.moveaxis(direction, -1, 0)
    horizontal = jnp.sqrt(jnp.maximum(x * x + y * y, POLE))
    return jnp.stack([z * x / horizontal, z * y / horizontal, -horizontal], -1)
