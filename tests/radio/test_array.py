"""The array model against closed forms and a plain loop."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.data import load_dataset
from wbgs_jax.radio import array
from wbgs_jax.radio.array import (
    PAS_SHAPE,
    covariance_to_pas,
    lag_basis,
    make_lag_basis,
    normalise,
    pas_directions,
    planar_array,
    wide_covariance_to_pas,
)
from wbgs_jax.types import make_receiver

ELEMENTS = jnp.asarray(planar_array(), jnp.float32)
snapshot_to_pas, steering_vector, cbf, array_response = map(
    jax.jit, (array.snapshot_to_pas, array.steering_vector, array.cbf, array.array_response)
)


@pytest.fixture(scope="module")
def basis():
    """Of all squared spectra of the 4x4 array."""
    return lag_basis(planar_array())


def random_snapshots(rng, *shape):
    return jnp.asarray(rng.normal(size=shape) + 1j * rng.normal(size=shape), jnp.complex64)


def test_pas_grid_is_zenith_by_azimuth_with_both_ends():
    k = pas_directions()
    assert k.shape == (*PAS_SHAPE, 3)
    np.testing.assert_allclose(np.linalg.norm(k, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(k[0], np.broadcast_to([0, 0, 1], (360, 3)), atol=1e-12)  # row 0 is the zenith
    np.testing.assert_allclose(k[89, 0], [-1, 0, 0], atol=1e-12)  # the first column is -180 degrees
    np.testing.assert_allclose(k[:, 0], k[:, -1], atol=1e-12)


def test_elements_lie_half_a_wavelength_apart_around_the_origin():
    p = planar_array()
    assert p.shape == (16, 3)
    np.testing.assert_allclose(p.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(p[:, 0], 0)
    gaps = np.linalg.norm(p[:, None] - p, axis=-1)
    assert gaps[gaps > 0].min() == 0.5


def test_element_order_is_that_of_the_ray_tracer(shared_data):
    with np.load(shared_data("box_room") / "snapshots.npz") as archive:
        np.testing.assert_allclose(planar_array(), archive["element_positions"], atol=1e-6)


def test_snapshot_to_pas_equals_the_formula_written_as_a_loop(rng):
    elements = planar_array()
    y = random_snapshots(rng, 3, 16)
    pas, y = np.asarray(snapshot_to_pas(y, ELEMENTS))[1], y[1]
    expected = np.zeros(PAS_SHAPE)
    rows, columns = np.linspace(0, np.pi / 2, 90), np.linspace(-np.pi, np.pi, 360)
    for i, t in enumerate(rows):
        for j, p in enumerate(columns):
            k = np.array([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)])
            a = np.exp(2j * np.pi * (elements @ k))
            expected[i, j] = abs(np.vdot(a, np.asarray(y, complex)))
    np.testing.assert_allclose(pas, expected / expected.max(), atol=2e-6)


def test_a_plane_wave_peaks_where_it_comes_from(rng):
    row, column = rng.integers(5, 85), rng.integers(0, 359)
    k = pas_directions()[row, column]
    waves = steering_vector(ELEMENTS, jnp.asarray([k] * 3, jnp.float32))
    pas = np.asarray(snapshot_to_pas(waves, ELEMENTS))[0]
    assert pas[row, column] == pytest.approx(1, abs=1e-5)
    # Closed form: the product of the array factors of four elements half a wavelength apart along y and along z.
    u = np.pi / 2 * (pas_directions() - k)[..., 1:]
    small = np.abs(np.sin(u)) < 1e-9  # the main lobe and its alias
    factor = np.where(small, 1, np.abs(np.sin(4 * u) / (4 * np.where(small, 1, np.sin(u)))))
    np.testing.assert_allclose(pas, factor.prod(-1), atol=1e-5)


def test_array_cannot_tell_front_from_back(rng):
    k = rng.normal(size=(5, 3))
    k /= np.linalg.norm(k, axis=-1, keepdims=True)
    front, back = (np.asarray(steering_vector(ELEMENTS, jnp.asarray(d, jnp.float32))) for d in (k, k * [-1, 1, 1]))
    np.testing.assert_allclose(front, back, atol=1e-6)


def test_every_squared_pas_lies_in_49_dimensions(rng, basis):
    assert basis.shape == (90 * 360, 49)
    np.testing.assert_allclose(basis.T @ basis, np.eye(49), atol=1e-9)
    squared = np.asarray(snapshot_to_pas(random_snapshots(rng, 3, 16), ELEMENTS)).astype(np.float64).reshape(3, -1) ** 2
    residual = squared - squared @ basis @ basis.T
    assert np.linalg.norm(residual) < 1e-5 * np.linalg.norm(squared)
    foreign = rng.random((4, 90 * 360))  # the space is small: an image that is no PAS does not lie in it
    assert np.linalg.norm(foreign - foreign @ basis @ basis.T) > 0.3 * np.linalg.norm(foreign)


def test_published_images_lie_in_that_space_up_to_8_bit_rounding(shared_data, basis):
    observed = load_dataset(shared_data("wideband3dgs_example1")).observations["pas"]
    images = observed[::25].astype(np.float64).reshape(20, -1) / 255
    residual = images**2 - images**2 @ basis @ basis.T
    assert np.median(np.linalg.norm(residual, axis=1) / np.linalg.norm(images**2, axis=1)) < 0.005


def test_scale_and_global_phase_do_not_matter(rng):
    y = random_snapshots(rng, 3, 16)
    pas = np.asarray(snapshot_to_pas(y, ELEMENTS))
    assert pas.dtype == np.float32
    np.testing.assert_allclose(pas.max((1, 2)), 1, atol=1e-6)
    np.testing.assert_allclose(np.asarray(snapshot_to_pas(y * jnp.complex64(3e-7 * np.exp(1j)), ELEMENTS)), pas, atol=1e-5)


def test_first_and_last_column_are_the_same_direction(rng):
    pas = np.asarray(snapshot_to_pas(random_snapshots(rng, 3, 16), ELEMENTS))
    np.testing.assert_allclose(pas[..., 0], pas[..., -1], atol=1e-6)


def test_zero_snapshot_gives_zero_pas():
    pas = np.asarray(snapshot_to_pas(jnp.zeros((3, 16), jnp.complex64), ELEMENTS))
    assert pas.shape == (3, *PAS_SHAPE)
    np.testing.assert_array_equal(pas, 0)
    np.testing.assert_array_equal(np.asarray(normalise(jnp.zeros((1, *PAS_SHAPE)))), 0)


def test_cbf_takes_any_batch_shapes(rng):
    y, a = random_snapshots(rng, 2, 3, 16), random_snapshots(rng, 5, 16)
    expected = np.abs(np.einsum("bcn,mn->bcm", np.asarray(y), np.asarray(a).conj()))
    np.testing.assert_allclose(np.asarray(cbf(y, a)), expected, rtol=1e-5)


def test_the_response_of_an_array_in_two_directions_is_its_beam_there(rng):
    """Also where every second direction has an array of its own, as those of fixed size have one a frequency."""
    u, v = (jnp.asarray(k / np.linalg.norm(k, axis=-1, keepdims=True), jnp.float32) for k in rng.normal(size=(2, 4, 3)))
    scale = rng.uniform(0.5, 3, 4)
    own = jnp.asarray(scale[:, None, None] * planar_array(), jnp.float32)
    expected, expected_own = np.zeros((4, 4)), np.zeros((4, 4))
    for j in range(4):
        phases = 2 * np.pi * (np.asarray(u, float) - np.asarray(v[j], float)) @ planar_array().T
        expected[:, j] = np.abs(np.exp(1j * phases).mean(-1))
        expected_own[:, j] = np.abs(np.exp(1j * scale[j] * phases).mean(-1))
    np.testing.assert_allclose(array_response(ELEMENTS, u, v), expected, atol=1e-5)
    np.testing.assert_allclose(array_response(ELEMENTS, u, v, steering_vector(ELEMENTS, u)), expected, atol=1e-5)
    np.testing.assert_allclose(array_response(own, u, v), expected_own, atol=1e-5)


def test_an_array_in_metres_has_more_wavelengths_at_higher_frequencies(rng):
    elements, frequency = rng.normal(size=(5, 3)), rng.uniform(1e9, 9e10, 3)
    metres, wavelengths = (make_receiver((0, 0, 0), element_positions=elements, unit=u) for u in ("metres", "wavelengths"))
    expected = elements * (frequency / 299_792_458.0)[:, None, None]
    np.testing.assert_allclose(metres.element_wavelengths(jnp.asarray(frequency)), expected, rtol=1e-5)
    np.testing.assert_array_equal(wavelengths.element_wavelengths(jnp.asarray(frequency)), elements.astype(np.float32))


def test_spectra_of_arrays_of_their_own(rng):
    y, scale = random_snapshots(rng, 3, 16), rng.uniform(0.5, 2, 3)
    own = jnp.asarray(scale[:, None, None] * planar_array(), jnp.float32)
    for i in range(3):
        alone = snapshot_to_pas(jnp.tile(y[i], (3, 1)), own[i])[0]
        np.testing.assert_allclose(snapshot_to_pas(y, own)[i], alone, atol=1e-5)


def test_the_spectrum_of_a_snapshots_own_product_is_its_own(rng):
    positions = planar_array()
    y = rng.normal(size=(3, 16)) + 1j * rng.normal(size=(3, 16))
    y = jnp.asarray(y / np.linalg.norm(y, axis=-1, keepdims=True), jnp.complex64)
    covariance, truth = y[:, :, None] * y[:, None].conj(), snapshot_to_pas(y, jnp.asarray(positions))
    np.testing.assert_allclose(covariance_to_pas(covariance, make_lag_basis(positions)), truth, atol=2e-3)
    everywhere = jnp.broadcast_to(jnp.asarray(positions, jnp.float32), (3, 16, 3))
    np.testing.assert_allclose(wide_covariance_to_pas(covariance, everywhere), truth, atol=2e-3)


@pytest.mark.parametrize("spacing", [0.5, 0.45, 0.7])
def test_lags_of_a_regular_array_are_counted_once(spacing):
    positions = np.asarray(jnp.asarray(planar_array(8, 8, spacing), jnp.float32))
    assert make_lag_basis(positions).basis.shape[1] == 2 * ((2 * 8 - 1) ** 2 // 2 + 1)


def test_beams_of_any_array_add_the_powers_of_what_is_not_coherent(rng):
    """An irregular array: the mean power of independent waves from two directions is the sum of their powers."""
    positions = rng.normal(size=(5, 3))
    directions = np.array([[1.0, 0, 0], [0, 0.6, 0.8]])
    steering = np.exp(2j * np.pi * directions @ positions.T)
    covariance = np.einsum("pe,pf->ef", steering * [[0.14], [0.06]], steering.conj())
    grid = np.exp(2j * np.pi * pas_directions() @ positions.T)
    power = sum(share * np.abs(grid.conj() @ one) ** 2 for share, one in zip((0.14, 0.06), steering, strict=True))
    found = covariance_to_pas(jnp.asarray(covariance, jnp.complex64), make_lag_basis(positions))
    np.testing.assert_allclose(found, np.sqrt(power / power.max()), atol=2e-3)


def test_a_regular_array_has_few_lags():
    assert make_lag_basis(planar_array()).basis.shape == (90 * 360, 2 * 25)  # 49 differences, opposite ones alike


def test_of_nothing_there_is_nothing_to_see():
    nothing = jnp.zeros((1, 16, 16), jnp.complex64)
    assert not np.any(covariance_to_pas(nothing, make_lag_basis(planar_array())))
    assert not np.any(wide_covariance_to_pas(nothing, jnp.asarray(planar_array(), jnp.float32)[None]))
    slope = jax.grad(lambda r: jnp.sum(covariance_to_pas(r * (1 + 0j), make_lag_basis(planar_array()))))(nothing.real)
    assert np.isfinite(slope).all()


def test_positions_keep_their_fractions_beside_whole_numbers():
    """A snapshot of integers, or of half precision, does not round the positions of the elements to its own type."""
    elements = planar_array()
    expected, unchecked = snapshot_to_pas(jnp.ones(16, jnp.complex64), elements), inspect.unwrap(snapshot_to_pas)
    for dtype in (np.int32, jnp.bfloat16):
        np.testing.assert_allclose(unchecked(jnp.ones(16, dtype), elements), expected, atol=1e-5)


def test_of_no_spectra_there_are_no_errors():
    none = np.zeros((0, 90, 360))
    assert array.peak_direction_error(none, none, planar_array()).shape == (0,)
