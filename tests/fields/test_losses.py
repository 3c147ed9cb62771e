"""The differentiable SSIM against dm_pix and scikit-image, and the loss against its formula."""

import dm_pix
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from skimage.metrics import structural_similarity

from wbgs_jax.fields import losses
from wbgs_jax.fields.losses import GOOD_MATCH, UNEXPLAINED, log_decorrelation, pixel_loss, snapshot_losses, surprise

ssim, image_loss = jax.jit(losses.ssim, static_argnums=2), jax.jit(losses.image_loss, static_argnums=(2, 3))


@pytest.fixture
def images(rng, x64):
    """Two batches of smooth pictures with noise, in 0..1."""
    a = rng.random((3, 90, 360)).cumsum(-1).cumsum(-2) % 7 / 7
    return jnp.asarray(a), jnp.asarray(np.clip(a + 0.2 * rng.normal(size=a.shape), 0, 1))


def dm_pix_ssim(a, b):
    """dm_pix's defaults (11x11 window, sigma 1.5, valid region) are Wang et al.'s; it wants a channel axis."""
    return dm_pix.ssim(a[..., None], b[..., None], max_val=1.0, filter_size=11, filter_sigma=1.5)


def test_ssim_equals_dm_pix_in_value_and_gradient(rng, images):
    weights = rng.normal(size=3)

    def gradients(function):
        def total(a, b):
            each = function(a, b)
            return weights @ each, each

        return jax.jit(jax.value_and_grad(total, argnums=(0, 1), has_aux=True))(*images)

    ((value, each), gradient), ((expected, expected_each), expected_gradient) = map(gradients, (losses.ssim, dm_pix_ssim))
    np.testing.assert_allclose(each, expected_each, rtol=1e-10)
    assert float(value) == pytest.approx(float(expected), rel=1e-10)
    for got, want in zip(gradient, map(np.asarray, expected_gradient), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-8 * np.abs(want).max())


def test_ssim_equals_scikit_image_with_the_gaussian_window(images):
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    expected = [structural_similarity(np.asarray(a), np.asarray(b), **options) for a, b in zip(*images, strict=True)]
    np.testing.assert_allclose(ssim(*images), expected, rtol=1e-10)


@pytest.mark.parametrize("stride", [2, 3])
def test_a_stride_leaves_out_windows(images, stride):
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0, "full": True}
    for i, (a, b) in enumerate(zip(*images, strict=True)):
        _, everywhere = structural_similarity(np.asarray(a), np.asarray(b), **options)
        windows = everywhere[5:-5, 5:-5]  # those that lie within the picture
        expected = windows[::stride, ::stride].mean()
        assert float(ssim(*images, stride)[i]) == pytest.approx(expected, rel=1e-10)
        assert abs(expected - windows.mean()) > 1e-9


@pytest.mark.parametrize("stride", [1, losses.COARSE])
def test_ssim_of_mixtures_is_that_of_each_mixture(images, rng, stride):
    truth, shares = jnp.asarray(rng.random(images[0].shape)), np.array([0.0, 0.3, 1.0])
    found = jax.jit(losses.ssim_of_mixtures, static_argnames="stride")(*images, truth, jnp.asarray(shares), stride=stride)
    expected = [ssim(share * images[0] + (1 - share) * images[1], truth, stride) for share in shares]
    np.testing.assert_allclose(found.T, expected, rtol=1e-9)


def test_identical_images_give_one(images):
    np.testing.assert_allclose(ssim(images[0], images[0]), 1, rtol=1e-12)


def test_ssim_of_constant_images_is_the_luminance_term(x64):
    a, b = np.full((3, 90, 360), 0.3), np.full((3, 90, 360), 0.8)
    expected = (2 * 0.3 * 0.8 + 1e-4) / (0.3**2 + 0.8**2 + 1e-4)
    np.testing.assert_allclose(ssim(jnp.asarray(a), jnp.asarray(b)), expected, rtol=1e-10)


def test_single_precision_is_enough(images):
    single = (image.astype(jnp.float32) for image in images)
    np.testing.assert_allclose(ssim(*single), ssim(*images), atol=1e-5)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_the_loss_is_the_weighted_sum_of_the_paper(images, weight):
    a, b = images
    loss, similarity = image_loss(a, b, weight)
    assert float(similarity) == pytest.approx(np.asarray(ssim(a, b)).mean())
    expected = (1 - weight) * np.abs(np.asarray(a) - np.asarray(b)).mean() + weight * (1 - float(similarity))
    assert float(loss) == pytest.approx(expected)


def test_the_gradient_of_a_dark_or_perfect_image_is_finite():
    both, truth = np.stack([np.zeros((90, 360)), np.ones((90, 360))]).astype(np.float32), jnp.ones((2, 90, 360))
    gradient = np.asarray(jax.jit(jax.grad(lambda a: losses.image_loss(a, truth)[0]))(both))
    assert np.isfinite(gradient).all() and gradient[0].any()


def test_the_loss_of_pixels_is_a_mean_error(rng, x64):
    a, b = jnp.asarray(rng.random((3, 20))), jnp.asarray(rng.random((3, 20)))
    assert float(pixel_loss(a, b, "l1")) == pytest.approx(np.abs(a - b).mean())
    assert float(pixel_loss(a, b, "l2")) == pytest.approx(((a - b) ** 2).mean())


@pytest.fixture
def snapshots(rng):
    """Complex voltages of 16 elements, and others."""
    return [rng.normal(size=(5, 16)) + 1j * rng.normal(size=(5, 16)) for _ in range(2)]


def squared_correlation(a, b):
    return np.abs(np.sum(a.conj() * b, -1)) ** 2 / np.sum(np.abs(a) ** 2, -1) / np.sum(np.abs(b) ** 2, -1)


def test_snapshot_losses_equal_their_formulas(snapshots, x64):
    predicted, truth = snapshots
    found = jax.jit(snapshot_losses)(jnp.asarray(predicted), jnp.asarray(truth))
    ratio = np.linalg.norm(predicted, axis=-1) / np.linalg.norm(truth, axis=-1)
    expected = np.mean(1 - squared_correlation(predicted, truth)), np.mean(np.log(ratio) ** 2)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_correlation_is_blind_to_phase_and_scale_and_power_to_direction(snapshots, x64):
    truth = jnp.asarray(snapshots[0])
    correlation_loss, power_loss = jax.jit(snapshot_losses)(truth * 0.1j, truth)
    assert float(correlation_loss) == pytest.approx(0, abs=1e-9)
    assert float(power_loss) == pytest.approx(np.log(10) ** 2, rel=1e-6)


def test_log_decorrelation_equals_its_formula_and_no_match_is_perfect(snapshots, x64):
    predicted, truth = snapshots
    decorrelation = jax.jit(log_decorrelation)
    found = decorrelation(jnp.asarray(predicted), jnp.asarray(truth))
    np.testing.assert_allclose(found, np.log(1 - squared_correlation(predicted, truth) + GOOD_MATCH), rtol=1e-9)
    np.testing.assert_allclose(decorrelation(jnp.asarray(3j * truth), jnp.asarray(truth)), np.log(GOOD_MATCH), rtol=1e-9)


def covariances(rng, paths, n=3, elements=16):
    voltages = rng.normal(size=(n, elements, paths)) + 1j * rng.normal(size=(n, elements, paths))
    product = voltages @ voltages.conj().swapaxes(-1, -2)
    return product / np.trace(product, axis1=-2, axis2=-1)[:, None, None]


def test_surprise_is_the_normal_density_of_the_most_likely_scale(snapshots, rng, x64):
    truth, model = snapshots[1], covariances(rng, 5, len(snapshots[1]))
    count = truth.shape[-1]
    noisy = (model + UNEXPLAINED / count * np.eye(count)) / (1 + UNEXPLAINED)

    def minus_log_density(log_scale, y, covariance):
        scaled = np.exp(log_scale) * covariance
        return np.linalg.slogdet(scaled)[1] + (y.conj() @ np.linalg.solve(scaled, y)).real

    def least(y, covariance):
        return minimize_scalar(minus_log_density, (-3, 3), args=(y / np.linalg.norm(y), covariance)).fun

    expected = np.array([least(y, covariance) for y, covariance in zip(truth, noisy, strict=True)])
    constant = 1 - np.log(count)  # of the profile over scales
    np.testing.assert_allclose(jax.jit(surprise)(model, truth), expected / count - constant, rtol=1e-6)


def test_surprise_of_one_sum_of_paths_is_its_log_decorrelation(snapshots, rng, x64):
    predicted, truth = snapshots
    unit = predicted / np.linalg.norm(predicted, axis=-1, keepdims=True)
    found = np.asarray(jax.jit(surprise)(unit[:, :, None] * unit[:, None].conj(), truth))
    share = truth.shape[-1] / (truth.shape[-1] + UNEXPLAINED)
    rest = found - np.log(1 - share * squared_correlation(predicted, truth))
    assert np.ptp(rest) < 1e-9
    grey = np.asarray(jax.jit(surprise)(np.broadcast_to(np.eye(16) / 16 + 0j, (len(truth), 16, 16)), truth))
    np.testing.assert_allclose(grey, 0, atol=1e-9)  # of nothing that is known nothing is surprising


def test_gradients_of_a_prediction_of_nothing_are_finite(snapshots):
    truth = jnp.asarray(snapshots[0], jnp.complex64)

    def total(scale):
        return sum(snapshot_losses(scale * truth, truth)) + jnp.sum(log_decorrelation(scale * truth, truth))

    for scale in (0.0, 1e-20, 1.0):
        assert np.isfinite(jax.jit(jax.grad(total))(scale))


@pytest.mark.heavy
def test_silent_snapshots_cost_nothing_and_break_nothing(rng):
    """As of a transmitter that no wave leaves: its truth is zero."""
    predicted, truth = (rng.normal(size=(2, 6, 2)).astype(np.float32).view(np.complex64)[..., 0] for _ in range(2))
    silent = np.concatenate([truth, 0 * truth])
    both = jnp.asarray(np.concatenate([predicted, predicted]))

    def total(predicted, truth):
        covariance = jnp.eye(6) / 6 + 0 * predicted[:, None, :]
        losses = *snapshot_losses(predicted, truth), log_decorrelation(predicted, truth), surprise(covariance, truth)
        return sum(map(jnp.sum, losses[:2])) * len(truth), losses

    (_, (correlation, power, decorrelation, told)), gradient = jax.value_and_grad(total, has_aux=True)(
        both, jnp.asarray(silent)
    )
    (_, alone), expected = jax.value_and_grad(total, has_aux=True)(both[:2], jnp.asarray(truth))
    np.testing.assert_allclose([2 * correlation, 2 * power], alone[:2], rtol=1e-5)
    np.testing.assert_allclose(decorrelation[:2], alone[2], rtol=1e-5)
    np.testing.assert_allclose(told, np.append(alone[3], [0, 0]), rtol=1e-5)
    np.testing.assert_allclose(gradient[:2], expected, rtol=1e-4, atol=1e-6)
    assert not np.asarray(gradient[2:]).any() and np.isfinite(decorrelation).all()
