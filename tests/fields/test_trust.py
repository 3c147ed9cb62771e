"""Whom to believe is learned from links where one is right and the other is not, and only where there are enough of them."""

import jax.numpy as jnp
import numpy as np
import pytest

from wbgs_jax.fields.base import Observation
from wbgs_jax.fields.mixture import (
    FEATURES,
    SHARES,
    ExpertPredictions,
    Scored,
    Shares,
    at_first,
    coherent_alone,
    constant,
    features,
    learn_share,
    learn_shares,
    mixed,
    nearness,
    reported,
    share_of,
    similarity,
)
from wbgs_jax.types import make_query


def scored(rng, n_tx, per_tx, best_share, noise=0.0):
    """Links whose best share follows the first feature, by as much as `best_share` says."""
    told = rng.normal(size=(n_tx * per_tx, FEATURES)).astype(np.float32)
    best = best_share(told[:, 0]) + noise * rng.normal(size=len(told))
    scores = 0.9 - 0.3 * np.abs(SHARES - best[:, None])
    return Scored(told, scores, np.repeat(np.arange(n_tx), per_tx)), best


def test_a_share_that_follows_a_feature_is_found(rng):
    known, best = scored(rng, 60, 10, lambda x: 1 / (1 + np.exp(-2 * x)), noise=0.05)
    share = learn_share(known)
    found = np.asarray(share_of(share, jnp.asarray(known.features)))
    assert np.any(share.weights) and np.corrcoef(found, best)[0, 1] > 0.9
    again, best = scored(rng, 60, 10, lambda x: 1 / (1 + np.exp(-2 * x)), noise=0.05)
    assert np.mean(np.abs(share_of(share, jnp.asarray(again.features)) - best)) < 0.12 < np.mean(np.abs(0.5 - best))


def test_what_the_features_do_not_say_is_one_share_for_all(rng):
    found = [learn_share(scored(rng, 40, 5, lambda x: 0.7 + 0 * x, noise=0.2)[0]) for _ in range(10)]
    shares = np.array([float(share_of(share, jnp.zeros((1, FEATURES)))[0]) for share in found])
    np.testing.assert_allclose(shares, 0.7, atol=0.1)
    assert sum(bool(np.any(share.weights)) for share in found) <= 6


def test_few_transmitters_say_one_share_at_most(rng):
    known, _ = scored(rng, 9, 20, lambda x: (x > 0).astype(float))
    assert not np.any(learn_share(known).weights)


def test_the_first_expert_is_used_alone_unless_few_transmitters_show_a_better_weight():
    def share_for(*gains_of_the_other: float) -> float:
        gains = np.array(gains_of_the_other)
        scores = 0.7 + gains[:, None] * (1 - SHARES)
        known = Scored(np.zeros((len(gains), FEATURES), np.float32), scores, np.arange(len(gains)))
        return float(share_of(learn_share(known), jnp.zeros((1, FEATURES)))[0])

    assert share_for(0.05) > 0.99 and share_for(0.08, -0.06) > 0.99
    assert share_for(0.3) < 0.01 and share_for(0.1, 0.08, 0.12) < 0.01


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_a_common_share_is_that_of_all_queries(share, rng):
    found = share_of(constant(share), jnp.asarray(rng.normal(size=(5, FEATURES)), jnp.float32))
    np.testing.assert_allclose(found, share, atol=2e-3)


def test_a_feature_that_never_changes_is_left_out(rng):
    known, _ = scored(rng, 40, 5, lambda x: 1 / (1 + np.exp(-3 * x)))
    known.features[:, 3] = -60.0
    share = learn_share(known)
    assert share.weights[3] == 0 and all(np.isfinite(leaf).all() for leaf in (share.weights, share.bias, share.scale))


def test_features_are_finite_of_nothing_and_of_an_unknown_power():
    query = make_query([[1.0, 2.0, 1.0]], 28e9)
    dark, bright = jnp.zeros((1, 90, 360)), jnp.ones((1, 90, 360))
    silent = Observation(dark, None, jnp.array([-300.0]))
    told = features(query, jnp.zeros(3), silent, Observation(bright))
    assert told.shape == (1, FEATURES) and np.isfinite(told).all()
    assert told[0, 3] == -60 and told[0, 4] == 0


def test_three_opinions_come_to_the_mixture_that_is_nearest(rng):
    """Powers: the coherent and the own opinion err to either side by chance, and the informed one is right in shadows alone."""
    told = rng.normal(size=(600, FEATURES)).astype(np.float32)
    truth, shadow = rng.normal(-90, 10, 600), told[:, 3] > 0
    coherent, own = truth + rng.normal(0, np.where(shadow, 20, 2), 600), truth + rng.normal(0, np.where(shadow, 20, 2), 600)
    said = ExpertPredictions(coherent, own, truth + rng.normal(0, np.where(shadow, 1, 20), 600))
    shares = learn_shares(told, np.repeat(np.arange(60), 10), said, lambda one, other: nearness(truth, one, other))
    error = np.abs(np.asarray(mixed(shares, jnp.asarray(told), said)) - truth)
    for one in said:
        assert error.mean() < 0.6 * np.abs(one - truth).mean()
    report = reported(shares, told)
    assert report["by_query"] and abs(report["coherent"] - report["own"]) < 0.2 and 0.3 < report["informed"] < 0.7


def test_both_fields_count_alike_at_first_and_one_opinion_can_count_alone(rng):
    said, told = ExpertPredictions(*rng.normal(size=(3, 4, 90, 360))), jnp.asarray(rng.normal(size=(4, FEATURES)), jnp.float32)
    expected = said.coherent / 2 + (said.own + said.informed) / 4
    np.testing.assert_allclose(mixed(at_first(), told, said), expected, atol=1e-5)
    np.testing.assert_allclose(mixed(coherent_alone(), told, said), said.coherent, atol=2e-2)
    np.testing.assert_allclose(mixed(Shares(constant(0.5), constant(0.0)), told, said), said.informed, atol=2e-2)


def test_what_mixtures_are_worth(rng):
    """The best share of a truth that is a mixture is that one; links on which nothing was heard count for nothing."""
    one, other = rng.uniform(size=(2, 70, 90, 360)).astype(np.float32)
    worth = similarity(0.25 * one + 0.75 * other, one, other)
    assert worth.shape == (70, len(SHARES)) and np.all(SHARES[worth.argmax(1)] == 0.25)
    heard = np.array([-60.0, -300.0])
    worth = nearness(heard, np.array([-50.0, -40.0]), np.array([-70.0, -90.0]))
    np.testing.assert_allclose(worth[0], -np.abs(20 * SHARES - 10))
    np.testing.assert_array_equal(worth[1], 0)
