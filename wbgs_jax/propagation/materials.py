"""Reflection and transmission of a homogeneous slab in air (Recommendation ITU-R P.2040-3, section 2.2.2.2)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from wbgs_jax._util.complex_math import phasor, quotient, root
from wbgs_jax._util.pytree import pytree
from wbgs_jax.radio.array import SPEED_OF_LIGHT

DAMPING = 1 - 1e-4
"""Loss factor per passage, too small to measure: resonances of lossless slabs at grazing incidence stay finite."""


@pytree
class Slabs:
    """Material of every facet at one frequency."""

    permittivity: Complex[Array, " f"]
    """Relative complex permittivity (`complex_permittivity`)."""
    thickness: Float[Array, " f"]
    """Metres."""
    air: Float[Array, ""] | float = 0.0
    """Fraction of the phase of the displaced air that is removed from transmitted waves (`slab_coefficients`)."""


class SlabCoefficients(NamedTuple):
    """Amplitude coefficients of the electric field perpendicular (TE) and parallel (TM) to the plane of incidence."""

    reflect_te: Complex[Array, "*#n"]
    reflect_tm: Complex[Array, "*#n"]
    transmit_te: Complex[Array, "*#n"]
    transmit_tm: Complex[Array, "*#n"]


def complex_permittivity(
    permittivity: Float[Array, "*#n"], conductivity: Float[Array, "*#n"], frequency_hz: Float[Array, "*#n"]
) -> Complex[Array, "*#n"]:
    """Returns the relative permittivity eps_r - j sigma / (eps_0 omega), with the conductivity sigma in S/m."""
    vacuum_permittivity = 8.8541878128e-12  # farads per metre
    return permittivity - 1j * conductivity / (2 * jnp.pi * frequency_hz * vacuum_permittivity)


@jax.jit
def slab_coefficients(
    cosine: Float[Array, "*#n"],
    permittivity: Complex[Array, "*#n"],
    thickness: Float[Array, "*#n"],
    frequency_hz: Float[Array, "*#n"],
    air: Float[Array, ""] | float = 0.0,
) -> SlabCoefficients:
    """Returns the coefficients of a slab in air (ITU-R P.2040-3, section 2.2.2.2).

    A transmitted wave keeps its direction and is not shifted sideways. Its path length includes the thickness of the slab,
    whose phase k t cos(theta) in air is therefore counted in addition to that of the slab unless it is removed here. Ray
    tracers whose walls have no thickness leave it in.

    Args:
        cosine: of the angle of incidence (0..1).
        permittivity: relative and complex, imaginary part at most 0.
        thickness: metres.
        frequency_hz: of the wave.
        air: fraction of that phase which is removed: 0 as in ray tracers, 1 as in reality.
    """
    inner, wavelengths = root(permittivity - (1 - cosine**2)), frequency_hz / SPEED_OF_LIGHT * thickness
    # Clipped where the wave has vanished, so that gradients stay finite.
    left = DAMPING * jnp.exp(jnp.maximum(2 * jnp.pi * wavelengths * inner.imag, -40.0))
    one_way = left * phasor(-wavelengths * inner.real)
    round_trip = one_way * one_way

    def both(r):
        ground = 1 - r * r * round_trip
        return quotient(r * (1 - round_trip), ground), quotient((1 - r * r) * one_way, ground)

    te = both(quotient(cosine - inner, cosine + inner))
    tm = both(quotient(permittivity * cosine - inner, permittivity * cosine + inner))
    replaced = phasor(air * wavelengths * cosine)
    return SlabCoefficients(te[0], tm[0], te[1] * replaced, tm[1] * replaced)
