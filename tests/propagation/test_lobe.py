"""A small plate does not mirror, it spreads: the lobe of a strip against the analytic aperture."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.rooms import METAL, SPEED_OF_LIGHT, arrivals_of, box, search_of, slabs_of, trace
from scipy.special import fresnel

from wbgs_jax.types import make_receiver

DISTANCE = 10.0


def aperture(tx_y, half_width, wavelength):
    """Amplitude behind a long strip relative to an endless mirror's (Kirchhoff: the difference of two Fresnel integrals)."""
    scale = np.sqrt(2 * 2 * DISTANCE / (wavelength * DISTANCE**2))
    (s1, c1), (s2, c2) = (fresnel(scale * (edge - tx_y / 2)) for edge in (-half_width, half_width))
    return np.hypot(c2 - c1, s2 - s1) / np.sqrt(2)


@jax.jit
def channels(search, slabs, receiver, frequency, tx):
    return jax.lax.map(lambda one: arrivals_of(search, trace(search, one), slabs, receiver, frequency), tx)


@pytest.mark.heavy
@pytest.mark.parametrize("wavelengths", [8.0, 15.0])
def test_the_lobe_of_a_strip_is_that_of_its_aperture(wavelengths):
    """Half-power width within 3 %, and the pattern itself within 4 % of its maximum, first side lobe included."""
    frequency = 10e9
    wavelength = SPEED_OF_LIGHT / frequency
    half = wavelengths * wavelength / 2
    strip = box((-0.05, -half, -30), (0.0, half, 30))
    null = DISTANCE * wavelength / (2 * half)  # of the transmitter's position, the first
    tx_y = np.linspace(0.02, 1.9 * null, 60)
    receiver = make_receiver((DISTANCE, 0.0, 0.0))
    search = search_of([strip], receiver.position, mirror_areas=(0.0,))
    tx = np.stack([np.full(60, DISTANCE), tx_y, np.zeros(60)], -1)
    found = channels(search, slabs_of(search, frequency, conductivity=METAL), receiver, jnp.float32(frequency), tx)
    echo = np.abs(np.asarray(jnp.sum(jnp.where(found.length > DISTANCE, found.amplitude, 0), -1)))
    endless = wavelength / (4 * np.pi * np.hypot(2 * DISTANCE, tx_y))
    expected = aperture(tx_y, half, wavelength)
    assert np.abs(echo / endless - expected).max() < 0.04 * expected.max()
    assert half_power(tx_y, echo / endless) == pytest.approx(half_power(tx_y, expected), rel=0.03)


def half_power(y, amplitude):
    """Where the power has fallen to a half of what it is in the middle."""
    below = int(np.argmax(amplitude < amplitude[0] / np.sqrt(2)))
    return np.interp(-amplitude[0] / np.sqrt(2), -amplitude[below - 1 : below + 1], y[below - 1 : below + 1])
