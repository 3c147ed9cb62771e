"""Antennas against closed forms: the patterns' own, and what turning an antenna does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wbgs_jax.radio.antenna import Antenna, dipole_gain, element_gain, pattern_exponents, upright, zenith_vector


def directions(rng, n=50):
    k = rng.normal(size=(n, 3))
    return (k / np.linalg.norm(k, axis=-1, keepdims=True)).astype(np.float32)


def wxyz(rotation):
    return jnp.asarray(np.roll(rotation.as_quat(), 1), jnp.float32)


def test_the_directional_element_has_8_dbi_and_falls_by_3_db_at_half_of_65_degrees():
    angle = np.radians(65 / 2)
    k = jnp.array([[1, 0, 0], [np.cos(angle), np.sin(angle), 0], [np.cos(angle), 0, np.sin(angle)], [-1, 0, 0]])
    np.testing.assert_allclose(20 * np.log10(element_gain(k)), [8, 5, 5, -22], atol=1e-4)


def test_a_short_dipole_radiates_what_it_is_given(rng):
    """Its gain, averaged over the sphere, is one; its largest is 1.76 dBi, across its axis."""
    zenith = (np.arange(20_000) + 0.5) / 20_000 * np.pi
    k = np.stack([np.sin(zenith), np.zeros_like(zenith), np.cos(zenith)], -1)
    assert np.average(np.asarray(dipole_gain(jnp.asarray(k))) ** 2, weights=np.sin(zenith)) == pytest.approx(1, rel=1e-4)
    assert 20 * np.log10(dipole_gain(jnp.array([0.6, 0.8, 0.0]))) == pytest.approx(1.7609, abs=1e-3)


def test_an_upright_isotropic_antenna_is_vertical_polarisation_alone(rng):
    k = jnp.asarray(directions(rng))
    np.testing.assert_allclose(upright(jnp.zeros(2)).field(k), zenith_vector(k), atol=1e-6)


def test_several_antennas_need_vmap(rng):
    """The exponents of two antennas would be taken for those of one."""
    both, k = Antenna(None, jnp.array([[1.0, 0.0], [0.0, 1.0]])), jnp.asarray(directions(rng))
    for gains in (both.field, both.parametric_gain):
        with pytest.raises(ValueError, match=r"shape \(2, 2\); use jax.vmap for several antennas"):
            gains(k)
    found = jax.vmap(lambda one: one.parametric_gain(k))(both)
    np.testing.assert_allclose(found, [element_gain(k), dipole_gain(k)], rtol=1e-5)


@pytest.mark.parametrize("pattern", ["iso", "tr38901", "dipole"])
def test_a_turned_antenna_seen_from_a_turned_direction_is_itself_turned(pattern, rng):
    turn, k = Rotation.from_quat(rng.normal(size=4)), directions(rng)
    exponents = jnp.array(pattern_exponents(pattern))
    scale = rng.uniform(0.3, 3)  # of the quaternion, which means nothing
    turned = Antenna(scale * wxyz(turn), exponents).field(jnp.asarray(turn.apply(k), jnp.float32))
    np.testing.assert_allclose(turned, turn.apply(upright(exponents).field(jnp.asarray(k))), atol=2e-4)


def test_the_field_is_across_the_ray_and_as_large_as_the_gain(rng):
    turn, k = Rotation.from_quat(rng.normal(size=4)), jnp.asarray(directions(rng))
    field = np.asarray(Antenna(wxyz(turn), jnp.array([1.0, 0.0])).field(k))
    np.testing.assert_allclose(np.sum(field * k, -1), 0, atol=1e-5)
    gain = element_gain(jnp.asarray(turn.inv().apply(k), jnp.float32))
    np.testing.assert_allclose(np.linalg.norm(field, axis=-1), gain, rtol=1e-3)


def test_a_half_wave_dipole_is_nearly_a_power_of_the_short_one():
    zenith = np.radians(np.linspace(1, 90, 200))
    exact = np.sqrt(1.643) * np.cos(np.pi / 2 * np.cos(zenith)) / np.sin(zenith)
    k = jnp.asarray(np.stack([np.sin(zenith), np.zeros_like(zenith), np.cos(zenith)], -1))
    field = upright(jnp.array(pattern_exponents("hw_dipole"))).field(k)
    error_db = 20 * np.log10(np.linalg.norm(field, axis=-1) / exact)
    assert np.abs(error_db[20 * np.log10(exact) > -10]).max() < 0.45


@pytest.mark.parametrize("exponents", [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.3, 0.4)])
def test_straight_up_and_down_antennas_have_gradients(exponents):
    """A transmitter straight above a receiver must not end a training."""

    def strength(orientation, exponents, k):
        field = Antenna(orientation, exponents).field(k)
        return jnp.sum(field * jnp.array([0.3, -0.2, 0.7]))

    for height in (1.0, -1.0):
        k = jnp.array([0.0, 0.0, height])
        given = jnp.array([1.0, 0, 0, 0]), jnp.array(exponents), k
        for gradient in jax.grad(strength, argnums=(0, 1, 2))(*given):
            assert np.isfinite(gradient).all()
    beside = jnp.array([1e-4, 0.0, 1.0])
    np.testing.assert_allclose(element_gain(beside), element_gain(jnp.array([0.0, 0.0, 1.0])), rtol=1e-3)


@pytest.mark.parametrize("angle", [np.pi / 4, -np.pi / 4, np.pi / 2])
def test_a_slanted_antenna_has_both_components(angle, rng):
    """As in 3GPP TR 38.901, 7.3.2, model 2; its gain is that of the antenna."""
    k, exponents = jnp.asarray(directions(rng)), jnp.array([0.7, 0.3])
    upright_field = np.asarray(upright(exponents).field(k))
    slanted = np.asarray(Antenna(None, exponents, slant=jnp.float32(angle)).field(k))
    gain, theta = np.linalg.norm(upright_field, axis=-1), np.asarray(zenith_vector(k))
    np.testing.assert_allclose(np.sum(slanted * theta, -1), np.cos(angle) * gain, atol=1e-5)
    np.testing.assert_allclose(np.sum(slanted * np.cross(k, theta), -1), np.sin(angle) * gain, atol=1e-5)
    np.testing.assert_allclose(np.sum(slanted * k, -1), 0, atol=1e-5)
