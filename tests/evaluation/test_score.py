"""How good a field is on held-out links: figures of every kind that field and data have, and of the part that was asked for."""

import dataclasses
import json
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import FREQUENCIES_HZ, tiny_dataset
from builders.toys import NoisyField, RippleConfig, RippleField, as_trained

from wbgs_jax import metrics
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree
from wbgs_jax.data.dataset import hold_out_validation
from wbgs_jax.data.scene import in_sight
from wbgs_jax.evaluation.baselines import baselines
from wbgs_jax.evaluation.report import closing_lines, table
from wbgs_jax.evaluation.score import evaluate, held_out, power_figures, score_snapshots, watch
from wbgs_jax.fields import Observation
from wbgs_jax.inference.predictor import observe_links


@pytree
class KnowingField(RippleField):
    """Knows snapshots and powers too: waves of one amplitude, in a direction that the frequency chooses."""

    name: ClassVar[str] = "knowing"

    def render(self, params, plan, query):
        seen = super().render(params, plan, query)
        phases = query.frequency_hz[:, None] / 1e10 * jnp.arange(16)
        return Observation(seen.pas, 1e-3 * jnp.exp(1j * phases), -60 + query.tx_position[:, 0])


@pytest.fixture(scope="module")
def knowing():
    field = KnowingField(RippleConfig())
    return as_trained(field, field.init(jax.random.key(1)))


@pytest.fixture(scope="module")
def blind():
    field = RippleField(RippleConfig())
    return as_trained(field, field.init(jax.random.key(1)))


@pytest.fixture(scope="module")
def dataset():
    return tiny_dataset(n_rx=3)


def test_links_are_observed_in_their_order_whichever_receiver_they_are_of(knowing, dataset, rng):
    """A block is of one receiver; against every link by itself."""
    index = rng.permutation(len(dataset))[:20]
    seen = observe_links(knowing.field, knowing.params, dataset, index)
    assert (seen.pas.shape, seen.snapshots.shape, seen.power_db.shape) == ((20, 90, 360), (20, 16), (20,))
    for number in range(3):
        of = np.flatnonzero(dataset.receiver_index[index] == number)
        plan = knowing.field.plan(knowing.params, dataset.receiver(number))
        alone = knowing.field.render(knowing.params, plan, dataset.query(index[of]))
        assert seen.covariance is None is alone.covariance
        for own, expected in zip(seen[:3], alone[:3], strict=True):
            np.testing.assert_allclose(own[of], expected, rtol=1e-5, atol=1e-6)
    empty = observe_links(knowing.field, knowing.params, dataset, index[:0])
    assert empty.pas.shape == (0, 90, 360)


@pytest.mark.heavy
def test_a_report_holds_all_that_field_and_data_know(knowing, blind, dataset):
    report, predicted = evaluate(knowing, dataset, timed=True)
    assert (report["scene"], report["field"], report["part"], report["n"]) == ("box", "knowing", "test", len(dataset.test))
    seen = observe_links(knowing.field, knowing.params, dataset, dataset.test)
    np.testing.assert_array_equal(predicted, seen.pas)
    truth, frequencies = np.asarray(dataset.pas(dataset.test)), dataset.frequencies_hz[dataset.test]
    known = truth, frequencies, in_sight(dataset, dataset.test), dataset.receiver().element_positions
    for key, value in metrics.score(predicted, *known).items():
        assert report[key] == value
    for key, value in score_snapshots(seen.snapshots, dataset.snapshots[dataset.test]).items():
        assert report[key] == value
    assert report["power"] == power_figures(seen.power_db, dataset, dataset.test)
    assert report["baselines"].keys() == baselines(dataset).keys()
    nearest = metrics.score(baselines(dataset)["nearest_tx"](dataset.test), *known)
    assert report["baselines"]["nearest_tx"] == nearest
    assert report["ms_per_pas"] > 0 and report["ms_per_pas_single"] > 0
    json.dumps(report, allow_nan=False)
    assert not {"snapshot_correlation", "power_error_db", "power", "ms_per_pas"} & evaluate(blind, dataset)[0].keys()


def test_answers_are_scored_with_the_noise_of_the_training_too(blind, dataset):
    report, predicted = evaluate(dataclasses.replace(blind, field=NoisyField(RippleConfig())), dataset)
    alike = metrics.ssim(np.sqrt((predicted**2 + 0.3) / 1.3), np.asarray(dataset.pas(dataset.test)))
    assert report["as_observed"] == pytest.approx({"median_ssim": np.median(alike), "mean_ssim": np.mean(alike)}, abs=1e-5)
    assert report["mean_ssim"] != pytest.approx(np.mean(alike), abs=1e-3)
    said = f"with the noise of the training spectra: {np.median(alike):.3f} / {np.mean(alike):.3f}"
    assert any(said in line for line in closing_lines(report, 8))
    assert "as_observed" not in evaluate(blind, dataset)[0]


def test_powers_are_scored_where_there_is_nothing_else(knowing, blind):
    powers = tiny_dataset(n_rx=3, kind="power")
    report, _ = evaluate(knowing, powers)
    error = np.abs(-60 + powers.tx_positions[powers.test, 0] - powers.power_db[powers.test])
    assert report["power_error_db"] == pytest.approx(np.median(error), rel=1e-5)
    assert "median_ssim" not in report and report["baselines"].keys() == {"free_space", "nearest_tx"}
    assert [row["frequency_ghz"] for row in report["per_frequency"]] == (FREQUENCIES_HZ / 1e9).tolist()
    assert watch(knowing.field, knowing.params, powers, powers.test) == {"held_out_power_error_db": report["power_error_db"]}
    with pytest.raises(UserError, match="received powers, which this field does not predict"):
        evaluate(blind, powers)


def test_the_validation_part_is_scored_by_itself(knowing, dataset):
    split = hold_out_validation(dataset, 0.4)
    report, predicted = evaluate(knowing, split, "validation")
    assert report["part"] == "validation" and report["n"] == len(split.validation) == len(predicted)
    expected = metrics.ssim(predicted, np.asarray(split.pas(split.validation)))
    assert report["median_ssim"] == np.median(expected)
    assert watch(knowing.field, knowing.params, split, split.validation) == {"held_out_ssim": report["median_ssim"]}
    np.testing.assert_array_equal(held_out(split, "test"), dataset.test)
    with pytest.raises(UserError, match="box has no validation spectra"):
        evaluate(knowing, dataset, "validation")


def test_data_to_test_with_alone_have_no_baselines(knowing, dataset):
    everything = np.arange(len(dataset))
    report, _ = evaluate(
        knowing, dataclasses.replace(dataset, train=everything[:0], validation=everything[:0], test=everything)
    )
    assert report["n"] == len(dataset) and report["baselines"] == {}
    assert table(report).row_count and closing_lines(report, 8)


def test_snapshots_are_scored_by_their_correlation_and_their_power(rng):
    truth = rng.normal(size=(5, 16)) + 1j * rng.normal(size=(5, 16))
    turned = truth * np.exp(1j * rng.uniform(0, 6, (5, 1))) * 10 ** (np.array([[1], [-2], [3], [-4], [5]]) / 20)
    figures = score_snapshots(turned.astype(np.complex64), truth.astype(np.complex64))
    assert figures["snapshot_correlation"] == pytest.approx(1, abs=1e-5)
    assert figures["power_error_db"] == pytest.approx(3, abs=1e-4)
    silent = truth * [[1], [1], [0], [0], [0]]
    assert score_snapshots(turned.astype(np.complex64), silent)["power_error_db"] == pytest.approx(1.5, abs=1e-4)
    assert score_snapshots(turned.astype(np.complex64), 0 * truth) == {}, "nothing was heard"
    orthogonal = np.linalg.qr(np.stack([truth[0], rng.normal(size=16)], 1))[0].T
    assert score_snapshots(orthogonal[:1], orthogonal[1:])["snapshot_correlation"] == pytest.approx(0, abs=1e-5)
