"""Rotations against SciPy; directions, angles and pixels there and back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wbgs_jax.radio import geometry
from wbgs_jax.radio.array import pas_directions

rotation_matrix, to_local, covariance_factor, direction_to_angles, angles_to_direction = map(
    jax.jit,
    (
        geometry.rotation_matrix,
        geometry.to_local,
        geometry.covariance_factor,
        geometry.direction_to_angles,
        geometry.angles_to_direction,
    ),
)
angles_to_pixel = jax.jit(geometry.angles_to_pixel, static_argnames="projection")

TIGHT = {"rtol": 1e-12, "atol": 1e-12}


def pixel_to_angles(pixels, projection="hemisphere"):
    """Returns azimuth and zenith (radians) of pixel coordinates."""
    sx, sy = geometry.pixels_per_radian(projection)
    return pixels[..., 0] / sx - jnp.pi, pixels[..., 1] / sy


def scipy_rotation(quats) -> Rotation:
    return Rotation.from_quat(np.asarray(quats), scalar_first=True)


def test_rotations_equal_scipys_for_quaternions_of_any_length(rng, x64):
    quats = rng.normal(size=(5, 7, 4)) * rng.uniform(0.01, 100, (5, 7, 1))
    expected = scipy_rotation(quats.reshape(-1, 4)).as_matrix().reshape(5, 7, 3, 3)
    np.testing.assert_allclose(rotation_matrix(jnp.asarray(quats)), expected, **TIGHT)


def test_to_local_undoes_the_orientation(rng, x64):
    quat, local = rng.normal(size=4), rng.normal(size=(6, 3))
    world = scipy_rotation(quat).apply(local)
    np.testing.assert_allclose(to_local(jnp.asarray(world), jnp.asarray(quat)), local, **TIGHT)


def test_covariances_have_their_own_axes_and_standard_deviations(rng, x64):
    log_scales, quats = rng.normal(size=(9, 3)), rng.normal(size=(9, 4))
    factor = np.asarray(covariance_factor(jnp.asarray(log_scales), jnp.asarray(quats)))
    axes = scipy_rotation(quats).as_matrix()
    expected = np.einsum("nij,nj,nkj->nik", axes, np.exp(2 * log_scales), axes)
    np.testing.assert_allclose(factor @ factor.swapaxes(-1, -2), expected, **TIGHT)


def test_angles_of_directions_by_hand():
    directions = jnp.array([[1.0, 0, 0], [0, 2, 0], [-3, 0, 0], [0, -1, 0], [0, 0, 5], [1, 1, 2**0.5], [0, 1, -1]])
    azimuth, zenith = direction_to_angles(directions)
    np.testing.assert_allclose(np.rad2deg(azimuth), [0, 90, 180, -90, 0, 45, 90], atol=1e-4)
    np.testing.assert_allclose(np.rad2deg(zenith), [90, 90, 90, 90, 0, 45, 135], atol=1e-4)


def test_directions_to_angles_and_back(rng, x64):
    vectors = rng.normal(size=(50, 3))
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    np.testing.assert_allclose(angles_to_direction(*direction_to_angles(jnp.asarray(vectors))), unit, **TIGHT)


@pytest.mark.parametrize("projection", ["hemisphere", "sphere"])
def test_angles_to_pixels_and_back(rng, x64, projection):
    pixels = jnp.asarray(rng.uniform(0, [359, 89], (40, 2)))
    np.testing.assert_allclose(
        angles_to_pixel(*pixel_to_angles(pixels, projection=projection), projection=projection), pixels, **TIGHT
    )


def test_pixel_centres_are_the_directions_of_the_pas(x64):
    y, x = np.mgrid[0:90, 0:360].astype(float)
    azimuth, zenith = pixel_to_angles(jnp.stack([jnp.asarray(x), jnp.asarray(y)], -1))
    np.testing.assert_allclose(angles_to_direction(azimuth, zenith), pas_directions(), **TIGHT)


@pytest.mark.parametrize(("projection", "last_row"), [("hemisphere", 90), ("sphere", 180)])
def test_the_rows_span_the_zenith_range(projection, last_row):
    azimuth, zenith = pixel_to_angles(jnp.array([[0.0, 0.0], [359.0, 89.0], [179.5, 44.5]]), projection=projection)
    np.testing.assert_allclose(np.rad2deg(azimuth), [-180, 180, 0], atol=1e-3)
    np.testing.assert_allclose(np.rad2deg(zenith), [0, last_row, last_row / 2], atol=1e-3)


def test_quaternions_of_rotation_vectors(rng):
    vectors = np.concatenate([rng.normal(0, 1.5, (8, 3)), np.zeros((1, 3)), rng.normal(0, 1e-5, (1, 3))])
    found = geometry.rotation_matrix(geometry.rotation_quaternion(jnp.asarray(vectors, jnp.float32)))
    np.testing.assert_allclose(found, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-6)
    np.testing.assert_array_equal(found[8], np.eye(3))
    slope = jax.grad(lambda v: geometry.rotation_quaternion(v)[1])(jnp.zeros(3))
    np.testing.assert_allclose(slope, [0.5, 0, 0], atol=1e-6)
