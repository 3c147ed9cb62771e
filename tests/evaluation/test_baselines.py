"""Baselines: closed forms on made-up scenes, measured figures on the published one."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from builders.synthetic import tiny_scene

from wbgs_jax._util.errors import UserError
from wbgs_jax.data import load_dataset, scene_dataset
from wbgs_jax.data.dataset import Dataset, select_frequencies, select_receivers
from wbgs_jax.evaluation import baselines as module
from wbgs_jax.evaluation.baselines import baselines
from wbgs_jax.metrics import score
from wbgs_jax.radio.array import pas_directions, snapshot_to_pas, steering_vector
from wbgs_jax.types import make_receiver, stack_receivers

N_TX, HZ = 6, np.array([1e9, 10e9, 94e9])


@pytest.fixture
def dataset(rng):
    """Six transmitters, the last two for the test, at three frequencies."""
    tx_index = np.repeat(np.arange(N_TX), len(HZ))
    q = rng.normal(size=4)
    return Dataset(
        name="den",
        receivers=stack_receivers([make_receiver(rng.normal(size=3), q)]),
        tx_positions=rng.normal(size=(N_TX, 3))[tx_index] * 4,
        frequencies_hz=np.tile(HZ, N_TX),
        receiver_index=np.zeros(len(tx_index), int),
        tx_index=tx_index,
        train=np.flatnonzero(tx_index < 4),
        validation=np.zeros(0, int),
        test=np.flatnonzero(tx_index >= 4),
        observations={
            "snapshots": (rng.normal(size=(N_TX * 3, 16)) + 1j * rng.normal(size=(N_TX * 3, 16))).astype(np.complex64)
        },
    )


def truth(dataset, index):
    return np.asarray(dataset.pas(np.atleast_1d(index)))


def test_shapes_and_names(dataset):
    predictors = baselines(dataset)
    assert list(predictors) == ["mean_image", "nearest_tx", "inverse_distance", "line_of_sight"]
    for predict in predictors.values():
        for index in (dataset.test, dataset.test[::-1][:2], dataset.test[:0]):
            predicted = predict(index)
            assert predicted.shape == (len(index), 90, 360)
            assert predicted.dtype == np.float32
            assert np.isfinite(predicted).all()


def test_the_order_of_the_questions_does_not_matter(dataset, rng):
    index = rng.permutation(dataset.test)
    for predict in baselines(dataset).values():
        at_once = predict(index)
        one_by_one = np.concatenate([predict(index[i : i + 1]) for i in range(len(index))])
        np.testing.assert_allclose(at_once, one_by_one, atol=1e-5)


def test_no_baseline_sees_the_test(dataset, rng):
    blind = dataset.with_observations(snapshots=dataset.snapshots.copy())
    blind.snapshots[dataset.test] = rng.normal(size=(len(dataset.test), 16))
    for name, predict in baselines(dataset).items():
        np.testing.assert_array_equal(predict(dataset.test), baselines(blind)[name](dataset.test))


def test_predictions_equal_their_formulas(dataset):
    predictors = baselines(dataset)
    mean = truth(dataset, dataset.train).mean(0)
    for i in dataset.test:
        same = [j for j in dataset.train if dataset.frequencies_hz[j] == dataset.frequencies_hz[i]]
        distances = np.array([np.linalg.norm(dataset.tx_positions[i] - dataset.tx_positions[j]) for j in same])
        weights = distances**-2 / (distances**-2).sum()
        expected = {
            "mean_image": mean,
            "nearest_tx": truth(dataset, same[distances.argmin()])[0],
            "inverse_distance": np.tensordot(weights, truth(dataset, np.array(same)), 1),
        }
        for name, image in expected.items():
            np.testing.assert_allclose(predictors[name](np.array([i]))[0], image, atol=2e-5, err_msg=name)


def test_blocks_change_nothing(dataset, monkeypatch):
    whole = {name: predict(dataset.test) for name, predict in baselines(dataset).items()}
    monkeypatch.setattr(module, "BLOCK", 2)
    for name, predict in baselines(dataset).items():
        np.testing.assert_allclose(predict(dataset.test), whole[name], atol=1e-5, err_msg=name)


@pytest.mark.parametrize(("test_ghz", "stand_in"), [(1.0, 10.0), (10.0, 94.0)])  # 10 is nearer to 94 in log f, to 1 in f
def test_a_frequency_that_did_not_train_is_predicted_from_the_nearest_in_log(dataset, test_ghz, stand_in):
    others = [f for f in (HZ / 1e9).tolist() if f != test_ghz]
    held_out = select_frequencies(dataset, train_ghz=others, test_ghz=[test_ghz])
    known = select_frequencies(dataset, train_ghz=[stand_in], test_ghz=[stand_in])
    for name in ("nearest_tx", "inverse_distance"):
        np.testing.assert_allclose(baselines(held_out)[name](held_out.test), baselines(known)[name](known.test), atol=1e-6)


def test_a_transmitter_that_trained_at_another_frequency_is_its_own_neighbour(dataset):
    held_out = select_frequencies(dataset, train_ghz=[1.0], test_ghz=[10.0])
    held_out = dataclasses.replace(held_out, test=held_out.train + 1)  # the same transmitters, one frequency on
    for name in ("nearest_tx", "inverse_distance"):
        np.testing.assert_allclose(baselines(held_out)[name](held_out.test), truth(dataset, held_out.train), atol=1e-5)


def test_line_of_sight_peaks_at_the_transmitter(dataset):
    """Turn a known local direction into the world by hand, put the transmitter there, find it again in the PAS."""
    local = pas_directions()[40, 250]
    w, *v = np.asarray(dataset.receiver().orientation, np.float64)
    turned = local + 2 * np.cross(v, np.cross(v, local) + w * local)  # Rodrigues' formula of the quaternion w, v
    dataset.tx_positions[:] = np.asarray(dataset.receiver().position) + 7 * turned
    pas = baselines(dataset)["line_of_sight"](dataset.test[:1])[0]
    expected = np.asarray(
        snapshot_to_pas(
            steering_vector(dataset.receiver().element_positions, jnp.asarray(local)), dataset.receiver().element_positions
        )
    )
    np.testing.assert_allclose(pas, expected, atol=1e-4)
    assert pas[40, 250] == pytest.approx(1, abs=1e-4)


def test_a_transmitter_below_the_horizon_shows_side_lobes(dataset):
    upright = dataclasses.replace(dataset, receivers=stack_receivers([make_receiver((0, 0, 0))]))
    upright.tx_positions[:] = (0, 0, -3)
    pas = baselines(upright)["line_of_sight"](upright.test[:1])[0]
    below = jnp.array([0.0, 0.0, -1.0])
    elements = upright.receiver().element_positions
    np.testing.assert_allclose(pas, np.asarray(snapshot_to_pas(steering_vector(elements, below), elements)), atol=1e-5)
    assert pas.max() == pytest.approx(1)


def test_a_transmitter_at_the_receiver_is_no_reason_to_fail(dataset):
    dataset.tx_positions[:] = np.asarray(dataset.receiver().position)
    for predict in baselines(dataset).values():
        assert np.isfinite(predict(dataset.test)).all()


def test_images_serve_as_well_as_snapshots(dataset):
    pas = truth(dataset, np.arange(len(dataset)))
    images = dataset.with_observations(pas=np.round(pas * 255).astype(np.uint8))
    for name, predict in baselines(dataset).items():
        np.testing.assert_allclose(baselines(images)[name](dataset.test), predict(dataset.test), atol=0.5 / 255 + 1e-5)


@pytest.mark.heavy
@pytest.mark.parametrize("unit", ["wavelengths", "metres"])
def test_every_receiver_is_predicted_from_its_own(unit):
    """As if it were the only one; but the mean is that of all."""
    scene = scene_dataset(tiny_scene(n_rx=3, unit=unit))
    predicted = {name: predict(scene.test) for name, predict in baselines(scene).items()}
    for number in range(3):
        alone = select_receivers(scene, [number])
        of = scene.receiver_index[scene.test] == number
        for name in ("nearest_tx", "inverse_distance", "line_of_sight"):
            np.testing.assert_allclose(predicted[name][of], baselines(alone)[name](alone.test), atol=1e-5, err_msg=name)
    np.testing.assert_allclose(predicted["mean_image"][0], truth(scene, scene.train).mean(0), atol=2e-5)


def test_a_receiver_without_training_spectra_is_named():
    scene = scene_dataset(tiny_scene(n_rx=3))
    deaf = dataclasses.replace(scene, train=scene.train[scene.receiver_index[scene.train] != 1])
    with pytest.raises(UserError, match="no training spectra for receiver 1"):
        baselines(deaf)["nearest_tx"](deaf.test)


def test_nothing_to_predict_from(dataset):
    with pytest.raises(UserError, match="no training spectra"):
        baselines(dataclasses.replace(dataset, train=dataset.train[:0]))


@pytest.mark.parametrize(
    ("name", "median", "mean"),
    [
        ("mean_image", 0.517, 0.505),
        ("nearest_tx", 0.405, 0.429),
        ("inverse_distance", 0.564, 0.553),
        ("line_of_sight", 0.343, 0.400),
    ],
)
def test_figures_of_the_published_sample(shared_data, name, median, mean):
    """SSIM on the published test split, measured independently of this code."""
    dataset = load_dataset(shared_data("wideband3dgs_example1"))
    report = score(baselines(dataset)[name](dataset.test), truth(dataset, dataset.test), dataset.frequencies_hz[dataset.test])
    assert report["n"] == 100
    assert report["median_ssim"] == pytest.approx(median, abs=0.003)
    assert report["mean_ssim"] == pytest.approx(mean, abs=0.003)
