"""Surfaces that stand elsewhere than the mesh says are put where spectra say they are, or believed less; right ones stay."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from synthetic import tiny_settings
from wave_runs import PARTS, places, run_in

from wbgs_jax.fields import wave
from wbgs_jax.training import search
from wbgs_jax.training.geometry import GeometryReport, Place, is_doubtful, learn_geometry
from wbgs_jax.training.materials import ITU_MATERIALS
from wbgs_jax.training.placement import SPREADS_M, search_placement
from wbgs_jax.training.scores import make_scores
from wbgs_jax.types import make_query

N_TX, FREQUENCIES = 40, np.array([1e9, 4e9, 16e9])
PLACES = places(N_TX, 0.4)
SETTINGS = tiny_settings(
    "wave",
    field={"specular_tried": 32, "specular_kept": 16, "diffracted_tried": 1, "diffracted_kept": 1, "mirror_areas": (0.0,)},
    search={"spectra": 80, "rounds": 1, "antenna_rounds": 0, "geometry_steps": 80, "geometry_tx": 40},
)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """Snapshots of a room of concrete, in all places."""
    run = run_in(PARTS, SETTINGS, tmp_path_factory.mktemp("true"), PLACES, FREQUENCIES)
    permittivity, c, d = ITU_MATERIALS["concrete"]
    materials = dataclasses.replace(
        run.state.params.materials,
        log_susceptibility=jnp.full(len(PARTS), np.log(permittivity - 1)),
        log_conductivity=jnp.full(len(PARTS), np.log(c)),
        slope=jnp.full(len(PARTS), d),
    )
    params = dataclasses.replace(run.state.params, materials=materials)
    query = make_query(np.repeat(PLACES, len(FREQUENCIES), 0), np.tile(FREQUENCIES, N_TX))
    heard = jax.jit(wave.snapshots)(params, run.field.plan(params, run.dataset.receiver()), query)
    return np.asarray(heard).reshape(N_TX, 1, len(FREQUENCIES), 16), params


def learned(truth, parts, folder):
    snapshots, params = truth
    run = run_in(parts, SETTINGS, folder, PLACES, FREQUENCIES, snapshots)
    place = Place(run.field, params, run.cache)  # materials known: what is learned here is where they are
    return learn_geometry(place, run.data, run.dataset.train, SETTINGS.search, np.random.default_rng(0)), run


def test_walls_come_back(truth, tmp_path):
    rng = np.random.default_rng(5)
    shifts = rng.normal(0, 0.006, (len(PARTS), 3))
    wrong = [part.copy().apply_translation(shift) for part, shift in zip(PARTS, shifts, strict=True)]
    (place, report), run = learned(truth, wrong, tmp_path)
    assert report.kept and report.after < report.before - 0.5
    normal, mover = np.asarray(run.field.facets.normal), np.asarray(run.field.facets.mover)
    own = {int(m): shifts[p] for m, p in zip(mover, part_of(run, wrong), strict=True)}
    along = np.array([abs(normal[i] @ own[int(m)]) for i, m in enumerate(mover)])
    steps = np.asarray(place.field.facets.offset) - np.asarray(run.field.facets.offset)
    left = np.array([abs(steps[i] + normal[i] @ own[int(m)]) for i, m in enumerate(mover)])
    walls = np.bincount(mover)[mover] == 1
    print(np.round(1e3 * along[walls], 2), np.round(1e3 * left[walls], 2))
    assert np.median(left[walls]) < 5e-4 < np.median(along[walls])


def part_of(run, parts):
    """The part that every facet lies on."""
    centres = np.asarray(run.field.facets.corners, float).mean(1)
    distances = np.array([[np.abs(part.nearest.on_surface([c])[1][0]) for part in parts] for c in centres])
    return distances.argmin(1)


@pytest.mark.slow
def test_right_surfaces_stay(truth, tmp_path):
    (place, report), run = learned(truth, PARTS, tmp_path)
    assert report.largest_mm < 1 or not report.kept
    if not report.kept:
        assert place.field is run.field


def test_a_training_goes_on_with_the_moved_field(truth, tmp_path, monkeypatch):
    run = run_in(PARTS, SETTINGS, tmp_path, PLACES, FREQUENCIES, truth[0])
    moved = run.field.moved(np.full((len(PARTS), 3), 1e-3))
    report = GeometryReport(-1.0, -2.0, True, 1.0, 1.0)
    monkeypatch.setattr(search, "is_doubtful", lambda *_: True)
    monkeypatch.setattr(search, "learn_geometry", lambda place, *_: (Place(moved, place.params, place.cache), report))
    run.controls = (search.Search(SETTINGS.search),)
    run.control()
    assert run.field is moved
    assert json.loads((tmp_path / "metrics.jsonl").read_text())["geometry"] == dataclasses.asdict(report)


def test_only_phases_that_get_worse_with_the_frequency_make_a_mesh_doubtful(rng):
    frequency = np.repeat([1e9, 5e9, 28e9, 94e9], 20)
    worse = np.repeat([-3.0, -2.0, -0.5, -0.3], 20)
    assert is_doubtful(worse, frequency) and not is_doubtful(worse[::-1], frequency)
    assert not is_doubtful(np.full(80, -1.0), frequency) and not is_doubtful(worse[:40], frequency[:40])


def shifted(parts, metres, rng):
    return [part.copy().apply_translation(rng.normal(0, metres, 3)) for part in parts]


@pytest.mark.parametrize(("metres", "lowest", "highest"), [(0.0, SPREADS_M[0], 1e-3), (0.01, 3e-3, SPREADS_M[-1])])
def test_places_are_believed_as_far_as_they_are_right(truth, metres, lowest, highest, tmp_path, rng):
    heard, params = truth
    run = run_in(shifted(PARTS, metres, rng), SETTINGS, tmp_path, PLACES, FREQUENCIES, heard)
    score = make_scores(run.field, run.cache, run.data, jnp.asarray(run.dataset.train[:60]), phases=False)
    found, report = search_placement(params, score)
    assert lowest * 0.99 < float(jnp.exp(found.placement[0])) < highest * 1.01 and np.ptp(found.placement) == 0
    if metres:
        assert report.uncertain < report.certain


@pytest.mark.slow
def test_training_believes_the_wrong_surface_less(truth, tmp_path):
    """One wall stands 5 mm off: the image loss learns that it may, and that the other surfaces are where they are."""
    heard, params = truth
    wrong = [PARTS[0].copy().apply_translation(0.005 * PARTS[0].face_normals[0]), *PARTS[1:]]
    run = run_in(wrong, SETTINGS, tmp_path, PLACES, FREQUENCIES, heard)
    batch = run.data.batch(jnp.asarray(run.dataset.train[:24]), jax.random.key(0))
    optimizer = optax.adam(0.3)

    @jax.jit
    def learn(placement):
        def loss(placement):
            return run.field.loss(dataclasses.replace(params, placement=placement), run.cache, batch)[0]

        def step(carry, _):
            updates, state = optimizer.update(jax.grad(loss)(carry[0]), carry[1])
            return (optax.apply_updates(carry[0], updates), state), None

        return jax.lax.scan(step, (placement, optimizer.init(placement)), length=25)[0][0]

    spread = np.exp(np.asarray(learn(jnp.full_like(params.placement, np.log(1e-3)))))
    (wall,) = np.unique(np.asarray(run.field.facets.mover)[part_of(run, wrong) == 0])
    assert 1e-3 < spread[wall] < 2e-2 and spread[wall] > 2 * np.delete(spread, wall).max(), np.round(1e3 * spread, 2)
