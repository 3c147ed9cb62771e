"""Where to measure next, against a search through all places and against closed forms."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from wbgs_jax.applications import choose_next_places, walking_order
from wbgs_jax.applications.measurement_plan import NUGGET


def posterior(places, error, measured, length):
    """The covariance of errors at places, with the correlation that the joint normal distribution has, given others."""
    everything = np.concatenate([places, measured])
    joint, n = np.exp(-cdist(everything, everything) / length), len(places)
    own = joint[n:, n:] + NUGGET * np.eye(len(measured))
    given = joint[:n, :n] - joint[:n, n:] @ np.linalg.inv(own) @ joint[n:, :n]
    root = np.sqrt(np.diag(given))
    return given / np.outer(root, root) * np.outer(error, error)


@pytest.fixture
def places():
    rng = np.random.default_rng(3)
    return rng.uniform(0, 5, (40, 3)), rng.uniform(0.1, 0.4, 40), rng.uniform(0, 5, (6, 3))


def test_places_have_the_largest_variance_given_those_before(places):
    candidates, error, measured = places
    found = choose_next_places(candidates, error, measured, 1.5, 3)
    covariance = posterior(candidates, error, measured, 1.5)
    for number, one in enumerate(found.numbers):
        np.testing.assert_allclose(found.error[number] ** 2, np.mean(np.diag(covariance)), rtol=1e-9)
        assert one == np.argmax(np.diag(covariance))
        column = covariance[:, one]
        covariance = covariance - np.outer(column, column) / (covariance[one, one] + NUGGET * error[one] ** 2)
    assert (np.diff(found.error) < 0).all()


def test_equal_errors_give_places_that_are_far_from_all_others():
    line = np.column_stack([np.linspace(0, 10, 41), np.zeros((41, 2))])
    found = choose_next_places(line, np.ones(41), np.zeros((0, 3)), 3.0, 3)
    np.testing.assert_allclose(np.sort(line[found.numbers, 0]), [0, 5, 10], atol=0.26)


def test_a_batch_covers_two_rooms_and_leaves_out_what_is_measured():
    rng = np.random.default_rng(0)
    rooms = [rng.normal(0, 0.3, (20, 3)) + np.array([x, 0, 0]) for x in (0, 10, 20)]
    error = np.repeat([0.2, 0.05, 0.2], 20)
    found = choose_next_places(np.concatenate(rooms), error, rooms[1], 2.0, 2)
    assert sorted(found.numbers // 20) == [0, 2]


def test_an_error_that_is_expected_attracts_measurements():
    candidates = np.array([[0.0, 0, 0], [50, 0, 0]])
    assert choose_next_places(candidates, np.array([0.1, 0.3]), np.zeros((0, 3)), 1.0, 1).numbers.tolist() == [1]


@pytest.mark.parametrize(("count", "length"), [(0, 1.0), (41, 1.0), (3, 0.0)])
def test_impossible_choices_are_refused(places, count, length):
    with pytest.raises(ValueError, match="is"):
        choose_next_places(*places, length, count)


@pytest.mark.parametrize("wrong", [np.nan, -0.1, np.inf])
def test_errors_that_cannot_be_expected_are_refused(places, wrong):
    candidates, error, measured = places
    with pytest.raises(ValueError, match="expected_error is negative or not finite"):
        choose_next_places(candidates, np.concatenate([error[:-1], [wrong]]), measured, 1.5, 3)


def test_a_walk_visits_every_place_once_and_is_short():
    places = np.random.default_rng(1).uniform(0, 1, (12, 3))
    order = walking_order(places, np.zeros(3))
    assert sorted(order) == list(range(12))
    walks = [order, *(np.random.default_rng(k).permutation(12) for k in range(200))]
    corners = [np.concatenate([np.zeros((1, 3)), places[walk]]) for walk in walks]
    length, *others = [np.linalg.norm(np.diff(points, axis=0), axis=1).sum() for points in corners]
    assert length < min(others)
    line = np.array([[3.0, 0, 0], [1, 0, 0], [2, 0, 0], [0.5, 0, 0]])
    assert walking_order(line, np.zeros(3)).tolist() == [3, 1, 2, 0]
    assert walking_order(line.tolist(), [6, 0, 0]).tolist() == [0, 2, 1, 3]
