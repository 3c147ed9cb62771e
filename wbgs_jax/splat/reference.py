"""Dense reference renderer: equation 6 of the paper, Gaussian by Gaussian over all pixels. Slow, short, differentiable.

    I(p) = sum_i  T_i(p) alpha_i(p) Sig_i,     T_i(p) = prod_{j<i} (1 - alpha_j(p)),     alpha_i(p) = delta_i G_i(p)

over the Gaussians from near to far. delta in [0, 1) is the attenuation that a Gaussian inflicts on everything behind it (the
paper's delta is the surviving factor, 1 - alpha here), and G is its footprint. As in the authors' code and in 3D Gaussian
splatting, a Gaussian radiates with the same weight with which it occludes.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.splat.projection import Splats, footprint, mahalanobis2, wrap_azimuth


def render_dense(splats: Splats, attenuation: Float[Array, "n b"], signal: Float[Array, "n b"]) -> Float[Array, "b 90 360"]:
    """Returns N splats blended for B queries; attenuation (delta, in [0, 1)) and signal (Sig) are per Gaussian and query.

    Args:
        splats: from `project`.
        attenuation: delta of every Gaussian and query, in [0, 1).
        signal: Sig of every Gaussian and query.

    Returns:
        Images (b, 90, 360), in the unit of the signal.
    """
    order = jnp.argsort(jax.lax.stop_gradient(splats.depths))
    x = jnp.arange(PAS_WIDTH, dtype=attenuation.dtype)[None, :]
    y = jnp.arange(PAS_HEIGHT, dtype=attenuation.dtype)[:, None]

    def blend(carry, i):
        image, transmittance = carry
        dx, dy = wrap_azimuth(x - splats.means2d[i, 0]), y - splats.means2d[i, 1]
        g = footprint(mahalanobis2(dx, dy, splats.conics[i]))
        alive = jnp.isfinite(splats.depths[i])
        alpha = jnp.where(alive, attenuation[i][:, None, None] * g, 0)
        image = image + transmittance * alpha * signal[i][:, None, None]
        return (image, transmittance * (1 - alpha)), None

    blank = jnp.zeros((attenuation.shape[1], PAS_HEIGHT, PAS_WIDTH), attenuation.dtype)
    (image, _), _ = jax.lax.scan(blend, (blank, blank + 1), order)
    return image
