"""A change of a room is noticed at the given rate of false alarms, found, and carried into data and field."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.rooms import box
from builders.synthetic import tiny_settings
from builders.wave_runs import PARTS, heard_in, of_concrete, places, run_in

from wbgs_jax.data.dataset import checksum
from wbgs_jax.data.load import scene_dataset
from wbgs_jax.training.calibration.changes import (
    Evidence,
    Group,
    box_of,
    find_changes,
    limit_of,
    middle_of,
    notice,
    objects_of,
    power_change_db,
    samples_of,
    with_object_moved,
    without_object,
)
from wbgs_jax.training.calibration.objective import CalibrationProblem
from wbgs_jax.training.update import scene_of, surfaces_after, with_links

FREQUENCIES = np.array([1e9, 2.4e9])
PLACES = places(12, 0.4)
SETTINGS = tiny_settings(
    "wave",
    field={"specular_tried": 32, "specular_kept": 16, "diffracted_tried": 1, "diffracted_kept": 1, "mirror_areas": (0.0,)},
    optim={"steps": 4, "min_steps": 4},
    calibration={"rounds": 0, "antenna_rounds": 0},
)
SHIFT = np.array([0.3, -0.4, 0.0])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A room with a box and a smaller one."""
    parts = [*PARTS, box((1.8, 2.4, 0.3), (2.2, 2.8, 1.3))]
    return run_in(parts, SETTINGS, tmp_path_factory.mktemp("room"), PLACES, FREQUENCIES)


def evidence(rng, n_new, shift=0.0, objects=5, n_old=40):
    """Scores of which those of new transmitters are shifted."""
    group = np.repeat([Group.OLD, Group.NEW], [n_old, n_new])
    new = group == Group.NEW
    gains = rng.standard_t(4, (objects, len(group))) - 1 + shift * new * (np.arange(objects) == 2)[:, None]
    score, power = rng.standard_t(3, len(group)) + shift * new, rng.normal(size=len(group))
    return Evidence(score, gains, np.maximum(gains, 0), power, rng.uniform(0, 5, (len(group), 3)), group)


def test_false_alarms_have_the_given_rate(rng, monkeypatch):
    monkeypatch.setattr("wbgs_jax.training.calibration.changes.DRAWS", 199)
    found = np.array([notice(evidence(rng, 15), rng).p_value for _ in range(150)])
    assert np.mean(found <= 0.05) < 0.12  # 0.05 + 4 standard errors
    assert 0.3 < found.mean() < 0.7


def test_places_measured_again_are_one_sample(rng):
    """As many samples as repeats would make one badly predicted place a change; old and new ones stay apart."""
    old = rng.uniform(0, 5, (8, 3))
    new = np.repeat(np.concatenate([old[:1], rng.uniform(0, 5, (4, 3))]), 3, 0) + rng.normal(0, 1e-3, (15, 3))
    group = np.repeat([Group.OLD, Group.NEW], [8, 15])
    found = samples_of(np.concatenate([old, new]), np.arange(23), group)
    np.testing.assert_array_equal(found, [*range(8), *np.repeat(8 + 3 * np.arange(5), 3)])


def test_a_large_change_is_noticed(rng):
    found = notice(evidence(rng, 15, 4.0), rng)
    assert found.p_value < 0.01 and found.p_values["mean"] < 0.01
    assert limit_of(evidence(rng, 15), 0.05, rng) < limit_of(evidence(rng, 15), 0.001, rng)


def test_objects_are_the_closed_bodies_of_a_room(run):
    assert [len(movers) for movers in objects_of(run.field)] == [1, 1]
    low_high = [box_of(run.field, movers) for movers in objects_of(run.field)]
    np.testing.assert_allclose(low_high[0], [(3, 1, 0.5), (4, 2, 1.2)], atol=1e-5)


def test_an_object_moves_as_a_whole(run):
    movers = np.concatenate(objects_of(run.field))  # both together
    before = box_of(run.field, movers)
    there = with_object_moved(run.field, movers, SHIFT)
    np.testing.assert_allclose(box_of(there, movers), before + SHIFT, atol=1e-5)
    turned = with_object_moved(run.field, movers, np.zeros(3), np.pi / 2)
    np.testing.assert_allclose(middle_of(turned, movers), middle_of(run.field, movers), atol=1e-5)
    np.testing.assert_allclose(np.ptp(box_of(turned, movers), axis=0), np.ptp(before, axis=0)[[1, 0, 2]], atol=1e-5)
    back = with_object_moved(turned, movers, np.zeros(3), -np.pi / 2)
    np.testing.assert_allclose(back.facets.corners, run.field.facets.corners, atol=1e-5)


def test_parameters_follow_an_object_that_is_gone(run):
    first, second = objects_of(run.field)
    field, params = without_object(run.field, of_concrete(run), first)
    like = jax.eval_shape(field.init, jax.random.key(0))
    assert jax.tree.map(np.shape, params) == jax.tree.map(lambda leaf: leaf.shape, like)
    np.testing.assert_allclose(box_of(field, objects_of(field)[0]), box_of(run.field, second), atol=1e-6)


def test_surfaces_of_the_data_follow_the_objects(run):
    data = run.dataset
    moved = surfaces_after(data, run.field, [(0, SHIFT), (1, None)])
    own = moved.face_part == len(PARTS) - 1
    corners = np.asarray(moved.vertices)[moved.faces[own]].reshape(-1, 3)
    np.testing.assert_allclose(corners.min(0), np.add((3, 1, 0.5), SHIFT), atol=1e-5)
    assert not np.any(moved.face_part == len(PARTS)) and len(moved.faces) == len(data.faces) - 12
    still = moved.face_part < len(PARTS) - 1
    np.testing.assert_array_equal(
        moved.vertices[moved.faces[still]], data.vertices[data.faces[data.face_part < len(PARTS) - 1]]
    )


def test_data_survive_a_scene_file(run):
    data = run.dataset
    again = scene_dataset(scene_of(data, "nowhere"))
    assert checksum(again) == checksum(scene_dataset(scene_of(again, "nowhere")))
    for name in ("tx_positions", "frequencies_hz", "train", "validation", "faces"):
        np.testing.assert_array_equal(getattr(again, name), getattr(data, name))
    some = dataclasses.replace(data, train=data.train[2:], tx_positions=data.tx_positions + 0.01)
    both = with_links(data, data.train[1:], some)  # the first old link is missing
    file = scene_dataset(scene_of(both, "nowhere"))
    assert len(file) == len(both) and len(file.train) == len(both.train)


def test_a_room_without_objects_has_no_changes(run, monkeypatch):
    monkeypatch.setattr("wbgs_jax.training.calibration.changes.objects_of", lambda _: [])
    params = of_concrete(run)
    field, same, changes = find_changes(CalibrationProblem(run.field, run.prepared, run.data, np.arange(4)), params, 1e-3)
    assert field is run.field and same is params and not changes


def test_silent_links_do_not_decide_the_gain(rng):
    """Power that changed by 3 dB everywhere; one transmitter of ten fell silent, which counts as 30 dB."""
    seen = evidence(rng, 20)
    new = seen.group == Group.NEW
    change = np.where(np.cumsum(new) % 10 == 1, -30.0, 3.0)
    power = np.where(new, change, 0.0) + 0.1 * rng.normal(size=len(new))
    assert power_change_db(dataclasses.replace(seen, power_db=power)) == pytest.approx(3, abs=0.5)


@pytest.mark.heavy
def test_the_object_that_was_moved_is_found_where_it_is(run):
    (first, _), params = objects_of(run.field), of_concrete(run)
    before, run.field = run.field, with_object_moved(run.field, first, SHIFT)
    snapshots = heard_in(run, params, PLACES, FREQUENCIES)
    run.field = before
    data = dataclasses.replace(run.data, observations={"snapshots": jnp.asarray(snapshots.reshape(-1, 16))})
    problem = CalibrationProblem(run.field, run.prepared, data, np.arange(len(run.dataset)))
    field, _, (change,) = find_changes(problem, params, 1e-3)
    assert change.number == 0
    np.testing.assert_allclose(change.shift, SHIFT, atol=0.03)
    np.testing.assert_allclose(box_of(field, objects_of(field)[0]), box_of(before, first) + SHIFT, atol=0.03)
