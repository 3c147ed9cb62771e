"""Candidates scored side by side, which share what they have in common, against each scored by itself."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_scene, tiny_settings
from builders.wave_runs import PARTS, places, run_in

from wbgs_jax.data import scene_dataset
from wbgs_jax.fields.losses import log_decorrelation, surprise
from wbgs_jax.mesh.edges import common_size
from wbgs_jax.training.calibration import objective
from wbgs_jax.training.calibration.material_fit import with_entry
from wbgs_jax.training.calibration.objective import CalibrationProblem, make_scores, surely_better
from wbgs_jax.training.calibration.obstacles import _carried, each_by_itself
from wbgs_jax.training.loop import Run

N_TX, FREQUENCIES = 4, np.array([1e9, 6e9])
SETTINGS = tiny_settings(
    "wave", field={"specular_tried": 32, "specular_kept": 16, "diffracted_tried": 32, "diffracted_kept": 8}
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    heard = np.random.default_rng(1).normal(size=(2, N_TX, 1, len(FREQUENCIES), 16))
    snapshots = (heard[0] + 1j * heard[1]).astype(np.complex64)
    return run_in(PARTS, SETTINGS, tmp_path_factory.mktemp("room"), places(N_TX), FREQUENCIES, snapshots)


def other_materials(params, rng):
    materials = params.materials
    moved = materials.log_susceptibility + jnp.asarray(rng.normal(0, 1.0, materials.slope.shape), jnp.float32)
    return dataclasses.replace(params, materials=dataclasses.replace(materials, log_susceptibility=moved))


@pytest.mark.heavy
@pytest.mark.parametrize("compared", ["snapshots", "covariances", "spectra"])
def test_candidates_side_by_side_score_as_each_alone(run, rng, compared):
    params = run.state.params
    candidates = [params, *(other_materials(params, rng) for _ in range(2))]
    score = make_scores(run.field, run.prepared, run.data, jnp.asarray(run.dataset.train), compared)
    found = score(candidates)
    assert found.shape == (3, len(run.dataset.train))
    apart = np.abs(found[0] - found[1:]).mean(1)
    assert (apart > 1e-3).all()
    for row, candidate in zip(found, candidates, strict=True):
        np.testing.assert_allclose(score([candidate])[0], row, atol=1e-4)
        copied = jax.tree.map(jnp.copy, candidate)
        np.testing.assert_allclose(score([copied, candidate])[0], row, atol=1e-4)
    first = score(candidates, 3)
    np.testing.assert_allclose(first, found[:, :3], atol=1e-4)
    np.testing.assert_array_equal(score([params, params])[0], score([params])[0])


@pytest.mark.heavy
def test_scores_are_those_of_rendered_links(run, rng):
    """The one program of all comparisons, and what the field renders link by link."""
    params, train, data = other_materials(run.state.params, rng), np.asarray(run.dataset.train)[:5], run.data
    expected = {
        "snapshots": lambda seen, batch: log_decorrelation(seen.snapshots, batch.snapshots)[0],
        "covariances": lambda seen, batch: surprise(seen.covariance, batch.snapshots)[0],
        "spectra": lambda seen, batch: jnp.log(jnp.mean(jnp.abs(seen.pas - batch.pas))),
        "powers": lambda seen, batch: jnp.log(1 + jnp.abs(seen.power_db - batch.received_db)[0]),
    }
    programs = None
    for compared, of in expected.items():
        found = make_scores(run.field, run.prepared, data, train, compared)([params])[0]
        for link, score in zip(train, found, strict=True):
            batch = data.batch(jnp.asarray([link]), jax.random.key(0))
            plan = run.field.plan(params, batch.receiver, run.prepared)
            np.testing.assert_allclose(score, of(run.field.render(params, plan, batch.links), batch), atol=1e-4)
        assert programs in (None, objective._score._cache_size())
        programs = objective._score._cache_size()


@pytest.mark.heavy
def test_few_programs_score_all_numbers_of_candidates_and_spectra(run, rng):
    """Compiling one takes as long as scoring thousands; nor does it matter how many transmitters are prepared."""
    params, train = run.state.params, np.asarray(run.dataset.train)
    one_tx = train[np.asarray(run.data.links.tx_index)[train] == int(run.data.links.tx_index[train[0]])]
    few = run.field.prepare(jax.tree.map(lambda leaf: leaf[one_tx], run.data.links), run.data.receivers)
    candidates = [other_materials(params, rng) for _ in range(11)]
    found = make_scores(run.field, run.prepared, run.data, jnp.asarray(train))(candidates)
    programs = objective._score._cache_size()
    np.testing.assert_allclose(
        make_scores(run.field, few, run.data, jnp.asarray(one_tx))(candidates[:9]), found[:9, np.isin(train, one_tx)], atol=1e-4
    )
    assert objective._score._cache_size() == programs
    score = make_scores(run.field, run.prepared, run.data, jnp.asarray(train))
    np.testing.assert_allclose(score(candidates[:1]), found[:1], atol=1e-4)  # one differs from nothing
    named = [dataclasses.replace(params, materials=with_entry(params.materials, 0, "wood", metres)) for metres in (None, 0.1)]
    score(named)
    programs = objective._score._cache_size()
    assert (score(named[:1]).shape, score(named[1:]).shape) == ((1, len(train)), (1, len(train)))
    assert objective._score._cache_size() == programs
    np.testing.assert_allclose(score(candidates * 4), np.tile(found, (4, 1)), atol=1e-4)
    assert objective._score._cache_size() == programs


@pytest.mark.heavy
def test_links_find_their_own_paths_among_those_that_were_taken_out(run, rng):
    """In any order, some of them twice."""
    links = jax.tree.map(lambda leaf: leaf[rng.integers(0, len(run.dataset), 8)], run.data.links)
    taken = run.prepared.subset(links)
    jax.tree.map(np.testing.assert_array_equal, taken.of(links), run.prepared.of(links))
    assert len(taken.tx_index) == 8


@pytest.mark.heavy
@pytest.mark.parametrize("compared", ["snapshots", "covariances", "spectra"])
def test_a_link_on_which_nothing_was_heard_speaks_for_no_candidate(run, rng, compared):
    train, params = np.asarray(run.dataset.train), run.state.params
    silent = run.data.with_observations(snapshots=run.data.snapshots.at[train[1]].set(0))
    candidates = [params, other_materials(params, rng), other_materials(params, rng)]
    score, heard = (make_scores(run.field, run.prepared, data, jnp.asarray(train), compared) for data in (silent, run.data))
    found = score(candidates)
    assert np.isfinite(found).all()
    assert np.ptp(found[:, 1]) == 0
    np.testing.assert_array_equal(np.delete(found, 1, 1), np.delete(heard(candidates), 1, 1))


@pytest.mark.heavy
def test_snapshots_of_one_element_are_compared_by_their_power(rng, tmp_path):
    """Their correlation is 1 whatever is compared."""
    scene = tiny_scene(N_TX)
    scene = dataclasses.replace(scene, snapshots=scene.snapshots[..., :1], element_positions=np.zeros((1, 1, 3)))
    run = Run(scene_dataset(scene), "wave", SETTINGS, 0, tmp_path)
    candidates = [run.state.params, other_materials(run.state.params, rng)]
    train = jnp.asarray(run.dataset.train)
    found, powers = (make_scores(run.field, run.prepared, run.data, train, by)(candidates) for by in ("snapshots", "powers"))
    np.testing.assert_allclose(found, powers, atol=1e-5)
    assert np.abs(found[0] - found[1]).mean() > 1e-3


def test_one_transmitter_is_never_sure(rng):
    gains = rng.uniform(1, 2, 6)
    assert not surely_better(gains, np.zeros(6, int), 3.0)
    assert surely_better(np.tile(gains, 4), np.repeat(np.arange(12), 2), 3.0)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_gains_that_are_not_finite_are_not_sure(rng, wrong):
    gains = rng.uniform(1, 2, 40)
    assert surely_better(gains, np.arange(40), 3.0)
    gains[7] = wrong
    assert not surely_better(gains, np.arange(40), 3.0)


def test_more_errors_than_random_flips_can_tell_are_counted(rng):
    noise = rng.normal(size=200)
    noise = (noise - noise.mean()) / noise.std(ddof=1)
    for errors, sure in ((6.1, True), (5.9, False), (-6.1, False)):
        assert surely_better(noise + errors / np.sqrt(200), np.arange(200), 6.0) is sure


@pytest.mark.heavy
def test_similar_fields_share_a_program_and_score_alike(run):
    """A material for every body and ideal array gains change no shape, and a few bodies fewer usually none."""
    problem = CalibrationProblem(run.field, run.prepared, run.data, np.asarray(run.dataset.train))
    scores = problem.scores()([run.state.params])
    programs = objective._score._cache_size()
    by_body, params = each_by_itself(run.state.params, problem)
    np.testing.assert_allclose(by_body.scores()([params]), scores, atol=1e-4)
    ideal = run.field.with_gains(np.ones(run.data.receivers.element_positions.shape[:2], complex))
    np.testing.assert_allclose(dataclasses.replace(problem, field=ideal).scores()([run.state.params]), scores, atol=1e-4)
    assert objective._score._cache_size() == programs
    fewer = run.field.without(np.array([0]))  # here a large part of the mesh
    left = dataclasses.replace(problem, field=fewer, prepared=fewer.prepare(run.data.links, run.data.receivers))
    assert np.abs(left.scores()([_carried(run.state.params, fewer)]) - scores).max() > 1e-3
    sizes = (311, 54, 900), (300, 50, 880)  # facets, bodies and edges of scene 1, and a few of them fewer
    assert len({tuple(map(common_size, of_mesh)) for of_mesh in sizes}) == 1
