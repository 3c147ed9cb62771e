"""Diffraction at a wedge with slab faces: the uniform theory of diffraction.

    D = -(D1 + D2) I + R_0 D4 + R_n D3

with the coefficients D1..D4 of Kouyoumjian and Pathak (Proc. IEEE 62, 1974, equation 25) and slab reflection coefficients of
the two faces instead of +-1 (Luebbers, IEEE Trans. AP 32, 1984): R_0 at the angle of the incident ray to the 0-face, R_n at
that of the diffracted ray to the n-face, which makes it reciprocal.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from wbgs_jax._util.complex_math import quotient


def _weideman(terms: int) -> tuple[float, np.ndarray]:
    """Returns scale and polynomial of Weideman's rational approximation of w(z) (SIAM J. Numer. Anal. 31, 1994)."""
    m = 2 * terms
    scale = math.sqrt(terms / math.sqrt(2))
    t = scale * np.tan(np.arange(-m + 1, m) * np.pi / m / 2)
    f = np.concatenate([[0], np.exp(-(t**2)) * (scale**2 + t**2)])
    return scale, np.flipud(np.real(np.fft.fft(np.fft.fftshift(f)))[1 : terms + 1] / (2 * m))


_SCALE, _POLYNOMIAL = _weideman(16)


def faddeeva(z: Complex[Array, "*n"]) -> Complex[Array, "*n"]:
    """Returns the Faddeeva function w(z) = exp(-z^2) erfc(-jz) in the upper half plane, to about 1e-6."""
    below = quotient(jnp.ones_like(z), _SCALE - 1j * z)
    ratio = (_SCALE + 1j * z) * below
    p = jnp.zeros_like(ratio)
    for coefficient in _POLYNOMIAL:
        p = p * ratio + float(coefficient)
    return (2 * p * below + 1 / math.sqrt(math.pi)) * below


def transition(root: Float[Array, "*n"]) -> Complex[Array, "*n"]:
    """Returns F(x) / sqrt(x) of the transition function F, for root = sqrt(x) >= 0 (Kouyoumjian and Pathak, equation 26)."""
    turn = complex(math.cos(0.75 * math.pi), math.sin(0.75 * math.pi))
    return math.sqrt(math.pi) * complex(math.sqrt(0.5), math.sqrt(0.5)) * faddeeva(turn * root)


def _cotangent_transition(
    angle: Float[Array, "*#n"], n: Float[Array, "*#n"], root_kl: Float[Array, "*#n"]
) -> Complex[Array, "*#n"]:
    """Returns cot(angle) F(kL a), which stays finite at the shadow boundary angle = 0 (modulo pi)."""
    angle = angle - jnp.pi * jnp.round(angle / jnp.pi)
    angle = jnp.where(jnp.abs(angle) < 1e-6, 1e-6, angle)
    root = math.sqrt(2) * root_kl * jnp.abs(jnp.sin(n * angle))
    return jnp.cos(angle) / jnp.sin(angle) * root * transition(root)


def wedge_coefficients(
    phi_in: Float[Array, "*#n"],
    phi_out: Float[Array, "*#n"],
    n: Float[Array, "*#n"],
    sin_beta: Float[Array, "*#n"],
    kl: Float[Array, "*#n"],
    wavenumber: Float[Array, "*#n"],
) -> tuple[Complex[Array, "*#n"], Complex[Array, "*#n"], Complex[Array, "*#n"]]:
    """Returns (D1 + D2, D3, D4), in square roots of metres (Kouyoumjian and Pathak, equation 25).

    Args:
        phi_in, phi_out: angles (radians) of source and observation point, measured from the 0-face through free space.
        n: exterior angle in half turns (1..2).
        sin_beta: sine of the angle between the ray and the edge.
        kl: wavenumber times the distance parameter s s' sin^2(beta) / (s + s').
    """
    factor = -complex(math.sqrt(0.5), -math.sqrt(0.5)) / (2 * n * jnp.sqrt(2 * jnp.pi * wavenumber) * sin_beta)
    root_kl = jnp.sqrt(kl)

    minus, plus = phi_out - phi_in, phi_out + phi_in
    # Together: four times the same terms are a program that XLA compiles for much longer.
    beta = jnp.stack(jnp.broadcast_arrays(minus, -minus, plus, -plus))
    d = factor * _cotangent_transition((jnp.pi + beta) / (2 * n), n, root_kl)
    return d[0] + d[1], d[2], d[3]
