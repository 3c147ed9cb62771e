"""3D Gaussians -> 2D Gaussians ("splats") on the PAS, by the EWA linearisation (Zwicker et al. 2001; paper, section 4.3).

The map is (x, y, z) -> (azimuth, zenith) -> pixel in the receiver's local frame, its Jacobian taken at the centre. Three
choices keep the image well defined everywhere:

* azimuth is periodic; a splat's footprint is measured to the nearest alias of its centre;
* the azimuth standard deviation, which grows without bound near the poles, is capped so that a footprint never meets its
  own alias;
* a low-pass of `LOW_PASS` px^2 is added to the 2D covariance, as in 3D Gaussian splatting.

A footprint is a Gaussian that goes continuously to zero at `SUPPORT` standard deviations. With q the squared Mahalanobis
distance, G(q) = max(0, exp(-q/2) - e0) / (1 - e0), e0 = exp(-SUPPORT^2 / 2). A plain Gaussian cut off by tile lists or by a
threshold would make image and gradients jump or depend on the tiling.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from wbgs_jax._util.pytree import pytree
from wbgs_jax.radio.array import EXACT
from wbgs_jax.radio.geometry import (
    AZIMUTH_PERIOD,
    Projection,
    angles_to_pixel,
    covariance_factor,
    direction_to_angles,
    pixels_per_radian,
    to_local,
)
from wbgs_jax.types import Gaussians, Receiver

SUPPORT = 3.0
"""Standard deviations at which footprints end: part of the definition of the image, independent of the tiling."""
LOW_PASS = 0.3
"""Variance added to both axes of the 2D covariance, pixels squared."""
TILE_ROOM = 12
"""Pixels on either side of a tile's centre that are kept free, ..."""
MAX_AZIMUTH_SIGMA = (AZIMUTH_PERIOD / 2 - TILE_ROOM) / SUPPORT
"""... so that wrapping relative to the centre of a tile equals wrapping relative to any of its pixels. Pixels."""
MIN_RANGE = 1e-3
"""Metres. Lower bound on distances to the receiver and to its zenith axis, which keeps Jacobians finite."""


@pytree
class Splats:
    """N projected Gaussians."""

    means2d: Float[Array, "n 2"]
    """Pixel coordinates (x: column in 0..359, y: row; y > 89 lies below the horizon)."""
    conics: Float[Array, "n 3"]
    """Inverse 2D covariance (xx, xy, yy), 1 / px^2. An empty slot has zeros."""
    depths: Float[Array, " n"]
    """Distance to the receiver, metres; infinite for an empty slot."""
    radii: Float[Array, "n 2"]
    """Half extents (x, y) of the footprint's bounding box, pixels, without gradient; negative for an empty slot."""


def jacobian(local: Float[Array, "n 3"], projection: Projection) -> Float[Array, "n 2 3"]:
    """Returns the derivative of pixel coordinates with respect to the local position (pixels per metre)."""
    x, y, z = jnp.moveaxis(local, -1, 0)
    sx, sy = pixels_per_radian(projection)
    rho2 = jnp.maximum(x * x + y * y, MIN_RANGE**2)
    rho, r2 = jnp.sqrt(rho2), rho2 + z * z
    azimuth = jnp.stack([-y / rho2, x / rho2, jnp.zeros_like(x)], -1)
    zenith = jnp.stack([x * z / (r2 * rho), y * z / (r2 * rho), -rho / r2], -1)
    return jnp.stack([azimuth * sx, zenith * sy], -2)


@partial(jax.jit, static_argnames="projection")
def project(
    gaussians: Gaussians,
    receiver: Receiver,
    projection: Projection = "hemisphere",
    means2d_offset: Float[Array, "n 2"] | None = None,
) -> Splats:
    """Returns Gaussians projected onto the PAS of a receiver.

    Args:
        gaussians: world frame, metres.
        receiver: its position and orientation define the local frame.
        projection: mapping from angles to pixels.
        means2d_offset: pixels, normally zeros; added to the centres. Its gradient is the positional gradient that density
            control needs.

    Returns:
        The splats: centres and extents in pixels, depths in metres.
    """
    local = to_local(gaussians.means - receiver.position, receiver.orientation)
    # Empty slots are moved to a harmless position so that neither their values nor their gradients can be NaN.
    alive = gaussians.alive[:, None]
    local = _off_axis(jnp.where(alive, local, jnp.ones_like(local)))
    factor = covariance_factor(jnp.where(alive, gaussians.log_scales, 0), jnp.where(alive, gaussians.quats, 1))
    factor = to_local_matrix(factor, receiver.orientation)
    means2d = angles_to_pixel(*direction_to_angles(local), projection)
    if means2d_offset is not None:
        means2d = means2d + means2d_offset
    spread = jnp.einsum("nij,njk->nik", jacobian(local, projection), factor, precision=EXACT)
    spread = _cap_azimuth(spread)
    xx, xy, yy, determinant = _covariance2d(spread)
    conics = jnp.stack([yy, -xy, xx], -1) / determinant[:, None]
    radii = SUPPORT * jnp.sqrt(jnp.stack([xx, yy], -1))
    return Splats(
        means2d=means2d,
        conics=jnp.where(alive, conics, 0),
        depths=jnp.where(alive[:, 0], jnp.linalg.norm(local, axis=-1), jnp.inf),
        radii=jax.lax.stop_gradient(jnp.where(alive, radii, -1)),
    )


def to_local_matrix(factor: Float[Array, "n 3 3"], orientation: Float[Array, "4"]) -> Float[Array, "n 3 3"]:
    """Returns world-frame matrices with their columns rotated into the local frame."""
    return jnp.swapaxes(to_local(jnp.swapaxes(factor, -1, -2), orientation), -1, -2)


def _off_axis(local: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Returns centres moved off the zenith axis, where the azimuth has no derivative; x and y get no gradient there."""
    horizontal, vertical = local[:, :2], local[:, 2:]
    near = jnp.linalg.norm(jax.lax.stop_gradient(horizontal), axis=-1, keepdims=True) < MIN_RANGE
    beside = jax.lax.stop_gradient(horizontal) + jnp.array([MIN_RANGE, 0], local.dtype)
    return jnp.concatenate([jnp.where(near, beside, horizontal), vertical], -1)


def _cap_azimuth(spread: Float[Array, "n 2 3"]) -> Float[Array, "n 2 3"]:
    """Returns the spread with its x axis shrunk where its standard deviation exceeds `MAX_AZIMUTH_SIGMA`."""
    limit = MAX_AZIMUTH_SIGMA**2 - LOW_PASS
    xx = jnp.sum(spread[:, 0] ** 2, -1)
    shrink = jnp.sqrt(jnp.minimum(1, limit / jnp.maximum(xx, limit / 2)))
    return spread.at[:, 0].multiply(shrink[:, None])


def _covariance2d(
    spread: Float[Array, "n 2 3"],
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """Returns the low-passed 2D covariance (xx, xy, yy) and its determinant.

    xx yy - xy^2 cancels for thin splats; the cross product of the two rows (Lagrange's identity) does not.
    """
    x, y = spread[:, 0], spread[:, 1]
    xx, xy, yy = jnp.sum(x * x, -1), jnp.sum(x * y, -1), jnp.sum(y * y, -1)
    determinant = jnp.sum(jnp.cross(x, y) ** 2, -1) + LOW_PASS * (xx + yy) + LOW_PASS**2
    return xx + LOW_PASS, xy, yy + LOW_PASS, determinant


CUT = SUPPORT**2
"""Squared Mahalanobis distance at which a footprint ends."""
EDGE = math.exp(-CUT / 2)
"""Value of a plain Gaussian there ..."""
GAIN = 1 / (1 - EDGE)
"""... and the factor that restores 1 at the centre after it is subtracted."""


def mahalanobis2(dx: Float[Array, "*#n"], dy: Float[Array, "*#n"], conic: Float[Array, "*#n 3"]) -> Float[Array, "*n"]:
    """Returns the squared Mahalanobis distance q of offsets (pixels) from the centre."""
    return conic[..., 0] * dx * dx + conic[..., 2] * dy * dy + 2 * conic[..., 1] * dx * dy


def footprint(q: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns the footprint G(q), in 0..1."""
    return jnp.maximum(jnp.exp(-0.5 * q) - EDGE, 0) * GAIN


def windowed_exponential(q: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns -2 dG/dq: the exponential on the support, zero outside."""
    return jnp.where(q < CUT, jnp.exp(-0.5 * q) * GAIN, 0)


def wrap_azimuth(dx: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns the nearest alias of a column offset (pixels)."""
    return dx - AZIMUTH_PERIOD * jnp.round(dx / AZIMUTH_PERIOD)
