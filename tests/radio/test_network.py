"""Links of several transmitters against closed forms, and what is optimised through them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.mirrors import trained
from builders.rooms import METAL, field_of, rectangle

from wbgs_jax.applications.antenna_placement import (
    boresight_quaternion,
    mean_power,
    power_at_users,
    soft_minimum,
    tenth_percentile,
)
from wbgs_jax.radio.antenna import Antenna, pattern_exponents
from wbgs_jax.radio.channel import BOLTZMANN, noise_dbm, sinr_db, throughput_bps
from wbgs_jax.types import Transmitter

HZ = 2.4e9
USERS = np.array([[0.5, 0.3, 1.2], [3.6, 2.1, 1.0], [1.7, -0.8, 1.4], [4.4, 0.4, 1.1]])


def test_the_noise_is_that_of_a_resistor(rng):
    bandwidth, temperature = rng.uniform(1e5, 1e9), rng.uniform(3, 400)
    expected = 10 * np.log10(1.380649e-23 * temperature * bandwidth * 1e3)
    assert float(noise_dbm(bandwidth, 0.0, temperature)) == pytest.approx(expected, abs=1e-4)
    assert float(noise_dbm(bandwidth, 9.0, temperature)) == pytest.approx(expected + 9, abs=1e-4)
    assert pytest.approx(-174, abs=0.05) == float(noise_dbm(1.0, 0.0, 290.0))


def test_sinr_is_the_ratio_of_powers(rng):
    received, load, noise = rng.uniform(-110, -30, (6, 4)), rng.random(4), -95.0
    power = 10 ** (received / 10)
    others = power @ np.diag(load) @ (1 - np.eye(4))
    expected = 10 * np.log10(power / (others + 10 ** (noise / 10)))
    arrays = (jnp.asarray(a, jnp.float32) for a in (received, load))
    (first, second) = arrays
    np.testing.assert_allclose(sinr_db(first, noise, second), expected, atol=1e-3)


@pytest.mark.heavy
def test_equal_transmitters_and_noise_alone_have_closed_forms():
    equal = sinr_db(jnp.full((1, 2), -60.0), -160.0)
    np.testing.assert_allclose(equal, 0, atol=1e-5)  # one interferes with the other
    np.testing.assert_allclose(sinr_db(jnp.full(4, -60.0), -160.0), -10 * np.log10(3), atol=1e-5)
    alone = jnp.array([[-80.0], [-300.0]])
    np.testing.assert_allclose(sinr_db(alone, -90.0)[:, 0], [10, -210], atol=1e-4)
    idle = sinr_db(jnp.array([-80.0, -50.0]), -90.0, jnp.array([1.0, 0.0]))
    assert float(idle[0]) == pytest.approx(10, abs=1e-4)  # the second interferes never


def test_a_faint_interferer_is_not_lost_in_rounding():
    """The sum of both powers is the stronger one in single precision."""
    found = sinr_db(jnp.array([-20.0, -120.0]), -150.0)
    np.testing.assert_allclose(found, [100 - 10 * np.log10(1 + 1e-3), -100], atol=1e-3)


def test_where_nothing_is_received_nothing_is_served():
    found = sinr_db(jnp.array([[-jnp.inf, -jnp.inf], [-60.0, -jnp.inf]]), -60.0)
    np.testing.assert_allclose(found, [[-np.inf, -np.inf], [0, -np.inf]], atol=1e-5)
    np.testing.assert_allclose(throughput_bps(found, 1e6), [[0, 0], [1e6, 0]], rtol=1e-5)


def test_impossible_loads_and_bandwidths_are_refused():
    powers = jnp.array([-60.0, -70.0])
    for load in (-0.1, 1.5, [1.0, np.nan]):
        with pytest.raises(ValueError, match="activities are from 0 to 1"):
            sinr_db(powers, -90.0, load)
    for function in (noise_dbm, lambda hertz: throughput_bps(0, hertz)):
        for hertz in (-1e6, jnp.array([1e6, -1e6])):
            with pytest.raises(ValueError, match="not negative"):
                function(hertz)
        assert np.isfinite(jax.jit(function)(1e6))
    np.testing.assert_array_equal(jax.jit(sinr_db)(powers, -90.0, 1.0), sinr_db(powers, -90.0))


def test_throughput_is_the_bound_of_shannon():
    ratios = np.array([-60.0, 0.0, 30.0])
    found = throughput_bps(jnp.asarray(ratios, jnp.float32), 20e6)
    np.testing.assert_allclose(found, 20e6 * np.log2(1 + 10 ** (ratios / 10)), rtol=1e-5)


def test_lists_of_powers_are_taken():
    powers, arrays = [-60, -90], jnp.array([-60.0, -90.0])
    np.testing.assert_array_equal(sinr_db(powers, -100.0, [1, 0]), sinr_db(arrays, -100.0, jnp.array([1.0, 0.0])))
    np.testing.assert_array_equal(throughput_bps([0, 10], 20e6), throughput_bps(jnp.array([0.0, 10.0]), 20e6))
    assert float(throughput_bps(0, 20e6)) == pytest.approx(20e6)
    for objective in (soft_minimum, mean_power, tenth_percentile):
        np.testing.assert_allclose(objective(powers), objective(arrays), rtol=1e-6)


def worst_tenth(received_dbm):
    """Of the SINR of the best server; transmitters first, users last."""
    return tenth_percentile(jnp.max(sinr_db(received_dbm.T, -90.0), -1))


def rises(objective, start, step):
    """Whether a step along the gradient raises an objective, by about as much as its slope promises."""
    before, slope = jax.value_and_grad(objective)(start)
    size = jnp.linalg.norm(slope)
    gain = float(objective(start + step * slope / size) - before)
    assert gain > 0.3 * step * float(size) > 1e-4
    return gain


@pytest.mark.heavy
def test_a_step_of_powers_and_of_places_raises_the_tenth_percentile():
    """Of a field known in closed form."""
    field, params = trained().field, trained().params
    powers = power_at_users(field, params, USERS, HZ)
    places = jnp.array([[1.0, 0.5, 1.5], [4.0, 1.0, 1.5], [2.5, 2.0, 1.5]])
    rises(lambda dbm: worst_tenth(powers(places, 0.0) + dbm[:, None]), jnp.array([20.0, 10.0, 15.0]), 0.05)
    rises(lambda place: worst_tenth(powers(place, 0.0) + 20.0), places, 0.01)


@pytest.mark.heavy
def test_a_step_of_tilts_raises_the_tenth_percentile():
    """Of sector antennas before a mirror."""
    wall = rectangle((-5, 4, -5), (15, 0, 0), (0, 0, 15))
    settings = {"mirror_areas": (0.0,), "specular_tried": 4, "specular_kept": 4, "diffracted_tried": 0, "diffracted_kept": 0}
    field, params, _ = field_of([wall], (0, 0, 1), conductivity=METAL, **settings)
    powers = power_at_users(field, params, USERS[:2], HZ)
    places = jnp.array([[-1.0, 0.0, 2.5], [6.0, 1.0, 2.5]])
    sector = Antenna(None, jnp.broadcast_to(jnp.asarray(pattern_exponents("tr38901")), (2, 2)))

    def objective(angles):
        antennas = Transmitter(places, jax.vmap(boresight_quaternion)(angles), antenna=sector)
        return worst_tenth(powers(antennas, 0.0) + 20.0)

    rises(objective, jnp.array([[0.3, 0.1], [2.6, 0.2]]), 0.01)


def test_the_constant_is_that_of_the_si():
    assert BOLTZMANN == 1.380649e-23
