"""Bodies that the mesh has and the room does not are left out of it; those that are there stay, even in a wrong mesh."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.rooms import box
from builders.synthetic import tiny_settings
from builders.wave_runs import PARTS, REFLECTIONS, heard_in, of_concrete, places, run_in

from wbgs_jax.training.calibration.objective import CalibrationProblem
from wbgs_jax.training.calibration.obstacles import absent_movers, search_absent

N_TX, FREQUENCIES = 60, np.array([1e9, 4e9, 16e9])
PLACES = places(N_TX, 0.4)
SETTINGS = tiny_settings(
    "wave",
    field=REFLECTIONS,
    optim={"steps": 4, "min_steps": 4},
    calibration={
        "spectra": 80,
        "rounds": 1,
        "antenna_rounds": 0,
        "spurious_spectra": 768,
        "spurious_glance": 24,
        "array_gain_spectra": 0,
    },
)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """Snapshots of a room of concrete, in all places."""
    run = run_in(PARTS, SETTINGS, tmp_path_factory.mktemp("true"), PLACES, FREQUENCIES)
    return heard_in(run, of_concrete(run), PLACES, FREQUENCIES)


def told_of(parts, truth, folder):
    run = run_in(parts, SETTINGS, folder, PLACES, FREQUENCIES, truth)
    return run, CalibrationProblem(run.field, run.prepared, run.data, np.random.default_rng(0).permutation(run.dataset.train))


def anything(rng):
    """A box a metre high that stands in nobody's way: neither the receiver's nor the other box's."""
    low = rng.uniform((1.6, 0.6, 0.3), (2.4, 3.0, 1.0))
    return box(low, low + rng.uniform(0.4, 0.6, 3) + (0, 0, 0.5))


def corners(field):
    return np.unique(np.round(np.sort(np.asarray(field.facets.corners).reshape(-1, 12), 1), 5), axis=0)


@pytest.mark.heavy
def test_a_field_without_a_mover_is_that_of_the_mesh_without_it(truth, tmp_path, rng):
    extra = anything(rng)
    more, _ = told_of([*PARTS, extra], truth, tmp_path / "more")
    fewer, _ = told_of(PARTS, truth, tmp_path / "fewer")
    middle = np.asarray(more.field.facets.corners).mean(1)
    mover = np.unique(
        np.asarray(more.field.facets.mover)[np.all(np.abs(middle - extra.bounds.mean(0)) < 0.55 * extra.extents, -1)]
    )
    assert len(mover) == 1
    left = more.field.without(mover)
    np.testing.assert_allclose(corners(left), corners(fewer.field), atol=1e-5)
    assert (
        left.motion.shift.shape == fewer.field.motion.shift.shape
        and left.first_placement.shape == fewer.field.first_placement.shape
    )
    assert np.count_nonzero(left.edges.length) == np.count_nonzero(fewer.field.edges.length)
    params = of_concrete(more)
    alike = dataclasses.replace(left.init(jax.random.key(0)), materials=params.materials)
    more.field = left
    np.testing.assert_allclose(heard_in(more, alike, PLACES, FREQUENCIES), truth, atol=1e-5 * np.abs(truth).max())


@pytest.mark.heavy
def test_what_is_there_stays(truth, tmp_path, rng):
    """Though all of it stands two centimetres off, and walls are then often worse than none at the lowest frequency."""
    wrong = [part.copy().apply_translation(rng.normal(0, 0.02, 3)) for part in PARTS]
    run, problem = told_of(wrong, truth, tmp_path)
    _, same, report = search_absent(of_concrete(run), problem, SETTINGS.calibration)
    assert same is problem and not report.centres and report.after == report.before


@pytest.mark.heavy
def test_nothing_is_left_out_of_what_cannot_be_told(truth, tmp_path, rng):
    """At high frequencies alone, where places are not believed; and bodies without facets change nothing."""
    run, problem = told_of([*PARTS, anything(rng)], truth, tmp_path)
    params = of_concrete(run)
    high = dataclasses.replace(problem, spectra=problem.spectra[problem.frequency_hz() > 2e9])
    assert not len(absent_movers(params, high, SETTINGS.calibration))
    ghosts = [jnp.concatenate([leaf, jnp.zeros((2, 3))]) for leaf in (run.field.motion.shift, run.field.motion.turn)]
    motion = dataclasses.replace(run.field.motion, shift=ghosts[0], turn=ghosts[1])
    mover = jnp.where(run.field.facets.mover > 0, run.field.facets.mover + 2, 0)  # two have lost all of their facets
    facets = dataclasses.replace(run.field.facets, mover=mover)
    surfaces = dataclasses.replace(run.prepared.surfaces, facets=dataclasses.replace(run.prepared.surfaces.facets, mover=mover))
    field = dataclasses.replace(run.field, facets=facets, motion=motion)
    large = dataclasses.replace(problem, field=field, prepared=dataclasses.replace(run.prepared, surfaces=surfaces))
    np.testing.assert_array_equal(
        absent_movers(params, large, SETTINGS.calibration), absent_movers(params, problem, SETTINGS.calibration) + 2
    )


@pytest.mark.heavy
def test_what_is_not_there_is_left_out_and_a_training_goes_on_without_it(truth, tmp_path, rng):
    extra = anything(rng)
    run, _ = told_of([*PARTS, extra], truth, tmp_path)
    facets = run.field.facets.offset.shape[0]
    run.run_hooks()
    report = json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[0])["absent"]
    print(extra.bounds, report)
    assert len(report["centres"]) == 1 and report["after"] < report["before"] - 0.1
    np.testing.assert_allclose(report["centres"][0], extra.bounds.mean(0), atol=1e-3)
    assert run.field.facets.offset.shape[0] == facets - 6
    run.epoch()
    run.save()
    again, _ = told_of([*PARTS, extra], truth, tmp_path)
    assert again.restore() and again.field.facets.offset.shape[0] == facets - 6
    for ours, theirs in zip(jax.tree.leaves(again.state.params), jax.tree.leaves(run.state.params), strict=True):
        np.testing.assert_array_equal(ours, theirs)
