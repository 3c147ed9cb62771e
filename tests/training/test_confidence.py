"""Expected scores and their intervals: learned where they should be, and honest about new transmitters."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_dataset
from builders.toys import NoisyField, RippleConfig, RippleField
from builders.untrained import make_field, make_params

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import hold_out_validation
from wbgs_jax.evaluation.score import calibrate_power, calibration, expectations, power_calibration
from wbgs_jax.inference.intervals import (
    FILE,
    POWER_MARGIN_DB,
    Confidence,
    Expected,
    ExpectedPower,
    PowerConfidence,
    expect_many,
    expected_power,
    expected_ssim,
    features,
    read_confidence,
    read_power_confidence,
    scaled_features,
    write_confidence,
)
from wbgs_jax.inference.kriging import for_receiver
from wbgs_jax.inference.predictor import observe_links, predict_spectra
from wbgs_jax.metrics import ssim
from wbgs_jax.training.fit_intervals import POWER_SETS, SETS, fit, interval, learn_confidence, left_out, regress, upper_end
from wbgs_jax.types import Query, make_query, make_receiver


def drawn(rng, n_tx, per_tx=5, slope=0.5, noise=0.3):
    """Features, and errors that follow the first of them and differ by transmitter."""
    tx = np.repeat(np.arange(n_tx), per_tx)
    known = rng.normal(size=(len(tx), SETS[-1]))
    error = -2 + slope * known[:, 0] + noise * rng.normal(size=len(tx))
    return known, error, tx


def test_intervals_hold_nine_of_ten_new_scores(rng):
    inside, ratios = [], []
    for _ in range(10):  # one draw of the 300 that are learned from moves the share by 0.02
        mean, scale, weights, rest = fit(*drawn(rng, 60), SETS)
        (quantiles, level), surplus = interval(rest, np.arange(len(rest))), np.exp(rest).mean()
        assert level == 0.9
        again, truth, _ = drawn(rng, 400)
        predicted = (again - mean) / scale @ weights[:-1] + weights[-1]
        inside.append(np.mean((predicted + quantiles[0] <= truth) & (truth <= predicted + quantiles[1])))
        ratios.append(np.mean(np.exp(predicted) * surplus) / np.exp(truth).mean())
    assert 0.85 < np.mean(inside) < 0.95
    assert np.mean(ratios) == pytest.approx(1, rel=0.1)


@pytest.mark.heavy
def test_what_says_nothing_is_left_out(rng):
    taken = [np.any(fit(*drawn(rng, 40, slope=0.0), SETS)[2][:-1] != 0) for _ in range(100)]
    assert sum(taken) <= 12  # by chance 3
    weights = fit(*drawn(rng, 40, slope=1.0), SETS)[2]
    assert weights[0] == pytest.approx(1.0, abs=0.25)


def test_few_transmitters_tell_of_few_features(rng):
    """Eight can say that one helps; what a fit to six of them would make of other answers has no end."""
    for _ in range(20):
        known, error, tx = drawn(rng, 8, per_tx=1, slope=1.0, noise=0.1)
        weights = fit(known, error + known[:, 1:].sum(1), tx, SETS)[2]
        assert not np.any(weights[1:-1])
    assert fit(*drawn(rng, 8, slope=1.0, noise=0.1), SETS)[2][0] == pytest.approx(1.0, abs=0.5)


def test_a_transmitter_is_not_judged_by_itself(rng):
    """Ten spectra of one transmitter that are alike are one piece of evidence."""
    known, error, tx = drawn(rng, 8, per_tx=10)
    rest = left_out(known[:, :1], error, tx)
    own = tx == 3
    weights = regress(known[~own, :1], error[~own])
    np.testing.assert_allclose(rest[own], error[own] - known[own, 0] * weights[0] - weights[1], atol=1e-9)
    assert np.isfinite(left_out(known, error, np.zeros(len(tx), int))).all()


def test_few_transmitters_have_the_level_that_exists(rng):
    """Of three the highest holds three of four, and there is no lower end; from 9 on there is one of 90 %, from 19 on two."""
    (low, high), level = interval(np.array([0.3, -1.0, 2.0]), np.arange(3))
    assert (low, high, level) == (-np.inf, 2.0, 0.75)
    assert interval(np.arange(8.0), np.arange(8))[1] == pytest.approx(8 / 9)
    (low, high), level = interval(np.arange(9.0), np.arange(9))
    assert (low, high, level) == (-np.inf, 8.0, 0.9)
    assert interval(np.arange(18.0), np.arange(18))[0][0] == -np.inf
    for count, ends in ((19, [0, 18]), (199, [9, 189])):
        quantiles, level = interval(np.arange(float(count)), np.arange(count))
        np.testing.assert_array_equal(quantiles, ends)
        assert level == 0.9
    assert upper_end(np.arange(5.0), np.arange(5)) == np.inf


@pytest.mark.parametrize("n_tx", [8, 12, 30])
@pytest.mark.parametrize("own", [0.4, 1.0])
def test_intervals_of_links_that_are_alike_hold_for_other_transmitters(n_tx, own, rng):
    """Ten links each: quantiles of all links would hold 82 to 88 % where there are 8 to 20 transmitters."""
    held = []
    for _ in range(600):
        tx = np.repeat(np.arange(n_tx + 40), 10)
        rest = rng.normal(size=n_tx + 40)[tx] + own * rng.normal(size=len(tx))
        seen = tx < n_tx
        (low, high), level = interval(rest[seen], tx[seen])
        held.append(np.mean((low <= rest[~seen]) & (rest[~seen] <= high)) - level)
    assert -0.03 < np.mean(held) < 0.03


@pytest.mark.parametrize("n_tx", [2, 3, 5, 7])
def test_intervals_of_few_transmitters_hold_for_another_one(n_tx, rng):
    """Whose spectra are alike: twenty of each say no more than how much transmitters differ."""
    held = []
    for _ in range(1000):
        tx = np.repeat(np.arange(n_tx), 20)
        error = rng.normal(size=n_tx)[tx] + 0.3 * rng.normal(size=len(tx))
        (low, high), level = interval(left_out(np.zeros((len(tx), 0)), error, tx), tx)
        new = rng.normal() + 0.3 * rng.normal() - error.mean()
        held.append((low <= new <= high) - level)
    assert -0.05 < np.mean(held) < 0.15  # what is left out is further from the others than a new one is


def test_of_one_validation_transmitter_nothing_is_said():
    dataset = tiny_dataset(9)
    one = dataset.train[dataset.tx_index[dataset.train] == dataset.tx_index[dataset.train[0]]]
    alone = dataclasses.replace(dataset, validation=np.tile(one, 8), train=np.setdiff1d(dataset.train, one))
    assert learn_confidence(make_field(), make_params(), alone, None) == (None, None)


def test_answers_of_one_expectation_are_in_no_order(rng):
    """Whatever the order of the links; two expectations are two groups."""
    scores = np.sort(rng.uniform(0.3, 0.9, 40))
    for truth in (scores, scores[::-1]):
        report = calibration(Expected(*np.full((3, 40), 0.6)), truth, 0.9)
        assert report["correlation"] == 0
        np.testing.assert_allclose(list(report["risk_coverage"].values()), truth.mean())
    two = calibration(Expected(*np.repeat([[0.4, 0.8]], 3, 0).repeat(20, 1)), scores, 0.9)
    assert two["risk_coverage"]["0.25"] == pytest.approx(scores[20:].mean())
    assert two["risk_coverage"]["1"] == pytest.approx(scores.mean()) and 0.8 < two["correlation"] < 1


def test_calibration_reports_what_it_says(rng):
    scores = rng.uniform(0.3, 0.9, 100)
    exact = Expected(*(jnp.asarray(scores + d) for d in (0, -0.1, 0.1)))
    report = calibration(exact, scores, 0.9)
    assert report["coverage"] == 1 and report["correlation"] == pytest.approx(1)
    assert report["width"] == pytest.approx(0.2, abs=0.01) and report["expected"] == pytest.approx(report["scored"])
    assert report["risk_coverage"]["1"] == pytest.approx(scores.mean())
    assert report["risk_coverage"]["0.5"] == pytest.approx(np.sort(scores)[50:].mean())
    wrong = Expected(*(jnp.asarray(1 - scores + d) for d in (0, -0.01, 0.01)))
    assert calibration(wrong, scores, 0.9)["coverage"] < 0.2 and calibration(wrong, scores, 0.9)["risk_coverage"]["0.1"] < 0.5


def test_predictions_without_an_expectation_are_not_counted(rng):
    scores = np.append(rng.uniform(0.3, 0.9, 20), -0.02)
    expected = Expected(scores.clip(0), scores.clip(0) - 0.01, scores.clip(0) + 0.01)
    expected.low[-1] = 0
    there = calibration(expected, scores, 0.9)
    assert there["coverage"] == 1  # a score below 0 counts as 0
    at_receiver = Expected(*(np.append(values, np.nan) for values in expected))
    assert calibration(at_receiver, np.append(scores, 0.1), 0.9) == there
    assert calibration(Expected(*np.full((3, 1), np.nan)), scores[:1], 0.9) is None
    errors = rng.uniform(0, 3, 20)
    powers = ExpectedPower(np.append(errors, np.nan), np.append(errors + 0.1, np.nan))
    assert power_calibration(powers, np.append(errors, 50), 0.9)["coverage"] == 1
    assert power_calibration(ExpectedPower(*np.full((2, 1), np.nan)), errors[:1], 0.9) is None


def test_a_feature_that_does_not_vary_is_left_out(rng):
    """Transmitters of a grid are equally far from the next one, up to rounding, which must not be learned from."""
    known, error, tx = drawn(rng, 40)
    known[:, 0] = np.log(0.5) + 1e-7 * known[:, 0]
    mean, scale, weights, rest = fit(known, error, tx, SETS)
    assert scale[0] == np.inf and np.isfinite(weights).all() and np.isfinite(rest).all()
    off_the_grid = np.append(np.log(0.2), known[0, 1:])
    np.testing.assert_array_equal(scaled_features(off_the_grid, mean, scale), scaled_features(known[0], mean, scale))


def test_intervals_do_not_extrapolate():
    far = np.array([[3.0, -50.0, 1e9]])
    np.testing.assert_array_equal(scaled_features(far, np.zeros(3), np.ones(3)), [[3, -4, 4]])


def test_corrected_spectra_have_intervals_where_they_are_corrected(rng, tmp_path):
    pas = jnp.asarray(rng.uniform(0, 1, (2, 90, 360)), jnp.float32)
    query = Query(jnp.ones((2, 3)), jnp.array([2.4e9, 2.5e9]))
    corrected = dataclasses.replace(confidence(), frequency_hz=jnp.array([2.4e9, 28e9]))
    everywhere, some = (expected_ssim(one, pas, query) for one in (confidence(), corrected))
    assert np.isfinite(everywhere).all()
    np.testing.assert_array_equal(np.isnan(some), [[False, True]] * 3)
    write_confidence(tmp_path, corrected)
    np.testing.assert_array_equal(read_confidence(tmp_path).frequency_hz, corrected.frequency_hz)
    arrays = {name: values for name, values in np.load(tmp_path / FILE).items() if name != "frequency_hz"}
    np.savez(tmp_path / FILE, **arrays)  # as written by earlier versions
    assert read_confidence(tmp_path).frequency_hz.shape == (0,)


@pytest.fixture(scope="module")
def dataset():
    return hold_out_validation(tiny_dataset(30))


def test_it_is_learned_from_the_validation_part_alone(dataset):
    field, params = make_field(), make_params()
    learned, _ = learn_confidence(field, params, dataset, None)
    heard = dataset.snapshots.copy()
    heard[dataset.test] = 1
    poisoned = dataset.with_observations(snapshots=heard)
    again, _ = learn_confidence(field, params, poisoned, None)
    for a, b in zip(jax.tree.leaves(learned), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    index = dataset.test
    pas = predict_spectra(field, params, dataset, index)
    expected = expect_many(learned, pas, dataset.tx_positions[index], dataset.frequencies_hz[index])
    scores = ssim(pas, np.asarray(dataset.pas(index)))
    assert abs(expected.ssim.mean() - scores.mean()) < 0.15
    assert calibration(expected, scores, 0.9)["coverage"] > 0.6


def test_answers_are_judged_as_they_would_be_observed(dataset):
    """The data are noisy and the answers are not: that is no error of theirs."""
    clean, noisy = RippleField(RippleConfig()), NoisyField(RippleConfig())
    params = clean.init(jax.random.key(1))
    said = observe_links(clean, params, dataset, np.arange(len(dataset))).pas
    observed = np.asarray(255 * noisy.as_observed(params, jnp.asarray(said))).round().astype(np.uint8)
    told = dataset.with_observations(pas=observed)
    sure, doubted = (
        expectations(learn_confidence(field, params, told, None)[0], told, told.test, said[told.test], None)
        for field in (noisy, clean)
    )
    assert sure[0].min() > 0.98 > doubted[0].mean()


def test_receivers_share_what_is_learned_and_are_asked_one_by_one():
    field, params, dataset = make_field(), make_params(), hold_out_validation(tiny_dataset(30, n_rx=2))
    learned, _ = learn_confidence(field, params, dataset, None)
    assert learned is not None and learned.rx_position.shape == (2, 3)
    own = [for_receiver(learned, dataset.receiver(number)) for number in range(2)]
    for number, one in enumerate(own):
        np.testing.assert_allclose(one.rx_position, dataset.receiver(number).position)
        np.testing.assert_array_equal(one.weights, learned.weights)
    assert for_receiver(learned, make_receiver([0.0, 0.0, 0.5])) is None
    index = dataset.validation
    pas = np.asarray(observe_links(field, params, dataset, index).pas)
    expected = expectations(learned, dataset, index, pas, None)
    for number, one in enumerate(own):
        place = np.flatnonzero(dataset.receiver_index[index] == number)
        asked = dataset.tx_positions[index[place]], dataset.frequencies_hz[index[place]]
        for together, alone in zip(expected, expect_many(one, pas[place], *asked), strict=True):
            np.testing.assert_allclose(together[place], alone, rtol=1e-6)
    elsewhere = dataclasses.replace(dataset, receivers=jax.tree.map(lambda leaf: leaf + 0.5, dataset.receivers))
    assert expectations(learned, elsewhere, index, pas, None) is None


def test_a_handful_of_spectra_say_nothing(dataset):
    field, params = make_field(), make_params()
    few = dataclasses.replace(dataset, validation=dataset.validation[:3])
    assert learn_confidence(field, params, few, None) == (None, None)


def confidence():
    k = SETS[-1]
    return Confidence(
        *(
            jnp.asarray(a, jnp.float32)
            for a in (np.zeros(3), np.eye(3), np.zeros(k), np.ones(k), np.full(k + 1, -0.1), (-1, 1), 1.2, 0.9, ())
        )
    )


def test_blocks_say_what_single_answers_do(rng):
    pas = rng.uniform(0, 1, (19, 90, 360)).astype(np.float32)
    tx, f = rng.uniform(-3, 3, (19, 3)), rng.uniform(1e9, 1e11, 19)
    query = Query(jnp.asarray(tx, jnp.float32), jnp.asarray(f, jnp.float32))
    for a, b in zip(expect_many(confidence(), pas, tx, f), expected_ssim(confidence(), jnp.asarray(pas), query), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4)
    found = expected_ssim(confidence(), jnp.asarray(pas), query)
    assert (found.low < found.high).all() and (found.high <= 1).all()
    distance = features(jnp.asarray(pas), query, jnp.zeros(3), jnp.asarray(tx, jnp.float32))[:, 0]
    assert (distance < np.log(0.02)).all()  # at known transmitters


def test_each_of_several_receivers_has_intervals_of_its_own(rng):
    places = np.array([[0.0, 0, 0], [0.5, 0, 1.0]], np.float32)
    weights = confidence().weights.at[-2:].set(jnp.array([0.1, -2.0]))
    steep = dataclasses.replace(confidence(), weights=weights, scale=jnp.full(SETS[-1], 10.0))
    both = dataclasses.replace(steep, rx_position=jnp.asarray(places))
    pas, power_db, query = rng.uniform(0, 1, (3, 90, 360)).astype(np.float32), [-70.0] * 3, make_query([[1.0, 2, 1]] * 3, 1e10)
    with pytest.raises(ValueError, match="for 2 receivers; give the queried one as receiver="):
        expected_ssim(both, pas, query, power_db)
    with pytest.raises(ValueError, match="not in the run's data"):
        expected_ssim(both, pas, query, power_db, make_receiver([0.0, 0.0, 0.5]))
    found = [expected_ssim(both, pas, query, power_db, make_receiver(place)) for place in places]
    for values, place in zip(found, places, strict=True):
        alone = expected_ssim(dataclasses.replace(steep, rx_position=jnp.asarray(place)), pas, query, power_db)
        np.testing.assert_array_equal(values, alone)
    assert not np.array_equal(found[0].ssim, found[1].ssim)
    with pytest.raises(ValueError, match=r"pas has shape \(90, 360\); expected \(3, 90, 360\)"):
        expected_ssim(steep, pas[0], query)


def test_expected_scores_lie_between_nothing_and_everything(rng):
    """A transmitter near the receiver or far away has features that no validation transmitter had."""
    pas, f = jnp.asarray(rng.uniform(0, 1, (3, 90, 360)), jnp.float32), jnp.full(3, 1e10)
    query = Query(jnp.asarray([[0.2, 0, 0], [0.11, 0, 0], [90.0, 0, 0]]), f)
    for weight in (-3.0, 3.0):
        steep = dataclasses.replace(confidence(), weights=confidence().weights.at[0].set(weight))
        found = expected_ssim(steep, pas, query, jnp.asarray([40.0, 0, -300]))
        for values in found:
            assert ((values >= 0) & (values <= 1)).all()
        assert (found.ssim == 0).any() or (found.ssim > 0.9).any()


def test_a_transmitter_at_the_receiver_has_no_interval(rng):
    pas, tx = jnp.asarray(rng.uniform(0, 1, (3, 90, 360)), jnp.float32), jnp.asarray([[0.0, 0, 0], [0.05, 0, 0], [1.0, 0, 0]])
    query = Query(tx, jnp.full(3, 1e10))
    for values in expected_ssim(confidence(), pas, query):
        np.testing.assert_array_equal(np.isnan(values), [True, True, False])
    learned = power_confidence(np.array([0.0, 0, 0, 0, 1]))
    for values in expected_power(learned, jnp.full(3, -60.0), query, jnp.zeros(3)):
        np.testing.assert_array_equal(np.isnan(values), [True, True, False])


def test_power_counts_beyond_that_of_free_space(rng):
    tx, f = rng.uniform(1, 3, (5, 3)), rng.uniform(1e9, 1e11, 5)
    pas, rx = jnp.asarray(rng.uniform(0, 1, (5, 90, 360)), jnp.float32), jnp.asarray([0.5, -1.0, 0.2])
    query = Query(jnp.asarray(tx, jnp.float32), jnp.asarray(f, jnp.float32))
    friis = 20 * np.log10(299_792_458 / (4 * np.pi * np.linalg.norm(tx - np.asarray(rx), axis=1) * f))
    beyond = features(pas, query, rx, query.tx_position, jnp.asarray(friis - 12.5, jnp.float32))[:, -1]
    np.testing.assert_allclose(beyond, -12.5, atol=1e-2)
    assert (features(pas, query, rx, query.tx_position)[:, -1] == 0).all()


def test_deep_shadows_are_doubted_and_a_power_that_is_not_given_is_the_usual_one(rng):
    pas, tx, f = rng.uniform(0, 1, (2, 90, 360)).astype(np.float32), np.ones((2, 3)), np.full(2, 1e10)
    usual = -40.0  # dB beyond free space
    weights = np.append(np.zeros(SETS[-1]), -2.0)
    weights[-2] = -0.5
    learned = dataclasses.replace(
        confidence(), mean=jnp.zeros(SETS[-1]).at[-1].set(usual), weights=jnp.asarray(weights, jnp.float32)
    )
    friis = 20 * np.log10(299_792_458 / (4 * np.pi * np.sqrt(3) * 1e10))
    lit, dark, as_usual = (expect_many(learned, pas, tx, f, np.full(2, friis + db)) for db in (0.0, -60.0, usual))
    assert (lit.ssim > as_usual.ssim).all() and (as_usual.ssim > dark.ssim).all()
    for given, none in zip(as_usual, expect_many(learned, pas, tx, f), strict=True):
        np.testing.assert_allclose(given, none, rtol=1e-3)


def test_powers_stay_as_near_as_they_should_nine_times_of_ten(rng):
    held, ratios = [], []
    for _ in range(10):
        mean, scale, weights, rest = fit(*drawn(rng, 60), POWER_SETS)
        again, truth, _ = drawn(rng, 400)
        predicted = (again - mean) / scale @ weights[:-1] + weights[-1]
        held.append(np.mean(truth <= predicted + upper_end(rest, np.arange(len(rest)))))
        ratios.append(np.mean(np.exp(predicted)) * np.exp(rest).mean() / np.exp(truth).mean())
    assert 0.85 < np.mean(held) < 0.95
    assert np.mean(ratios) == pytest.approx(1, rel=0.1)
    assert upper_end(np.array([0.3, -1.0, 2.0]), np.arange(3), 0.25) == 2
    assert upper_end(np.arange(199.0), np.arange(199)) == 179


def test_expected_errors_of_powers_follow_their_formula(rng):
    weights = np.array([0.0, -0.5, 0.0, 0.0, np.log(2.1)])
    learned = power_confidence(weights)
    query = Query(jnp.ones((2, 3)), jnp.full(2, 1e10))
    friis = 20 * np.log10(299_792_458 / (4 * np.pi * np.sqrt(3 + 1e-4) * 1e10))
    found = expected_power(learned, jnp.asarray([friis, friis - 2], jnp.float32), query, jnp.zeros(3))
    error = 2.1 * np.exp([0.0, 1.0])
    np.testing.assert_allclose(found.error_db, 1.5 * error - POWER_MARGIN_DB, rtol=1e-3)
    np.testing.assert_allclose(found.within_db, np.e * error - POWER_MARGIN_DB, rtol=1e-3)
    listed = expected_power(learned, [friis, friis - 2], query, [0.0, 0.0, 0.0])
    np.testing.assert_allclose(listed.within_db, found.within_db)
    with pytest.raises(ValueError, match=r"power_db has shape \(1,\); expected \(2,\)"):
        expected_power(learned, [friis], query, [0.0, 0.0, 0.0])
    everyone = expected_power(learned, jnp.full(2, friis), query, jnp.asarray([[0.0, 0, 0], [0.5, 0, 0]]))
    assert everyone.within_db[0] != everyone.within_db[1]  # receivers of their own


@pytest.mark.heavy
def test_confidence_of_powers_is_learned_over_all_receivers(rng):
    dataset = hold_out_validation(tiny_dataset(40, n_rx=2))
    field, params = make_field(), make_params()
    _, learned = learn_confidence(field, params, dataset, None)
    assert learned.mean.shape == (POWER_SETS[-1],)
    heard = dataset.snapshots.copy()
    heard[dataset.test] = 1
    poisoned = dataset.with_observations(snapshots=heard)
    for a, b in zip(jax.tree.leaves(learned), jax.tree.leaves(learn_confidence(field, params, poisoned, None)[1]), strict=True):
        np.testing.assert_array_equal(a, b)
    said = np.asarray(observe_links(field, params, dataset, dataset.test).power_db)
    report = calibrate_power(learned, said, dataset, dataset.test)
    assert report["coverage"] > 0.6 and report["expected"] == pytest.approx(report["scored"], rel=0.6)
    assert report["risk_coverage"]["1"] == pytest.approx(np.abs(said - dataset.received_db(dataset.test)).mean(), rel=1e-4)
    pictures = dataset.with_observations(pas=np.zeros((len(dataset), 90, 360), np.uint8))
    assert learn_confidence(field, params, pictures, None)[1] is None


def power_confidence(weights):
    k = POWER_SETS[-1]
    arrays = np.eye(3), np.zeros(k), np.ones(k), weights, 1.0, 1.5, 0.9
    return PowerConfidence(*(jnp.asarray(a, jnp.float32) for a in arrays))


def test_it_comes_back_from_a_run_folder(tmp_path):
    written = confidence(), power_confidence(np.zeros(POWER_SETS[-1] + 1))
    write_confidence(tmp_path, *written)
    again = read_confidence(tmp_path), read_power_confidence(tmp_path)
    for a, b in zip(jax.tree.leaves(written), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    (tmp_path / FILE).write_bytes(b"no archive")
    with pytest.raises(UserError, match="remove it"):
        read_confidence(tmp_path)
    of_another_version = dataclasses.replace(confidence(), mean=jnp.zeros(5), scale=jnp.ones(5), weights=jnp.zeros(6))
    write_confidence(tmp_path, of_another_version)
    with pytest.raises(UserError, match="another version; remove it"):
        read_confidence(tmp_path)
    write_confidence(tmp_path, None)
    assert read_confidence(tmp_path) is None and not (tmp_path / FILE).exists()
