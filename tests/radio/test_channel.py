"""Power, gain, K-factor and delay spread of channels whose answer is known."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.radio import channel
from wbgs_jax.radio.array import SPEED_OF_LIGHT, cbf, pas_directions, planar_array, steering_vector
from wbgs_jax.radio.channel import Paths

k_factor_db, delay_spread_s, correlation = map(jax.jit, (channel.k_factor_db, channel.delay_spread_s, channel.correlation))


def arrivals(amplitudes, lengths):
    amplitude = jnp.asarray(amplitudes, jnp.complex64)
    return Paths(amplitude, jnp.zeros((*amplitude.shape, 3)), jnp.asarray(lengths, jnp.float32))


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
    one, none = arrivals([[1e-6, 0]], [[3, 4]]), arrivals([[0.0, 0.0]], [[3, 4]])
    assert k_factor_db(one) == np.inf and np.isnan(k_factor_db(none)).all()
    assert delay_spread_s(one) == 0 and np.isnan(delay_spread_s(none)).all()
    ahead = jnp.broadcast_to(jnp.array([1.0, 0, 0]), (1, 2, 3))
    assert (channel.angular_spread_deg(one._replace(direction=ahead)) == 0).all()
    assert np.isnan(channel.angular_spread_deg(none)).all()


def test_doppler_shifts_of_several_links_need_vmap(rng):
    """Velocities of two links would be taken for those of their two paths."""
    ways = jnp.asarray(rng.normal(size=(2, 2, 3)), jnp.float32)
    found = arrivals(np.ones((2, 2)), np.ones((2, 2)))._replace(departure=ways, arrival=ways)
    hertz, velocity = jnp.array([1e9, 2e9]), jnp.asarray(rng.normal(size=(2, 3)), jnp.float32)
    unchecked = inspect.unwrap(channel.doppler_hz)
    for name, given in (
        ("frequency_hz", (hertz, velocity[0], velocity[0])),
        ("tx_velocity", (hertz[0], velocity, velocity[0])),
        ("rx_velocity", (hertz[0], velocity[0], velocity)),
    ):
        with pytest.raises(ValueError, match=f"{name} has shape .* use jax.vmap"):
            unchecked(found, *given)
    shifts = jax.vmap(channel.doppler_hz)(found, hertz, velocity, -velocity)
    expected = 2 * np.einsum("b,bkx,bx->bk", hertz, ways, velocity) / SPEED_OF_LIGHT
    np.testing.assert_allclose(shifts, expected, rtol=1e-4, atol=1e-3)


def at_angles(zenith, azimuth):
    """Unit directions."""
    zenith, azimuth = np.broadcast_arrays(zenith, azimuth)
    return jnp.float32(np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], -1))


def spreads_of(power, zenith, azimuth):
    """Azimuth and zenith spread by TR 38.901, annex A, in double precision."""
    means = [np.abs(power @ np.exp(1j * angle)) / power.sum() for angle in (azimuth, zenith)]
    return np.degrees(np.sqrt(-2 * np.log(means)))


def test_vertical_paths_have_azimuth_zero():
    """As in the patterns of antennas; one alone has no spread."""
    for z in (1.0, -1.0):
        overhead = arrivals([1.0], [3.0])._replace(direction=jnp.array([[0.0, 0.0, z]]))
        np.testing.assert_allclose(channel.angular_spread_deg(overhead), 0, atol=0.1)
    amplitude, zenith, azimuth = np.array([1.0, 0.2, 0.1]), np.radians([0.0, 60.0, 80.0]), np.radians([0.0, 20.0, -30.0])
    found = arrivals(amplitude, [3, 4, 5])._replace(direction=at_angles(zenith, azimuth).at[0].set(jnp.array([0.0, 0.0, 1.0])))
    np.testing.assert_allclose(channel.angular_spread_deg(found), spreads_of(amplitude**2, zenith, azimuth), rtol=2e-3)
    slope = jax.grad(lambda direction: channel.angular_spread_deg(found._replace(direction=direction)).sum())(found.direction)
    assert np.isfinite(slope).all()


@pytest.mark.parametrize("gain", [1.0, 1e-15, 1e-17, 1e-20])
def test_spreads_and_gains_do_not_depend_on_the_scale(rng, gain):
    """-300 dB is the power that counts as zero, and squares of -380 dB underflow."""
    amplitude = rng.normal(size=4) + 1j * rng.normal(size=4)
    zenith, azimuth = rng.uniform(0.8, 1.6, 4), rng.uniform(-1, 1, 4)
    found = arrivals(gain * amplitude, [3, 4, 5, 6])._replace(direction=at_angles(zenith, azimuth))
    power = np.abs(amplitude) ** 2
    np.testing.assert_allclose(channel.angular_spread_deg(found), spreads_of(power, zenith, azimuth), rtol=1e-3)
    variance = np.cov(np.array([3, 4, 5, 6]) / SPEED_OF_LIGHT, aweights=power, ddof=0)
    np.testing.assert_allclose(delay_spread_s(found), np.sqrt(variance), rtol=1e-3)
    y = jnp.complex64(gain * amplitude)
    expected = 10 * np.log10(np.abs(amplitude.sum()) ** 2 / 4 / power.mean())
    np.testing.assert_allclose(channel.beamforming_gain_db(y, jnp.abs(y.sum())), expected, atol=1e-3)


@pytest.mark.parametrize("function", [channel.k_factor_db, channel.delay_spread_s, channel.angular_spread_deg])
def test_gradients_of_links_with_a_few_paths_are_finite(function):
    """Also of links with one path, in the same batch."""
    found = arrivals([[1.0, 0.5, 0.0], [1.0, 0.0, 0.0]], [[3, 4, 5], [3, 4, 5]])
    found = found._replace(direction=jnp.broadcast_to(jnp.eye(3), (2, 3, 3)))

    def total(gain, metres, direction):
        values = function(found._replace(amplitude=gain * found.amplitude, length=metres, direction=direction))
        return jnp.sum(jnp.where(jnp.isfinite(values), values, 0))

    for slope in jax.grad(total, (0, 1, 2))(jnp.ones((2, 3)), found.length, found.direction):
        assert np.isfinite(slope).all()


def test_python_numbers_and_lists_are_taken():
    assert float(channel.received_power_db([1e-3 + 0j, 1e-3])) == pytest.approx(-60, abs=1e-4)
    np.testing.assert_allclose(channel.free_space_db([0.0, 10.0], 2.4e9), [np.inf, -60.05], atol=0.01)
    assert channel.free_space_db(0, 2.4e9) == np.inf
    assert float(channel.correlation([1 + 0j, 1j], [1j, -1])) == pytest.approx(1, abs=1e-6)
    paths = arrivals([1.0, 0.5], [3.0, 4.0])
    np.testing.assert_allclose(paths.cfr(0.0), [1.5], atol=1e-6)
    np.testing.assert_array_equal(paths.cfr([0.0, 1e6]), paths.cfr(jnp.array([0.0, 1e6])))


def test_correlation_is_blind_to_phase_and_scale(rng):
    a, b = (rng.normal(size=(5, 16)) + 1j * rng.normal(size=(5, 16)) for _ in "ab")
    a, b = a.astype(np.complex64), b.astype(np.complex64)
    np.testing.assert_allclose(correlation(a, np.complex64(3j) * a), 1, rtol=1e-5)
    expected = np.abs(np.sum(np.conj(a) * b, -1)) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
    np.testing.assert_allclose(correlation(a, b), expected, rtol=1e-4)
    assert (correlation(a, 0 * a) == 0).all()


def test_slopes_of_correlation_are_finite_where_it_is_zero():
    """For a zero snapshot, and for orthogonal ones."""
    one, other = jnp.array([1.0 + 0j, 1j]), jnp.array([1.0 + 0j, -1j])
    for a, b in ((0 * one, one), (one, 0 * one), (one, other)):
        for slope in jax.grad(correlation, (0, 1))(a, b):
            assert np.isfinite(slope).all()
    assert float(correlation(one, other)) < 1e-6  # fused products leave a rounding


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


BAND = 400e6


def link(rng, count=5):
    """Two links of random paths within 100 ns; the second one lacks a path."""
    amplitude = (rng.normal(size=(2, count)) + 1j * rng.normal(size=(2, count))) * 1e-5
    amplitude[1, -1] = 0
    return arrivals(amplitude, rng.uniform(3, 30, (2, count)))


def delays(paths):
    tau = np.asarray(paths.length, np.float64) / SPEED_OF_LIGHT
    return tau - np.min(np.where(np.asarray(paths.amplitude) != 0, tau, np.inf), -1, keepdims=True)


def test_the_impulse_response_has_the_amplitudes_and_delays_of_the_paths(rng):
    paths = link(rng)
    a, tau = paths.cir(normalize_delays=False)
    assert a is paths.amplitude
    np.testing.assert_allclose(tau[0], np.asarray(paths.length[0]) / SPEED_OF_LIGHT, rtol=1e-6)
    assert tau[1, -1] == -1 and (tau[1, :-1] > 0).all()
    _, later = paths.cir()
    np.testing.assert_allclose(later[0], delays(paths)[0], atol=1e-14)
    assert later[0].min() == later[1, :-1].min() == 0 and later[1, -1] == -1
    a, tau = arrivals([0, 0], [3, 4]).cir()
    assert not a.any() and (tau == -1).all()


def test_the_frequency_response_is_the_sum_over_paths(rng):
    paths, offsets = link(rng), np.linspace(-BAND / 2, BAND / 2, 33)
    expected = np.einsum("bk,bkf->bf", paths.amplitude, np.exp(-2j * np.pi * delays(paths)[..., None] * offsets))
    found = jax.jit(Paths.cfr)(paths, jnp.asarray(offsets, jnp.float32))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    later = paths.cfr(jnp.asarray(offsets), normalize_delays=False)
    turns = offsets[None] * np.min(np.asarray(paths.length)[:, :4], -1, keepdims=True) / SPEED_OF_LIGHT
    np.testing.assert_allclose(later[0], (expected * np.exp(-2j * np.pi * turns))[0], atol=1e-8)


def test_taps_are_samples_of_the_band_limited_response(rng):
    """Their Fourier transform is the frequency response within the band; a path between two samples has a slow sinc."""
    paths, index = link(rng), np.arange(-4000, 4001)
    taps = np.asarray(paths.taps(BAND, -4000, 4000))
    offsets = np.linspace(-0.4, 0.4, 9) * BAND
    spectrum = taps @ np.exp(-2j * np.pi * index[:, None] * offsets / BAND)
    np.testing.assert_allclose(spectrum, paths.cfr(jnp.asarray(offsets)), atol=2e-8)
    assert paths.taps(BAND).shape == (2, 6 + 1 + int(np.ceil(BAND * delays(paths)[:, :4].max())) + 6)


def test_a_path_on_a_sample_is_one_tap():
    paths = arrivals([[2.0, 1.0j]], [[3.0, 3.0 + 3 * SPEED_OF_LIGHT / BAND]])
    np.testing.assert_allclose(paths.taps(BAND, -1, 4), [[0, 2, 0, 0, 1j, 0]], atol=1e-5)
    np.testing.assert_allclose(paths.taps(BAND, -1, 4, normalize=True)[0, 1], 2 / np.sqrt(5), rtol=1e-5)


@pytest.mark.heavy
def test_normalised_channels_have_the_energy_of_one_sample(rng):
    paths, offsets = link(rng), jnp.linspace(-BAND / 2, BAND / 2, 64)
    faint = paths._replace(amplitude=paths.amplitude * 1e-20)  # whose squares underflow
    for some in (paths, faint):
        np.testing.assert_allclose(jnp.mean(jnp.abs(some.cfr(offsets, normalize=True)) ** 2, -1), 1, rtol=1e-5)
        np.testing.assert_allclose(jnp.sum(jnp.abs(some.taps(BAND, normalize=True)) ** 2, -1), 1, rtol=1e-5)
    silent = arrivals([[0.0, 0.0]], [[3.0, 4.0]])
    assert not silent.cfr(offsets, normalize=True).any() and not silent.taps(BAND, normalize=True).any()


def test_of_an_empty_list_of_paths_there_is_no_channel():
    """Ray tracers return no paths at all, not padding, where nothing arrives."""
    none = arrivals(np.zeros((2, 0)), np.zeros((2, 0)))
    assert np.isnan(k_factor_db(none)).all() and np.isnan(delay_spread_s(none)).all()
    assert np.isnan(channel.angular_spread_deg(none)).all()
    assert none.cir()[1].shape == (2, 0)
    assert not none.cfr([0.0, 1e6]).any() and not none.taps(1e6).any()


def test_k_factors_of_faint_paths_do_not_underflow():
    np.testing.assert_allclose(k_factor_db(arrivals([[1e-22, 5e-23]], [[3, 4]])), 10 * np.log10(4), atol=1e-4)
