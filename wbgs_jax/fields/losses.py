"""Training losses on PAS images: L = (1 - lambda) L1 + lambda (1 - SSIM)  (paper, equation 5)."""

import functools
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Complex, Float

from wbgs_jax.radio.array import EXACT, squared_magnitude
from wbgs_jax.radio.channel import unit_snapshots

GOOD_MATCH = 2e-3
"""One minus the squared correlation below which calibration treats two snapshots as equal."""
UNEXPLAINED = 0.1
"""Power of noise relative to the power of the model, in `surprise`: it stands for paths that are missing from the model."""

COARSE = 3
"""Stride (pixels) of `ssim` where many candidates are compared on the same spectra: a fifth of the time of all windows; mean
weights of mixtures that it fits differ by at most 0.003."""


@functools.lru_cache
def _blur_matrix(size: int) -> Float[np.ndarray, "valid size"]:
    """Returns the banded matrix that blurs one axis, for the valid region only."""
    width, sigma = 11, 1.5
    offset = np.arange(width) - width // 2
    window = np.exp(-(offset**2) / (2 * sigma**2))
    window /= window.sum()
    matrix = np.zeros((size - width + 1, size))
    for row in range(len(matrix)):
        matrix[row, row : row + width] = window
    return matrix


def _blur(images: Float[Array, "*n h w"], stride: int) -> Float[Array, "*n h_valid w_valid"]:
    """Returns the separable Gaussian blur at every `stride`-th position along both axes, as two matrix products: on a CPU,
    forward and backward passes are 16-30 times faster than convolutions or shifted sums. Products are in full precision,
    because variances are differences of large numbers."""
    rows, columns = (jnp.asarray(_blur_matrix(n)[::stride], images.dtype) for n in images.shape[-2:])
    return jnp.matmul(jnp.matmul(rows, images, precision=EXACT), columns.T, precision=EXACT)


@functools.partial(jax.jit, static_argnames="stride")
def ssim(a: Float[Array, "*n h w"], b: Float[Array, "*n h w"], stride: int = 1) -> Float[Array, "*n"]:
    """Returns the differentiable mean SSIM of images, data range 1: 11x11 Gaussian window, sigma 1.5 (Wang et al. 2004).

    With a `stride` of k only every k-th window along both axes is used. Adjacent windows overlap by 10 of 11 pixels and have
    nearly the same values, so that a stride of 2 takes a third of the time in training without loss of accuracy.

    Args:
        a, b: images with values from 0 to 1.
        stride: distance between the windows used, pixels.

    Returns:
        The mean SSIM of every pair, at most 1.
    """
    return _structural_similarity(*(_blur(image, stride) for image in (a, b, a * a + b * b, a * b)))


def ssim_of_mixtures(
    a: Float[Array, "*n h w"],
    b: Float[Array, "*n h w"],
    truth: Float[Array, "*n h w"],
    shares: Float[Array, " shares"],
    stride: int = 1,
) -> Float[Array, "*n shares"]:
    """Returns `ssim(share * a + (1 - share) * b, truth, stride)` for all shares. Local moments of a mixture follow from those
    of its parts, so that nine images are filtered for any number of shares."""
    products = (a * a, a * b, b * b, a * truth, b * truth, truth * truth)
    mean_a, mean_b, mean, aa, ab, bb, at, bt, tt = (_blur(image, stride) for image in (a, b, truth, *products))

    def of(share: Float[Array, ""]) -> Array:
        rest = 1 - share
        squares = share**2 * aa + 2 * share * rest * ab + rest**2 * bb
        return _structural_similarity(share * mean_a + rest * mean_b, mean, squares + tt, share * at + rest * bt)

    return jnp.moveaxis(jax.lax.map(of, shares), 0, -1)


def _structural_similarity(
    mean_a: Float[Array, "*n y x"],
    mean_b: Float[Array, "*n y x"],
    squares: Float[Array, "*n y x"],
    product: Float[Array, "*n y x"],
) -> Float[Array, "*n"]:
    """Returns the mean SSIM from local means of two images, of the sum of their squares, and of their product."""
    squared_means, product_of_means = mean_a**2 + mean_b**2, mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * product_of_means + c1) / (squared_means + c1)
    structure = (2 * (product - product_of_means) + c2) / (squares - squared_means + c2)
    return jnp.mean(luminance * structure, axis=(-2, -1))


def snapshot_losses(
    predicted: Complex[Array, "*n elements"], truth: Complex[Array, "*n elements"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns (correlation_loss, power_loss), means over snapshots: one minus the squared correlation |y^H y'| / (|y| |y'|),
    and the squared error of the log amplitude of the whole array (nepers).

    The correlation does not depend on a common phase and scale.
    """
    squared_correlation, power = _correlation_and_power(predicted, truth)
    return jnp.mean(1 - squared_correlation), jnp.mean((0.5 * jnp.log(power)) ** 2)


def log_decorrelation(predicted: Complex[Array, "*n elements"], truth: Complex[Array, "*n elements"]) -> Float[Array, "*n"]:
    """Returns log(1 - correlation^2), up to constants the negative log-likelihood (per element) if the noise level of every
    snapshot is unknown. `GOOD_MATCH` is added, which bounds it from below."""
    squared_correlation, _ = _correlation_and_power(predicted, truth)
    return jnp.log(1 - squared_correlation + GOOD_MATCH)


def surprise(covariance: Complex[Array, "*n k k"], truth: Complex[Array, "*n k"]) -> Float[Array, "*n"]:
    """Returns the negative log-likelihood of snapshots that are complex normal with these covariances, each with its most
    likely scale, divided by the number of elements, without constants; 0 for an all-zero snapshot.

    For fully coherent paths, this is `log_decorrelation` except for a constant and the noise; for partially coherent paths it
    gives less weight to the components of a snapshot that are uncertain.

    Args:
        covariance: covariances with a trace of 1, to which noise with a trace of `UNEXPLAINED` is added.
        truth: measured snapshots.
    """
    count = truth.shape[-1]
    noise = UNEXPLAINED / count * jnp.eye(count)
    lower = jnp.linalg.cholesky((covariance + noise) / (1 + UNEXPLAINED))
    unit, norm = unit_snapshots(truth)
    whitened = solve_triangular(lower, unit[..., None], lower=True)[..., 0]
    volume = 2 * jnp.sum(jnp.log(jnp.diagonal(lower, axis1=-2, axis2=-1).real), -1)
    received = norm[..., 0] > 0
    return jnp.where(received, volume / count + jnp.log(jnp.where(received, jnp.sum(squared_magnitude(whitened), -1), 1)), 0)


def _correlation_and_power(
    predicted: Complex[Array, "*n elements"], truth: Complex[Array, "*n elements"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Returns |y^H y'|^2 / (|y|^2 |y'|^2) and |y'|^2 / |y|^2; both are 1 where the truth is zero, since neither is defined."""
    unit_truth, scale = unit_snapshots(truth)
    received = scale[..., 0] > 0
    relative = predicted / jnp.where(scale > 0, scale, 1)
    # Power relative to that of the truth that is added to predictions: a prediction close to zero has no useful gradient.
    faintest = 1e-12
    power = jnp.sum(squared_magnitude(relative), -1) + faintest
    squared_correlation = squared_magnitude(jnp.sum(unit_truth.conj() * relative, -1)) / power
    return jnp.where(received, squared_correlation, 1), jnp.where(received, power, 1)


def image_loss(
    predicted: Float[Array, "*n h w"], truth: Float[Array, "*n h w"], ssim_weight: float = 0.2, ssim_stride: int = 1
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns the mean loss over the images (paper, equation 5), and their mean SSIM (`ssim`), whose windows have the stride
    `ssim_stride`.

    Args:
        predicted, truth: spectra, from 0 to 1.
        ssim_weight: weight of one minus the SSIM; the rest is that of the mean absolute difference.
        ssim_stride: as in `ssim`.

    Returns:
        The loss and the mean SSIM.
    """
    l1 = jnp.mean(jnp.abs(predicted - truth))
    similarity = jnp.mean(ssim(predicted, truth, ssim_stride))
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - similarity), similarity


def pixel_loss(predicted: Float[Array, "*n"], truth: Float[Array, "*n"], kind: Literal["l1", "l2"]) -> Float[Array, ""]:
    """Returns the mean absolute or squared error of pixels that do not form an image."""
    error = predicted - truth
    return jnp.mean(jnp.abs(error) if kind == "l1" else error**2)


def power_loss(seen: Any, power_db: Float[Array, " n"]) -> Float[Array, ""] | None:
    """Returns the mean squared error (dB^2) of a field's received power (`Observation`); None if it does not predict it."""
    return None if seen.power_db is None else jnp.mean((seen.power_db - power_db) ** 2)


LOSSES: dict[str, Callable[[Any, Any], Float[Array, ""] | None]] = {"power_db": power_loss}
"""Losses by kind of observation without spectra. The arguments are predictions (`Observation`) and observations; the result is
the loss of the batch, or None if the field predicts nothing comparable. For kinds that are not listed, the received power that
follows from the observations is compared instead."""
