"""Power, gain, K-factor and delay spread of channels whose answer is known."""

import jax
import jax.numpy as jnp
import numpy as np

from wbgs_jax.radio import channel
from wbgs_jax.radio.array import SPEED_OF_LIGHT, cbf, pas_directions, planar_array, steering_vector
from wbgs_jax.radio.channel import Arrivals

k_factor_db, delay_spread_s, correlation = map(jax.jit, (channel.k_factor_db, channel.delay_spread_s, channel.correlation))


def arrivals(amplitudes, lengths):
    amplitude = jnp.asarray(amplitudes, jnp.complex64)
    return Arrivals(amplitude, jnp.zeros((*amplitude.shape, 3)), jnp.asarray(lengths, jnp.float32))


def test_a_plane_wave_has_its_power_and_the_full_gain():
    elements = jnp.asarray(planar_array(), jnp.float32)
    directions = jnp.asarray(pas_directions(), jnp.float32)
    y = 1e-3 * steering_vector(elements, directions[40, 200])
    peak = jnp.max(cbf(y, steering_vector(elements, directions)))
    np.testing.assert_allclose(channel.received_power_db(y), -60, atol=1e-4)
    np.testing.assert_allclose(channel.beamforming_gain_db(y, peak), 10 * np.log10(16), atol=1e-3)


def test_two_paths():
    found = arrivals([[1.0, 0.5j]], [[3.0, 3.0 + SPEED_OF_LIGHT * 10e-9]])
    np.testing.assert_allclose(k_factor_db(found), 10 * np.log10(4), atol=1e-4)
    share = 0.2  # of the power, in the second path
    np.testing.assert_allclose(delay_spread_s(found), 10e-9 * np.sqrt(share * (1 - share)), rtol=1e-3)


def test_one_path_and_none():
    assert k_factor_db(arrivals([[1e-6, 0]], [[3, 4]])) > 150
    assert delay_spread_s(arrivals([[0.0, 0.0]], [[3, 4]])) == 0
    np.testing.assert_array_equal(channel.angular_spread_deg(arrivals([0.0, 0.0], [3, 4])), 0)


def test_correlation_is_blind_to_phase_and_scale(rng):
    a, b = (rng.normal(size=(5, 16)) + 1j * rng.normal(size=(5, 16)) for _ in "ab")
    a, b = a.astype(np.complex64), b.astype(np.complex64)
    np.testing.assert_allclose(correlation(a, np.complex64(3j) * a), 1, rtol=1e-5)
    expected = np.abs(np.sum(np.conj(a) * b, -1)) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
    np.testing.assert_allclose(correlation(a, b), expected, rtol=1e-4)
    assert (correlation(a, 0 * a) == 0).all()


def test_angles_of_two_paths_spread_by_their_separation():
    """Equal powers at +-a around a direction: sqrt(-2 ln cos a), about a where it is small; TR 38.901, annex A."""
    apart, zenith = np.radians([5.0, 50.0]), np.radians(60.0)
    for a in apart:
        azimuth = np.array([1.0 - a, 1.0 + a])
        direction = np.stack(
            [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.full(2, np.cos(zenith))], -1
        )
        found = arrivals([1.0, 1.0j], [3.0, 4.0])._replace(direction=jnp.asarray(direction, jnp.float32))
        spread = channel.angular_spread_deg(found)
        np.testing.assert_allclose(spread[0], np.degrees(np.sqrt(-2 * np.log(np.cos(a)))), rtol=1e-3)
        assert spread[1] < 0.1
    assert abs(np.degrees(np.sqrt(-2 * np.log(np.cos(apart[0])))) - 5) < 0.05
