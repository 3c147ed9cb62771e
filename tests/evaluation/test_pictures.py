"""Pictures: every file a readable PNG that shows something, from any run that an evaluation accepts."""

import dataclasses

import numpy as np
import pytest
from builders.synthetic import tiny_dataset
from matplotlib import pyplot as plt
from PIL import Image

from wbgs_jax.data.splits import hold_out_validation, select_frequencies
from wbgs_jax.metrics import score
from wbgs_jax.plotting import draw_all, draw_curves, draw_frequencies, draw_motion, draw_spectra, spread

CURVE = [
    {"step": 2, "loss": 0.3, "batch_ssim": 0.2, "gaussians": 60, "seconds": 1.0},
    {"step": 4, "density": {"cloned": 1, "split": 2, "pruned": 3, "alive": 60}},
    {"step": 4, "loss": 0.2, "batch_ssim": 0.4, "gaussians": 60, "seconds": 2.0, "held_out_ssim": 0.35},
]


@pytest.fixture(scope="module")
def dataset():
    return tiny_dataset(4)


def predictions(dataset):
    """Spectra, truth and the report of an evaluation."""
    truth = np.asarray(dataset.pas(dataset.test))
    predicted = np.clip(truth + 0.1 * np.sin(np.arange(360)), 0, 1).astype(np.float32)
    report = {"scene": dataset.name, "field": "wideband"} | score(predicted, truth, dataset.frequencies_hz[dataset.test])
    return predicted, report | {"baselines": {"mean_image": score(truth[::-1], truth, dataset.frequencies_hz[dataset.test])}}


def assert_shows_something(path):
    with Image.open(path) as image:
        assert image.format == "PNG" and min(image.size) > 200
        pixels = np.asarray(image.convert("RGB"), float)
    assert pixels.std() > 10 and len(np.unique(pixels.reshape(-1, 3), axis=0)) > 50


def test_a_whole_set_of_pictures(tmp_path, dataset):
    files = draw_all(tmp_path / "pictures", dataset, dataset.test, *predictions(dataset), CURVE)
    assert sorted(path.name for path in files) == ["curves.png", "spectra.png", "spectra_polar.png", "ssim_by_frequency.png"]
    assert sorted((tmp_path / "pictures").iterdir()) == sorted(files)
    for path in files:
        assert_shows_something(path)
    assert plt.get_fignums() == []  # nothing is left open


def test_a_single_frequency_without_curves(tmp_path, dataset):
    single = select_frequencies(dataset, train_ghz=[10.0], test_ghz=[10.0])
    files = draw_all(tmp_path, single, single.test, *predictions(single), [])
    assert "curves.png" not in {path.name for path in files}
    for path in files:
        assert_shows_something(path)


def test_spectra_show_truth_prediction_and_error(dataset):
    predicted, _ = predictions(dataset)
    truth = np.asarray(dataset.pas(dataset.test))
    figure = draw_spectra(truth[:2], predicted[:2], ["a", "b"])
    panels = [axis.images[0].get_array() for axis in figure.axes if axis.images]
    for row in range(2):
        shown = panels[3 * row : 3 * row + 3]
        for got, want in zip(shown, (truth[row], predicted[row], abs(truth[row] - predicted[row])), strict=True):
            np.testing.assert_allclose(got, want, atol=1e-6)
    plt.close(figure)


def test_curves_show_the_logged_numbers():
    figure = draw_curves(CURVE)
    lines = [line.get_xydata().tolist() for axis in figure.axes for line in axis.lines]
    assert lines == [[[2, 0.3], [4, 0.2]], [[2, 0.2], [4, 0.4]], [[4, 0.35]], [[2, 60], [4, 60]]]
    plt.close(figure)


def test_curves_of_any_field_are_drawn():
    """Without batch figures, without sizes that change, of powers."""
    entries = [{"step": 2, "loss": 9.0, "parameters": 7}, {"step": 4, "loss": 4.0, "held_out_power_error_db": 1.5}]
    figure = draw_curves(entries)
    assert [[line.get_xydata().tolist() for line in axis.lines] for axis in figure.axes] == [[[[2, 9], [4, 4]]], [[[4, 1.5]]]]
    assert figure.axes[1].get_legend().get_texts()[0].get_text() == "held out power error db"
    unwatched = draw_curves([{"step": 2, "loss": 9.0, "batch_ssim": None}])
    assert [len(axis.lines) for axis in unwatched.axes] == [1, 0]


def test_frequencies_show_the_field_and_every_baseline(dataset):
    _, report = predictions(dataset)
    figure = draw_frequencies(report)
    (axis,) = figure.axes
    assert [line.get_label().split(":")[0] for line in axis.lines] == ["wideband", "mean image"]
    np.testing.assert_allclose(axis.lines[0].get_ydata(), [row["median_ssim"] for row in report["per_frequency"]])
    plt.close(figure)


def test_the_chosen_spectra_are_the_same_for_every_run_and_cover_the_band(dataset):
    chosen = spread(dataset, dataset.test)
    np.testing.assert_array_equal(chosen, spread(dataclasses.replace(dataset, name="again"), dataset.test))
    assert set(dataset.frequencies_hz[dataset.test[chosen]]) == set(dataset.frequencies_hz)


def test_the_chosen_spectra_are_of_the_part_that_is_shown():
    split = hold_out_validation(tiny_dataset(), 0.4)
    chosen = split.validation[spread(split, split.validation)]
    assert len(chosen) == 6 and set(chosen) <= set(split.validation.tolist())
    assert set(split.frequencies_hz[chosen]) == set(split.frequencies_hz)


def test_surfaces_that_were_moved(tmp_path, rng):
    corners = rng.uniform(0, 5, (12, 4, 3))
    still = draw_motion(tmp_path, corners, np.zeros((12, 3))).read_bytes()
    moved = draw_motion(tmp_path, corners, rng.normal(0, 0.02, (12, 3))).read_bytes()
    assert still[:8] == moved[:8] == b"\x89PNG\r\n\x1a\n" and still != moved
