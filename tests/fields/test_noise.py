"""Noise of snapshots: what it does to spectra, against draws of it; and how much there is, from what fields say."""

from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.fields import mixture
from wbgs_jax.fields.mixture import ExpertPredictions, at_least_floor, floor_of, observed_predictions, with_floor, without_floor
from wbgs_jax.radio.array import PAS_SHAPE, pas_directions, planar_array, steering_vector

ARRAY = planar_array(4, 4, 0.5)
COUNT = len(ARRAY)
STEERING = np.asarray(steering_vector(ARRAY, jnp.asarray(pas_directions(), jnp.float32))).reshape(-1, COUNT)
OPTIMISED = {"xla_backend_optimization_level": 1}


@pytest.fixture(autouse=True, scope="module")
def optimised():
    """Thousands of images are compared: what is quick to compile (conftest.py) would take longer to run."""
    faster = {name: jax.jit(getattr(mixture, name), compiler_options=OPTIMISED) for name in ("_added", "_raised")}
    with mock.patch.multiple(mixture, **faster):
        yield


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


def peak(snapshots):
    """max |a^H h|^2 / N of snapshots of unit power."""
    unit = snapshots / np.sqrt(np.mean(np.abs(snapshots) ** 2, -1, keepdims=True))
    return (np.abs(unit @ STEERING.conj().T) ** 2).max(-1) / COUNT


def spectra(snapshots):
    """By NumPy: there are thousands of them."""
    pas = np.abs(snapshots.astype(np.complex64) @ STEERING.conj().T)
    return (pas / pas.max(-1, keepdims=True)).reshape(-1, *PAS_SHAPE)


def test_the_floor_is_what_noise_adds_in_the_mean_of_the_squares(rng):
    clean, share = waves(rng, 1), rng.uniform(0.05, 0.2)
    heard = (clean + noise(rng, clean, share, draws=600))[:, 0]
    squares = np.mean(np.abs(heard @ STEERING.conj().T) ** 2, 0).reshape(PAS_SHAPE)
    expected = np.sqrt(squares / squares.max())
    pas = spectra(clean)
    got = np.asarray(with_floor(jnp.asarray(pas), share / (1 - share) / peak(clean)[0]))[0]
    error, without = np.abs(got - expected).mean(), np.abs(pas[0] - expected).mean()
    assert error < 0.01
    assert error < 0.3 * without


def test_it_is_taken_out_again(rng):
    pas, floor = jnp.asarray(rng.uniform(0, 1, (3, 90, 360)), jnp.float32), rng.uniform(1e-3, 0.1)
    np.testing.assert_allclose(without_floor(with_floor(pas, floor), floor), pas, atol=2e-3)
    assert not np.any(without_floor(0.9 * np.sqrt(floor / (1 + floor)) * jnp.ones((1, 90, 360)), floor))
    np.testing.assert_allclose(without_floor(pas, 0.0), pas, rtol=1e-6)
    of_dark = jax.grad(lambda p: jnp.sum(without_floor(p, floor)))(jnp.zeros((1, 90, 360)))
    np.testing.assert_array_equal(of_dark, 0)


def known(rng, share, n_tx=20, per_tx=2):
    """Arguments of `found` where snapshots are noisy, and the true floor: spectra of a field without the noise, of one that
    has learned what it does on average, and observed ones; whose they are."""
    clean = waves(rng, n_tx * per_tx)
    learned = np.mean([spectra(clean + noise(rng, clean, share)[0]) for _ in range(20)], 0)
    observed = spectra(clean + noise(rng, clean, share)[0])
    return (spectra(clean), learned, observed, np.repeat(np.arange(n_tx), per_tx)), np.median(share / (1 - share) / peak(clean))


def found(unaware, learned, observed, tx):
    return floor_of(ExpertPredictions(unaware, np.zeros_like(unaware), learned), observed, tx)


@pytest.mark.heavy
@pytest.mark.parametrize("share", [0.01, 0.1])
def test_it_is_found_and_hardly_ever_too_high(rng, share):
    arguments, floor = known(rng, share, n_tx=30, per_tx=4)
    assert 0.2 * floor < found(*arguments) < 1.2 * floor  # of the dark, spectra show the median: ln 2 of the mean


def test_raising_is_taking_out_and_adding_again(rng):
    pas, floor = jnp.asarray(rng.uniform(0, 0.5, (2, 90, 360)), jnp.float32), rng.uniform(0.01, 0.1)
    again = with_floor(without_floor(pas, floor), floor)
    np.testing.assert_allclose(at_least_floor(pas, floor), again, atol=1e-6)
    np.testing.assert_array_equal(at_least_floor(pas, 0.0), pas)


@pytest.mark.heavy
def test_without_noise_there_is_none(rng):
    clean, _, observed, tx = known(rng, 0.0)[0]
    assert found(clean, clean, observed, tx) == 0
    fewer = np.where(clean < 0.3, 0, clean)  # paths are missing, which is as if there were noise
    assert found(fewer, clean, observed, tx) == 0
    assert found(fewer, np.where(clean < 0.05, 0, clean), observed, tx) < 3e-4  # too dark, but not for want of noise


@pytest.mark.heavy
def test_missing_paths_look_like_noise_to_one_field_alone(rng):
    (clean, learned, observed, tx), floor = known(rng, 0.02)
    fewer = np.where(clean < 0.3, 0, clean)
    assert 0 < found(fewer, learned, observed, tx) < 1.2 * floor


@pytest.mark.heavy
def test_where_no_path_arrives_both_have_learned_the_floor(rng):
    """The coherent field takes over what the splatting one says there."""
    (clean, learned, observed, tx), _ = known(rng, 0.1)
    unmet = rng.permutation(len(tx)) < 10
    said = ExpertPredictions(np.where(unmet[:, None, None], learned, clean), learned, learned)
    met = ExpertPredictions(*(spectra[~unmet] for spectra in said))
    assert floor_of(said, observed, tx) == pytest.approx(floor_of(met, observed[~unmet], tx[~unmet]), rel=0.6)
    seen = observed_predictions(said, 0.02)
    np.testing.assert_array_equal(seen.coherent[unmet], seen.own[unmet])
    np.testing.assert_allclose(seen.coherent[~unmet], with_floor(jnp.asarray(clean[~unmet]), 0.02), rtol=1e-6)
    np.testing.assert_array_equal(seen.informed, at_least_floor(jnp.asarray(learned, jnp.float32), 0.02))


def test_noise_of_a_diverged_field_stays_visible():
    assert np.isnan(without_floor(jnp.full((1, 90, 360), jnp.nan), 0.01)).all()


@pytest.mark.heavy
def test_what_is_not_sure_is_none(rng):
    (clean, learned, observed, tx), _ = known(rng, 0.1)
    assert found(clean, learned, observed, tx) > 0
    assert found(learned, learned, clean, tx) == 0  # the observed ones are darker
    assert found(clean, learned, observed, tx // 4) == 0  # of five transmitters
