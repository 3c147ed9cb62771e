"""Arrays that are out of tune are tuned as snapshots say; those that are in tune are left alone."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_settings
from builders.wave_runs import PARTS, REFLECTIONS, places, run_in

from wbgs_jax.config import CalibrationConfig
from wbgs_jax.fields import coherent
from wbgs_jax.training.calibration.antennas import least_squares, search_tuning
from wbgs_jax.training.calibration.objective import CalibrationProblem
from wbgs_jax.types import make_query

N_TX, FREQUENCIES = 40, np.array([1e9, 4e9, 16e9])
PLACES = places(N_TX, 0.4)
SETTINGS = tiny_settings(
    "wave",
    field=REFLECTIONS,
    calibration={"rounds": 0, "antenna_rounds": 0, "geometry": False},
)


def draw_gains(rng, degrees=15.0, decibels=1.0, elements=16):
    """Random gains of mean phase 0 and root mean square 1."""
    gains = np.exp(rng.normal(0, decibels / 8.686, elements) + 1j * np.deg2rad(rng.normal(0, degrees, elements)))
    return gains / np.sqrt(np.mean(np.abs(gains) ** 2)) * np.exp(-1j * np.angle(gains.sum()))


def test_least_squares_find_gains_up_to_the_factors_of_snapshots(rng):
    gains = draw_gains(rng)
    said = rng.normal(size=(60, 16)) + 1j * rng.normal(size=(60, 16))
    factors = np.exp(rng.normal(0, 5, 60) + 2j * np.pi * rng.random(60))
    heard = factors[:, None] * gains * said
    wrong = heard.copy()
    wrong[:6] = rng.normal(size=(6, 16)) + 1j * rng.normal(size=(6, 16))  # of paths that nobody knows
    np.testing.assert_allclose(least_squares(said, heard), gains, atol=1e-6)
    np.testing.assert_allclose(least_squares(said, wrong), gains, atol=5e-3)
    np.testing.assert_array_equal(least_squares(0 * said, heard), 1)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return run_in(PARTS, SETTINGS, tmp_path_factory.mktemp("run"), PLACES, FREQUENCIES)


def heard_by(run, field, params):
    query = make_query(np.repeat(PLACES, len(FREQUENCIES), 0), np.tile(FREQUENCIES, N_TX))
    heard = jax.jit(coherent.snapshots)(params, field.plan(params, run.dataset.receiver()), query)
    return np.asarray(heard).reshape(N_TX, 1, len(FREQUENCIES), 16)


def searched(run, heard, folder, rng):
    own = run_in(PARTS, SETTINGS, folder, PLACES, FREQUENCIES, heard)
    problem = CalibrationProblem(own.field, own.prepared, own.data, rng.permutation(own.dataset.train))
    return own.field, *search_tuning(run.state.params, problem, CalibrationConfig(array_gain_spectra=200))


@pytest.mark.heavy
def test_an_array_out_of_tune_is_tuned(run, tmp_path, rng):
    gains = draw_gains(rng)
    heard = heard_by(run, run.field.with_gains(gains[None]), run.state.params)
    np.testing.assert_allclose(heard, gains * heard_by(run, run.field, run.state.params), rtol=1e-3, atol=1e-9)
    _, tuned, report = searched(run, heard, tmp_path, rng)
    found = np.exp(np.asarray(tuned.tuning[0]) @ [1, 1j])
    assert report.kept and report.after < report.before
    np.testing.assert_allclose(found, gains, atol=0.01)
    assert report.phase_deg == pytest.approx(np.rad2deg(np.std(np.angle(gains))), abs=0.3)


@pytest.mark.heavy
def test_an_array_in_tune_is_left_alone(run, tmp_path, rng):
    noise = 0.1 * np.exp(2j * np.pi * rng.random((N_TX, 1, len(FREQUENCIES), 16)))
    heard = heard_by(run, run.field, run.state.params) * (1 + noise)
    field, tuned, report = searched(run, heard, tmp_path, rng)
    assert not report.kept and tuned is field


@pytest.mark.heavy
def test_spectra_and_snapshots_are_of_the_same_tuning(run, rng):
    field, params = run.field.with_gains(draw_gains(rng)[None]), run.state.params
    params = dataclasses.replace(params, placement=jnp.full_like(params.placement, np.log(1e-7)))
    query = make_query(PLACES[:4], np.full(4, 4e9))
    plan = field.plan(params, run.dataset.receiver())
    seen = jax.jit(field.render)(params, plan, query)
    y = np.asarray(seen.snapshots, complex)
    own = y[:, :, None] * y[:, None].conj()
    np.testing.assert_allclose(seen.covariance, own / np.trace(own, axis1=1, axis2=2)[:, None, None], atol=2e-4)


def test_another_receiver_is_in_tune(run, rng):
    field = run.field.with_gains(draw_gains(rng)[None])
    known = run.dataset.receiver()
    other = dataclasses.replace(known, position=known.position + 0.5)
    np.testing.assert_array_equal(field.plan(None, other).array_gains, 0)
    assert np.any(field.plan(None, known).array_gains)
    larger = dataclasses.replace(known, element_positions=jnp.concatenate([known.element_positions] * 2))
    assert field.plan(None, larger).array_gains is None
    twice = dataclasses.replace(field, receivers=jnp.tile(field.receivers, (2, 1)), tuning=jnp.tile(field.tuning, (2, 1, 1)))
    np.testing.assert_array_equal(twice.plan(None, known).array_gains, 0)  # whose of the two arrays they are is not known
