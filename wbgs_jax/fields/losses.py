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

_WINDOW, _SIGMA = 11, 1.5
FAINTEST = 1e-12
"""Power relative to the truth's, below which predictions are all the same to the loss: a prediction of nearly nothing has no
gradient that leads anywhere."""
GOOD_MATCH = 2e-3
"""One minus the squared correlation below which two snapshots are the same to a search."""
UNEXPLAINED = 0.1
"""Power of noise relative to what a model explains, in `surprise`: of paths that nobody has thought of."""
_C1, _C2 = 0.01**2, 0.03**2


@functools.lru_cache
def _blur_matrix(size: int) -> Float[np.ndarray, "valid size"]:
    """Returns the banded matrix that blurs one axis, valid region only."""
    offset = np.arange(_WINDOW) - _WINDOW // 2
    window = np.exp(-(offset**2) / (2 * _SIGMA**2))
    window /= window.sum()
    matrix = np.zeros((size - _WINDOW + 1, size))
    for row in range(len(matrix)):
        matrix[row, row : row + _WINDOW] = window
    return matrix


def _blur(images: Float[Array, "*n h w"], stride: int) -> Float[Array, "*n h_valid w_valid"]:
    """Returns the separable Gaussian blur at every `stride`-th place along both axes, as two matrix products: forward and
    backward 16-30 times faster than convolutions or shifted sums on a CPU. Full precision: variances are differences of large
    numbers."""
    rows, columns = (jnp.asarray(_blur_matrix(n)[::stride], images.dtype) for n in images.shape[-2:])
    return jnp.matmul(jnp.matmul(rows, images, precision=EXACT), columns.T, precision=EXACT)


@functools.partial(jax.jit, static_argnames="stride")
def ssim(a: Float[Array, "*n h w"], b: Float[Array, "*n h w"], stride: int = 1) -> Float[Array, "*n"]:
    """Returns the differentiable mean SSIM of images, data range 1: 11x11 Gaussian window, sigma 1.5 (Wang et al. 2004).

    A `stride` of k looks at every k-th window along both axes alone. Neighbours overlap by 10 of 11 pixels and say nearly the
    same, so that a training loses nothing with 2, at a third of the time.
    """
    mean_a, mean_b = _blur(a, stride), _blur(b, stride)
    squared_means, product = mean_a**2 + mean_b**2, mean_a * mean_b
    variances = _blur(a * a + b * b, stride) - squared_means
    covariance = _blur(a * b, stride) - product
    luminance = (2 * product + _C1) / (squared_means + _C1)
    structure = (2 * covariance + _C2) / (variances + _C2)
    return jnp.mean(luminance * structure, axis=(-2, -1))


def snapshot_losses(
    predicted: Complex[Array, "*n elements"], truth: Complex[Array, "*n elements"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns (correlation_loss, power_loss): one minus the squared correlation |y^H y'| / (|y| |y'|), and the squared error
    of the log amplitude of the whole array (nepers), means over snapshots.

    The correlation is blind to a common phase and scale.
    """
    squared_correlation, power = _correlation_and_power(predicted, truth)
    return jnp.mean(1 - squared_correlation), jnp.mean((0.5 * jnp.log(power)) ** 2)


def log_decorrelation(predicted: Complex[Array, "*n elements"], truth: Complex[Array, "*n elements"]) -> Float[Array, "*n"]:
    """Returns log(1 - correlation^2): the log-likelihood, up to its sign, where every snapshot has a noise of its own, unknown
    level. No match is perfect (`GOOD_MATCH`)."""
    squared_correlation, _ = _correlation_and_power(predicted, truth)
    return jnp.log(1 - squared_correlation + GOOD_MATCH)


def surprise(covariance: Complex[Array, "*n k k"], truth: Complex[Array, "*n k"]) -> Float[Array, "*n"]:
    """Returns how unlikely snapshots are if they are complex normal with these covariances, each of a scale of its own: minus
    the log-likelihood of the most likely scale, divided by the number of elements, constants left out.

    Covariances have a trace of 1, and `UNEXPLAINED` of it is added as noise. Where one sum of paths is all that there is, this
    is `log_decorrelation`, but for a constant and the noise; where paths are partially coherent it knows which part of a
    snapshot says nothing. Of a silent snapshot it is zero.
    """
    count = truth.shape[-1]
    noise = UNEXPLAINED / count * jnp.eye(count)
    lower = jnp.linalg.cholesky((covariance + noise) / (1 + UNEXPLAINED))
    unit, norm = unit_snapshots(truth)
    whitened = solve_triangular(lower, unit[..., None], lower=True)[..., 0]
    volume = 2 * jnp.sum(jnp.log(jnp.diagonal(lower, axis1=-2, axis2=-1).real), -1)
    heard = norm[..., 0] > 0
    return jnp.where(heard, volume / count + jnp.log(jnp.where(heard, jnp.sum(squared_magnitude(whitened), -1), 1)), 0)


def _correlation_and_power(
    predicted: Complex[Array, "*n elements"], truth: Complex[Array, "*n elements"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Returns |y^H y'|^2 / (|y|^2 |y'|^2) and |y'|^2 / |y|^2; of a silent truth, which says nothing of either, 1 and 1."""
    unit_truth, scale = unit_snapshots(truth)
    heard = scale[..., 0] > 0
    relative = predicted / jnp.where(scale > 0, scale, 1)
    power = jnp.sum(squared_magnitude(relative), -1) + FAINTEST
    squared_correlation = squared_magnitude(jnp.sum(unit_truth.conj() * relative, -1)) / power
    return jnp.where(heard, squared_correlation, 1), jnp.where(heard, power, 1)


def image_loss(
    predicted: Float[Array, "*n h w"], truth: Float[Array, "*n h w"], ssim_weight: float = 0.2, ssim_stride: int = 1
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns the mean loss over the images (paper, equation 5), and their mean SSIM (`ssim`) at every so many-th window."""
    l1 = jnp.mean(jnp.abs(predicted - truth))
    similarity = jnp.mean(ssim(predicted, truth, ssim_stride))
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - similarity), similarity


def pixel_loss(predicted: Float[Array, "*n"], truth: Float[Array, "*n"], kind: Literal["l1", "l2"]) -> Float[Array, ""]:
    """Returns the mean absolute or squared error, for pixels that make no image."""
    error = predicted - truth
    return jnp.mean(jnp.abs(error) if kind == "l1" else error**2)


def power_loss(seen: Any, power_db: Float[Array, " n"]) -> Float[Array, ""] | None:
    """Returns the mean squared error in dB of the power that a field says (`Observation`); None if it says none."""
    return None if seen.power_db is None else jnp.mean((seen.power_db - power_db) ** 2)


LOSSES: dict[str, Callable[[Any, Any], Float[Array, ""] | None]] = {"power_db": power_loss}
"""By kind of observation that has no spectra: (what a field says, an `Observation`; what was observed) -> loss of the batch;
None if the field says nothing that could be compared. A kind that is not here is learned by the power that follows from it."""
