"""Quaternions, covariances, coordinate frames, and direction <-> (azimuth, zenith) <-> PAS pixel.

Pixel coordinates are continuous: pixel (row i, column j) of a PAS samples the point x = j, y = i. Columns cover azimuth
-pi..pi with both ends included, so the period of the azimuth is `AZIMUTH_PERIOD` = 359 pixels, not 360.
"""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from wbgs_jax.radio.array import EXACT, PAS_HEIGHT, PAS_WIDTH

AZIMUTH_PERIOD = PAS_WIDTH - 1
"""Pixels in a full turn of azimuth."""

Projection = Literal["hemisphere", "sphere"]
"""Zenith range on the rows: "hemisphere" is 0..90 degrees (paper, section 4.3), "sphere" squeezes 0..180 degrees onto them."""

_ZENITH_SPAN: dict[str, float] = {"hemisphere": jnp.pi / 2, "sphere": jnp.pi}


def rotation_matrix(quats: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """Returns rotation matrices of quaternions (wxyz) of any non-zero length."""
    w, x, y, z = jnp.moveaxis(quats / jnp.linalg.norm(quats, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def to_local(vectors: Inexact[Array, "*n 3"], orientation: Float[Array, "4"]) -> Inexact[Array, "*n 3"]:
    """Returns world vectors, real or complex, in the local frame; the quaternion `orientation` (wxyz) rotates local vectors
    into world ones."""
    return jnp.matmul(vectors, rotation_matrix(orientation), precision=EXACT)


def quaternion_product(a: Float[Array, "*n 4"], b: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """Returns the quaternion (wxyz) of the rotation b followed by the rotation a."""
    scalar = a[..., :1] * b[..., :1] - jnp.sum(a[..., 1:] * b[..., 1:], -1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + jnp.cross(a[..., 1:], b[..., 1:])
    return jnp.concatenate([scalar, vector], -1)


def rotation_quaternion(rotation: Float[Array, "*n 3"]) -> Float[Array, "*n 4"]:
    """Returns unit quaternions (wxyz) of rotation vectors, radians."""
    half = rotation / 2
    angle = jnp.sqrt(jnp.maximum(jnp.sum(half * half, -1, keepdims=True), 1e-24))  # differentiable where nothing rotates
    return jnp.concatenate([jnp.cos(angle), half * (jnp.sin(angle) / angle)], -1)


def turned(orientation: Float[Array, "4"], rotation: Float[Array, "3"]) -> Float[Array, "4"]:
    """Returns a quaternion (wxyz, of any length) after a small rotation of the world frame (rotation vector, radians), with an
    error of third order."""
    w, v = orientation[0], orientation[1:]
    half = rotation / 2
    return jnp.concatenate([(w - jnp.sum(half * v))[None], v + w * half + jnp.cross(half, v)])


def covariance_factor(log_scales: Float[Array, "*n 3"], quats: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """Returns M with covariance M M^T: the principal axes as columns, scaled by the standard deviations (metres)."""
    return rotation_matrix(quats) * jnp.exp(log_scales)[..., None, :]


def direction_to_angles(vectors: Float[Array, "*n 3"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Returns azimuth (-pi..pi) and zenith (0..pi) in radians of vectors of any length in the receiver's local frame."""
    x, y, z = jnp.moveaxis(vectors, -1, 0)
    return jnp.arctan2(y, x), jnp.arctan2(jnp.hypot(x, y), z)


def angles_to_direction(azimuth: Float[Array, "*n"], zenith: Float[Array, "*n"]) -> Float[Array, "*n 3"]:
    """Returns unit vectors (sin t cos p, sin t sin p, cos t) of azimuth p and zenith t in radians."""
    sine = jnp.sin(zenith)
    return jnp.stack([sine * jnp.cos(azimuth), sine * jnp.sin(azimuth), jnp.cos(zenith)], -1)


def pixels_per_radian(projection: Projection) -> tuple[float, float]:
    """Returns columns per radian of azimuth and rows per radian of zenith."""
    if projection not in _ZENITH_SPAN:
        raise ValueError(f"projection is {projection!r}; choose 'hemisphere' or 'sphere'")
    return AZIMUTH_PERIOD / (2 * jnp.pi), (PAS_HEIGHT - 1) / _ZENITH_SPAN[projection]


def angles_to_pixel(
    azimuth: Float[Array, "*n"], zenith: Float[Array, "*n"], projection: Projection = "hemisphere"
) -> Float[Array, "*n 2"]:
    """Returns continuous pixel coordinates (x: column, y: row) (paper, section 4.3, with p_x = (phi + pi) / (2 pi) W)."""
    sx, sy = pixels_per_radian(projection)
    return jnp.stack([(azimuth + jnp.pi) * sx, zenith * sy], -1)


def smooth_length(v: Float[Array, "*n 3"]) -> Float[Array, "*n 1"]:
    """Returns vector lengths (metres), smoothed on the scale of a millimetre so that they are differentiable everywhere."""
    return jnp.sqrt(jnp.sum(v * v, -1, keepdims=True) + 1e-6)
