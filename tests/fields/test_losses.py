"""The differentiable SSIM against dm_pix and scikit-image, and the loss against its formula."""

import dm_pix
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage.metrics import structural_similarity

from wbgs_jax.fields.losses import image_loss, pixel_loss, ssim


@pytest.fixture
def images(rng, x64):
    """Two batches of smooth pictures with noise, in 0..1."""
    a = rng.random((3, 90, 360)).cumsum(-1).cumsum(-2) % 7 / 7
    return jnp.asarray(a), jnp.asarray(np.clip(a + 0.2 * rng.normal(size=a.shape), 0, 1))


def dm_pix_ssim(a, b):
    """dm_pix's defaults (11x11 window, sigma 1.5, valid region) are Wang et al.'s; it wants a channel axis."""
    return dm_pix.ssim(a[..., None], b[..., None], max_val=1.0, filter_size=11, filter_sigma=1.5)


def test_ssim_equals_dm_pix_in_value_and_gradient(rng, images):
    weights = jnp.asarray(rng.normal(size=3))
    value, gradient = jax.value_and_grad(lambda a, b: weights @ ssim(a, b), argnums=(0, 1))(*images)
    expected, expected_gradient = jax.value_and_grad(lambda a, b: weights @ dm_pix_ssim(a, b), argnums=(0, 1))(*images)
    np.testing.assert_allclose(ssim(*images), dm_pix_ssim(*images), rtol=1e-10)
    assert float(value) == pytest.approx(float(expected), rel=1e-10)
    for got, want in zip(gradient, expected_gradient, strict=True):
        np.testing.assert_allclose(got, want, atol=1e-8 * float(jnp.abs(want).max()))


def test_ssim_equals_scikit_image_with_the_gaussian_window(images):
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    expected = [structural_similarity(np.asarray(a), np.asarray(b), **options) for a, b in zip(*images, strict=True)]
    np.testing.assert_allclose(ssim(*images), expected, rtol=1e-10)


def test_identical_images_give_one(images):
    np.testing.assert_allclose(ssim(images[0], images[0]), 1, rtol=1e-12)


def test_ssim_of_constant_images_is_the_luminance_term(x64):
    a, b = jnp.full((90, 360), 0.3), jnp.full((90, 360), 0.8)
    assert float(ssim(a, b)) == pytest.approx((2 * 0.3 * 0.8 + 1e-4) / (0.3**2 + 0.8**2 + 1e-4), rel=1e-10)


def test_single_precision_is_enough(images):
    single = (image.astype(jnp.float32) for image in images)
    np.testing.assert_allclose(ssim(*single), ssim(*images), atol=1e-5)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_the_loss_is_the_weighted_sum_of_the_paper(images, weight):
    a, b = images
    loss, similarity = image_loss(a, b, weight)
    assert float(similarity) == pytest.approx(float(ssim(a, b).mean()))
    expected = (1 - weight) * float(jnp.abs(a - b).mean()) + weight * (1 - float(similarity))
    assert float(loss) == pytest.approx(expected)


def test_the_gradient_of_a_dark_or_perfect_image_is_finite():
    dark, truth = jnp.zeros((1, 90, 360)), jnp.ones((1, 90, 360))
    for predicted in (dark, truth):
        gradient = jax.grad(lambda a: image_loss(a, truth)[0])(predicted)
        assert bool(jnp.isfinite(gradient).all())


def test_the_loss_of_pixels_is_a_mean_error(rng, x64):
    a, b = jnp.asarray(rng.random((3, 20))), jnp.asarray(rng.random((3, 20)))
    assert float(pixel_loss(a, b, "l1")) == pytest.approx(np.abs(a - b).mean())
    assert float(pixel_loss(a, b, "l2")) == pytest.approx(((a - b) ** 2).mean())
