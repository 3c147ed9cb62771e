"""One Gaussian, and 200,000: images that are right, gradients that are finite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.equation_six import pixel

from experiments.bench.scene import random_gaussians
from wbgs_jax.splat import geometry_plan, measure_limits, project, render_dense, render_splats
from wbgs_jax.types import Gaussians, make_receiver

MANY = 200_000
RECEIVER = make_receiver([0.0, 0.0, 0.0])


def drawn(rng, n):
    return random_gaussians(rng, n), *(jnp.asarray(rng.uniform(0, 0.6, (n, 1)), jnp.float32) for _ in range(2))


def image_and_gradients(gaussians, attenuation, signal):
    limits = measure_limits(project(gaussians, RECEIVER), 1.05)

    @jax.jit
    def total(gaussians, attenuation, signal):
        image = render_splats(geometry_plan(gaussians, RECEIVER, limits), attenuation, signal)
        return jnp.sum(image), image

    (_, image), gradients = jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True)(gaussians, attenuation, signal)
    return np.asarray(image), jax.tree.map(np.asarray, gradients)


@pytest.mark.heavy
def test_one_gaussian(rng):
    gaussians, attenuation, signal = drawn(rng, 1)
    image, gradients = image_and_gradients(gaussians, attenuation, signal)
    splats = project(gaussians, RECEIVER)
    expected = np.asarray(render_dense(splats, attenuation, signal))
    np.testing.assert_allclose(image, expected, atol=1e-5)
    of_each = np.asarray(attenuation)[:, 0], np.asarray(signal)[:, 0]
    _, *brightest = np.unravel_index(np.argmax(image), image.shape)
    assert image.max() == pytest.approx(pixel(jax.tree.map(np.asarray, splats), *of_each, *brightest), rel=1e-3)
    assert 0 < image.max() <= float(attenuation[0, 0] * signal[0, 0]) * (1 + 1e-6)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))


@pytest.mark.slow
def test_two_hundred_thousand_gaussians(rng):
    """Pixels agree with equation 6, written out; the order of what is equally far to rounding is nobody's."""
    gaussians, attenuation, signal = drawn(rng, MANY)
    image, gradients = image_and_gradients(gaussians, attenuation, signal)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    assert np.isfinite(image).all() and image.min() >= 0 and image.max() <= 0.6
    splats = jax.tree.map(np.asarray, project(gaussians, RECEIVER))
    rows, columns = rng.integers(0, 90, 60), rng.integers(0, 360, 60)
    of_each = np.asarray(attenuation)[:, 0], np.asarray(signal)[:, 0]
    expected = [pixel(splats, *of_each, *place) for place in zip(rows, columns, strict=True)]
    np.testing.assert_allclose(image[0, rows, columns], expected, atol=1e-3)


@pytest.mark.slow
def test_two_hundred_thousand_of_which_most_are_transparent(rng):
    """A few hundred among transparent ones show what they show by themselves, by the dense reference."""
    gaussians, attenuation, signal = drawn(rng, MANY)
    seen = np.sort(rng.choice(MANY, 300, replace=False))
    faint = jnp.zeros_like(attenuation).at[seen].set(attenuation[seen])
    image, _ = image_and_gradients(gaussians, faint, signal)
    alone = Gaussians(*(leaf[seen] for leaf in jax.tree.leaves(gaussians)))
    expected = np.asarray(render_dense(project(alone, RECEIVER), attenuation[seen], signal[seen]))
    np.testing.assert_allclose(image, expected, atol=2e-5)
