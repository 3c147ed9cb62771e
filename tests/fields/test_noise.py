"""Noise of snapshots: what it does to spectra, against draws of it; and how much there is, from what a field leaves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.fields.noise import LEAST, floor_of, noise_share, unexplained, with_noise
from wbgs_jax.radio.array import pas_directions, planar_array, snapshot_to_pas, steering_vector

ARRAY = planar_array(4, 4, 0.5)
COUNT = len(ARRAY)


def waves(rng, n, paths=3):
    """Snapshots of a few plane waves each, by their definition."""
    directions = rng.normal(size=(n, paths, 3))
    directions[..., 2] = np.abs(directions[..., 2])
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    amplitudes = rng.normal(size=(n, paths)) + 1j * rng.normal(size=(n, paths))
    return np.einsum("np,npe->ne", amplitudes, np.exp(2j * np.pi * np.einsum("npk,ek->npe", directions, np.asarray(ARRAY))))


def noise(rng, snapshots, share, draws=1):
    """White noise that has this share of the power of every snapshot together with it."""
    power = np.mean(np.abs(snapshots) ** 2, -1, keepdims=True) * share / (1 - share)
    drawn = rng.normal(size=(2, draws, *snapshots.shape))
    return np.sqrt(power / 2) * (drawn[0] + 1j * drawn[1])


def test_the_floor_is_what_noise_adds_in_the_mean_of_the_squares(rng):
    clean, share = waves(rng, 1), rng.uniform(0.05, 0.2)
    heard = (clean + noise(rng, clean, share, draws=600))[:, 0]
    steering = np.asarray(steering_vector(ARRAY, jnp.asarray(pas_directions(), jnp.float32)))
    squares = np.mean(np.abs(np.tensordot(heard, steering.conj(), (-1, -1))) ** 2, 0)
    expected = np.sqrt(squares / squares.max())
    pas = snapshot_to_pas(jnp.asarray(clean), ARRAY)
    got = np.asarray(with_noise(pas, share / (1 - share) * floor_of(jnp.asarray(clean), ARRAY)))[0]
    error, without = np.abs(got - expected).mean(), np.abs(np.asarray(pas)[0] - expected).mean()
    assert error < 0.01
    assert error < 0.3 * without


def test_one_wave_has_the_lowest_floor_and_silence_none(rng):
    one = waves(rng, 3, paths=1)
    one[2] = 0
    np.testing.assert_allclose(floor_of(jnp.asarray(one), ARRAY), [1 / COUNT, 1 / COUNT, 0], rtol=1e-3)
    assert (np.asarray(floor_of(jnp.asarray(waves(rng, 8)), ARRAY)) > 1 / COUNT).all()
    faint = 1e-9 * waves(rng, 4)
    np.testing.assert_allclose(floor_of(jnp.asarray(faint), ARRAY), floor_of(jnp.asarray(1e9 * faint), ARRAY), rtol=1e-4)
    each = jnp.broadcast_to(jnp.asarray(ARRAY), (3, COUNT, 3))  # arrays in metres have other wavelengths on every link
    np.testing.assert_allclose(floor_of(jnp.asarray(one), each), floor_of(jnp.asarray(one), ARRAY), rtol=1e-5)


def test_what_is_unexplained_is_the_part_across(rng):
    heard = waves(rng, 5)
    share = rng.uniform(0, 0.9, 5)
    other = rng.normal(size=heard.shape) + 1j * rng.normal(size=heard.shape)
    unit = heard / np.linalg.norm(heard, axis=-1, keepdims=True)
    across = other - np.sum(other * unit.conj(), -1, keepdims=True) * unit
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    predicted = 3j * (np.sqrt(1 - share)[:, None] * unit + np.sqrt(share)[:, None] * across)
    np.testing.assert_allclose(unexplained(jnp.asarray(predicted), jnp.asarray(heard)), share, atol=1e-5)


def known(rng, share, n_tx=30, per_tx=4):
    """Arguments of `noise_share` where snapshots are noisy, and predicted without the noise."""
    clean = waves(rng, n_tx * per_tx)
    heard = clean + noise(rng, clean, share)[0]
    predicted, observed = (np.asarray(snapshot_to_pas(jnp.asarray(y), ARRAY)) for y in (clean, heard))
    left, floor = (np.asarray(f) for f in (unexplained(jnp.asarray(clean), jnp.asarray(heard)), floor_of(heard, ARRAY)))
    return left, floor, predicted, observed, np.repeat(np.arange(n_tx), per_tx)


@pytest.mark.parametrize("share", [0.01, 0.05])
def test_noise_is_found_not_larger_than_it_is_by_much(rng, share):
    assert 0.2 * share < noise_share(*known(rng, share)) < 1.1 * share


def test_without_noise_there_is_none(rng):
    assert noise_share(*known(rng, 0.0)) == 0
    left, floor, predicted, observed, tx = known(rng, LEAST / 10)
    assert noise_share(left, floor, predicted, observed, tx) == 0
    assert noise_share(left, 0 * floor, predicted, observed, tx) == 0  # nothing was heard


def test_a_field_that_is_bright_where_it_is_dark_makes_no_noise(rng):
    """What is left of snapshots that a field explains badly is not noise, if spectra do not become more alike with it."""
    left, floor, predicted, observed, tx = known(rng, 0.05)
    assert noise_share(left, floor, observed, predicted, tx) == 0


def test_it_works_inside_jit(rng):
    heard = jnp.asarray(waves(rng, 2))
    np.testing.assert_allclose(jax.jit(floor_of)(heard, ARRAY), floor_of(heard, ARRAY), rtol=1e-5)
