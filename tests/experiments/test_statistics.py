"""Statistics against closed forms and cases whose answer is known."""

import numpy as np
import pytest

from experiments.statistics import compare, estimate, typical


def test_the_average_of_medians():
    scores = np.array([[[0.1, 0.8], [0.2, 0.9], [0.9, 0.1]], [[0.3, 0.3]] * 3])
    np.testing.assert_allclose(typical(scores), [(0.2 + 0.8) / 2, 0.3])


def test_a_value_is_the_median_of_the_seeds():
    found = estimate(np.stack([np.full((5, 2), level) for level in (0.5, 0.9, 0.6)]))
    assert found.value == pytest.approx(0.6)
    assert (found.low, found.high) == pytest.approx((0.5, 0.9))  # the median of three draws is an outer seed in 14 of 27
    assert found.seeds == pytest.approx((0.5, 0.9, 0.6))


def test_the_interval_is_that_of_a_median():
    """Of n normal samples its standard deviation is sqrt(pi / 2 n)."""
    n = 400
    found = estimate(np.random.default_rng(0).normal(size=(1, n, 1)))
    expected = 2 * 1.96 * np.sqrt(np.pi / (2 * n))
    assert found.high - found.low == pytest.approx(expected, rel=0.25)
    assert found.low < found.value < found.high and abs(found.value) < expected


def test_frequencies_of_one_transmitter_are_no_further_samples():
    one = np.random.default_rng(1).normal(size=(1, 100, 1))
    many = np.repeat(one, 10, axis=2)
    assert estimate(many).low == pytest.approx(estimate(one).low)
    assert estimate(many).high == pytest.approx(estimate(one).high)


def test_equal_scores_give_equal_intervals():
    scores = np.random.default_rng(2).normal(size=(2, 30, 3))
    assert estimate(scores) == estimate(scores)


def test_the_paired_test_of_six_wins_is_two_over_two_to_the_sixth():
    theirs = np.random.default_rng(3).uniform(size=(1, 6, 4))
    ours = theirs + np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])[None, :, None]
    found = compare(ours, theirs)
    assert found.p == pytest.approx(2 / 2**6)
    assert (found.share, found.transmitters, found.difference) == (1, 6, pytest.approx(0.35))


def test_pairing_finds_what_the_spread_of_places_hides():
    rng = np.random.default_rng(4)
    places = rng.uniform(0.2, 0.9, size=(1, 100, 1))
    found = compare(places + 0.01 + rng.normal(0, 0.005, (3, 100, 5)), places)
    assert found.p < 1e-6 and found.share > 0.9


def test_equal_fields_are_not_told_apart():
    scores = np.random.default_rng(5).uniform(size=(2, 20, 3))
    assert compare(scores, scores).p == 1
    noise = np.array([1, -1] * 10)[None, :, None] * np.linspace(0.01, 0.02, 20)[None, :, None]
    assert compare(scores + noise, scores).p > 0.1


def test_as_many_seeds_are_compared_on_both_sides():
    ours = np.stack([np.full((8, 2), level) for level in (0.7, 0.9, 0.9)])
    assert compare(ours, np.full((1, 8, 2), 0.5)).difference == pytest.approx(0.2)
