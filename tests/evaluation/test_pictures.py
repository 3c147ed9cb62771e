"""Pictures: every file a readable PNG that shows something, from any run that an evaluation accepts."""

import dataclasses

import numpy as np
import pytest
from builders.synthetic import tiny_dataset
from matplotlib import pyplot as plt
from PIL import Image

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import hold_out_validation, select_frequencies
from wbgs_jax.inference.quantities import QUANTITIES, names_for
from wbgs_jax.inference.queries import Queries
from wbgs_jax.metrics import score
from wbgs_jax.plotting import (
    draw_all,
    draw_curves,
    draw_distribution,
    draw_frequencies,
    draw_maps,
    draw_motion,
    draw_prediction,
    draw_spectra,
    save,
    spread,
)

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


@pytest.mark.heavy
def test_a_whole_set_of_pictures(tmp_path, dataset):
    files = draw_all(tmp_path / "pictures", dataset, dataset.test, *predictions(dataset), CURVE)
    assert sorted(path.name for path in files) == ["curves.png", "spectra.png", "spectra_polar.png", "ssim_by_frequency.png"]
    assert sorted((tmp_path / "pictures").iterdir()) == sorted(files)
    for path in files:
        assert_shows_something(path)
    assert plt.get_fignums() == []  # nothing is left open


@pytest.mark.heavy
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


SOURCE = {
    "scene": "box",
    "field": "wave",
    "receiver": {"position": [0.0, 1.0, 2.0]},
    "interval_level": 0.9,
    "power_interval_level": 0.8,
}
PLACES, HERTZ = np.array([[1, 0.25, 1.5], [1, 0.26, 1.5]]), np.array([28e9, 60e9])
WALLS = np.array([[[0, 0], [4, 0]], [[4, 0], [4, 3]]], float)


def found_for(what, queries, rng):
    """Arrays as `wbgs-jax predict` predicts them; the second path of every link is 50 dB weaker."""
    n = len(queries)
    if what == "paths":
        positions, frequencies = queries.flat()
        link = {name: np.repeat(positions[:, k], 2) for k, name in enumerate("xyz")}
        points = np.repeat(np.stack([positions] + [np.broadcast_to(SOURCE["receiver"]["position"], (n, 3))] * 4, 1), 2, 0)
        power, tx = np.tile([-60.0, -110.0], n), np.repeat(np.arange(n), 2)
        return link | {"tx": tx, "frequency_ghz": np.repeat(frequencies / 1e9, 2), "power_db": power, "points_m": points}
    if what == "frequency-response":
        response = rng.normal(size=(n, 8, 3)) + 1j
        impulses = np.fft.ifft(response, axis=1)
        shared = {"offsets_hz": np.arange(8) * 1e6, "delays_s": np.arange(8) / 8e6}
        return {"frequency_response": response, "impulse_response": impulses} | shared
    if what == "spectra":
        return {"pas": rng.uniform(size=(n, 90, 360)), "expected": np.tile([0.9, 0.8, 0.95], (n, 1))}
    shape = {"snapshot": (n, 16), "mimo": (n, 16, 2), "angular-spread": (n, 2)}.get(what, (n,))
    values = rng.normal(size=shape) + (1j if what in ("snapshot", "mimo") else 0)
    more = {"within_db": np.full(n, 2.0)} if what == "power" else {}
    return {QUANTITIES[what].outputs[0]: values} | more


def labels(figure):
    """Names of the axes that are visible, colour bars included."""
    return [name for axis in figure.axes for name in (axis.get_xlabel(), axis.get_ylabel()) if name]


@pytest.mark.parametrize("what", names_for("predict"))
@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_every_quantity_is_drawn_with_units_and_origin(tmp_path, rng, what, suffix):
    pairs = Queries(PLACES, HERTZ, paired=True)
    queries = Queries(PLACES, HERTZ) if QUANTITIES[what].form == "scalar" else pairs
    figure = draw_prediction(what, found_for(what, queries, rng), queries, SOURCE, WALLS)
    assert figure.get_suptitle() == "box, wave field, receiver (0, 1, 2) m"
    unitless = ("normalised amplitude", "number of the")
    assert labels(figure) and all("[" in name or name.startswith(unitless) for name in labels(figure))
    path = save(figure, tmp_path / f"a{suffix}")
    assert path.read_bytes().startswith({".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[suffix])
    words = " ".join(text.get_text() for axis in figure.axes for text in [axis.title, *_legend(axis)]) + " ".join(
        labels(figure)
    )
    for place in ("0.25", "0.26"):  # a centimetre apart
        assert place in words
    assert "28 GHz" in words


def _legend(axis):
    found = axis.get_legend()
    return found.get_texts() if found else []


def test_a_curve_shows_values_and_intervals_and_a_single_point_is_none(rng):
    line = Queries(np.stack([np.linspace(0, 2, 5), np.zeros(5), np.ones(5)], -1), HERTZ[:1])
    power = np.array([-60, -61, -250.0, -63, -64])
    axis = draw_prediction("power", {"power_db": power, "within_db": np.full(5, 2.0)}, line, SOURCE, WALLS).axes[0]
    (curve,) = axis.lines
    np.testing.assert_allclose(curve.get_xdata(), [0, 0.5, 1, 1.5, 2])
    np.testing.assert_allclose(curve.get_ydata(), [-60, -61, np.nan, -63, -64])  # nothing is received at the third
    assert curve.get_linestyle() == "-" and "80 % interval" in axis.get_ylabel()
    np.testing.assert_allclose(axis.collections[0].get_paths()[0].vertices[:, 1].min(), -63)
    for queries in (Queries(PLACES[:1], HERTZ[:1]), Queries(PLACES, HERTZ, paired=True)):
        axis = draw_prediction("k-factor", {"k_factor_db": np.ones(len(queries))}, queries, SOURCE, WALLS).axes[0]
        assert (axis.lines[0].get_linestyle(), axis.lines[0].get_marker()) == ("None", "o")


def test_a_curve_over_frequencies_is_drawn_in_their_order():
    queries = Queries(PLACES[:1], np.array([60e9, 2.4e9, 28e9]))
    found = {"power_db": np.array([-70.0, -45, -60]), "within_db": np.array([3.0, 1, 2])}
    axis = draw_prediction("power", found, queries, SOURCE, WALLS).axes[0]
    np.testing.assert_allclose(axis.lines[0].get_xydata(), [[2.4, -45], [28, -60], [60, -70]])
    assert axis.collections[0].get_paths()[0].vertices[:, 1].min() == -73  # of the third one
    assert axis.get_xscale() == "log"
    near = Queries(PLACES[:1], np.array([1e9, 1.2e9]))  # powers of ten would be no ticks for these
    assert draw_prediction("k-factor", {"k_factor_db": np.ones(2)}, near, SOURCE, WALLS).axes[0].get_xscale() == "linear"


def test_elements_and_queries_are_counted_in_whole_numbers():
    one = Queries(PLACES[:1], HERTZ[:1], paired=True)
    for what, found in {"mimo": {"mimo": np.ones((1, 16, 1), complex)}, "k-factor": {"k_factor_db": np.ones(1)}}.items():
        axis = draw_prediction(what, found, one, SOURCE, WALLS).axes[0]
        assert [tick for tick in axis.get_xticks() if 0 < tick < 2] == [1], what


@pytest.mark.parametrize(("count", "beside"), [(5, False), (12, True)])
def test_a_long_legend_stands_beside_the_curves(count, beside):
    queries = Queries(np.arange(3.0 * count).reshape(count, 3), np.full(count, 28e9), paired=True)
    figure = draw_prediction("snapshot", {"snapshots": np.ones((count, 4), complex)}, queries, SOURCE, WALLS)
    figure.draw_without_rendering()
    legend, axis = figure.axes[0].get_legend().get_window_extent(), figure.axes[0].get_window_extent()
    assert (legend.x0 >= axis.x1) == beside and legend.x1 <= figure.bbox.x1


def test_responses_are_in_decibels_of_the_first_element(rng):
    found = found_for("frequency-response", Queries(PLACES[:1], HERTZ[:1]), rng)
    above, below = draw_prediction("frequency-response", found, Queries(PLACES[:1], HERTZ[:1], True), SOURCE, WALLS).axes
    x, y = above.lines[0].get_xydata().T
    np.testing.assert_allclose(x, np.arange(8))  # megahertz
    np.testing.assert_allclose(y, 20 * np.log10(np.abs(found["frequency_response"][0, :, 0])))
    x, y = below.lines[0].get_xydata().T
    np.testing.assert_allclose(x, 125 * np.arange(8))  # nanoseconds
    np.testing.assert_allclose(y, 20 * np.log10(np.abs(found["impulse_response"][0, :, 0])))


def test_paths_are_those_of_the_link_and_weak_ones_are_left_out(rng):
    queries = Queries(PLACES, HERTZ[:1])
    figure = draw_prediction("paths", found_for("paths", queries, rng), queries, SOURCE, WALLS)
    for axis, place in zip(figure.axes[:2], PLACES, strict=True):
        walls, drawn = axis.collections
        assert len(walls.get_segments()) == 2
        (one,) = drawn.get_segments()
        np.testing.assert_allclose(one[[0, -1]], [place[:2], [0, 1]])
        assert "1 of 2 paths, the strongest -60.0 dB" in axis.get_title()
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == ["receiver", "transmitter"]


def test_links_close_together_and_links_queried_twice_have_paths_of_their_own(rng):
    queries = Queries(PLACES[:1].repeat(3, 0), np.array([28e9, 28.0001e9, 28e9]), paired=True)
    figure = draw_prediction("paths", found_for("paths", queries, rng), queries, SOURCE, WALLS)
    assert ["1 of 2 paths" in axis.get_title() for axis in figure.axes[:3]] == [True] * 3


def test_links_without_paths_and_paths_without_points(tmp_path, rng):
    one = Queries(PLACES[:1], HERTZ[:1], paired=True)
    nothing = {name: values[:0] for name, values in found_for("paths", one, rng).items()}
    figure = draw_prediction("paths", nothing, one, SOURCE, WALLS)
    assert "no paths" in figure.axes[0].get_title() and save(figure, tmp_path / "a.png").stat().st_size
    del nothing["points_m"]
    with pytest.raises(UserError, match="have no points to draw"):
        draw_prediction("paths", nothing, one, SOURCE, WALLS)


def test_errors_have_a_scale_of_their_own(dataset):
    truth = np.asarray(dataset.pas(dataset.test[:2]))
    figure = draw_spectra(truth, truth + np.float32(0.01), ["a", "b"])
    assert [axis.images[0].get_clim()[1] for axis in figure.axes[:3]] == pytest.approx([1, 1, 0.01], rel=1e-4)


def test_the_distribution_counts_links_without_paths_as_lower_and_single_paths_as_higher():
    answer = {"k_factor_db": np.array([[[np.nan, 3.0], [np.inf, 1.0]]]), "frequencies_hz": HERTZ[:1]}
    (axis,) = draw_distribution("k-factor", answer | {"no_confidence": np.zeros((2, 2), bool)}, SOURCE).axes
    (curve,) = axis.lines
    assert SOURCE["scene"] in axis.get_title()
    np.testing.assert_allclose(curve.get_xydata(), [[1, 0.5], [3, 0.75]])
    single = {"k_factor_db": np.ones((1, 1, 1)), "no_confidence": np.zeros((1, 1), bool), "frequencies_hz": HERTZ[:1]}
    assert draw_distribution("k-factor", single, SOURCE).axes[0].lines[0].get_marker() == "o"


@pytest.mark.parametrize("dbm", [60.0, -20.0])
def test_what_is_received_does_not_depend_on_the_transmitted_power(dbm):
    """-300 dB of it, the first place, means that there is no path, and -240 dB that there is one."""
    received = np.array([[[[-300.0, -300.0], [-240.0, -80.0]]], [[[-300.0, -90.0], [-300.0, -300.0]]]]) + dbm
    answer = {"rsrp_dbm": received.max(0), "received_dbm": received, "tx_power_dbm": np.full(2, dbm), "height": 1.5}
    answer |= {"xs": np.arange(2.0), "ys": np.arange(2.0), "frequencies_hz": HERTZ[:1], "tx_positions": np.eye(3)[:2]}
    shown = draw_maps("rsrp", answer, WALLS, SOURCE).axes[0].images[0].get_array().filled(np.nan)
    np.testing.assert_array_equal(np.isnan(shown), [[True, False], [False, False]])
    (curve,) = draw_distribution("rsrp", answer | {"no_confidence": np.zeros((2, 2), bool)}, SOURCE).axes[0].lines
    np.testing.assert_allclose(curve.get_xydata()[:, 0], np.array([-240, -90, -80]) + dbm)


@pytest.mark.parametrize(("count", "ends"), [(8, [0, 4, -0.15, 0.35]), (1, [-0.25, 0.75, -0.4, 0.6])])
def test_a_map_of_a_single_row_is_as_high_as_its_squares(count, ends):
    answer = {"k_factor_db": np.ones((1, 1, count)), "xs": 0.25 + 0.5 * np.arange(count), "ys": np.array([0.1])}
    figure = draw_maps("k-factor", answer | {"height": 1.5, "frequencies_hz": HERTZ[:1]}, WALLS, SOURCE)
    np.testing.assert_allclose(figure.axes[0].images[0].get_extent(), ends)
    figure.draw_without_rendering()
    label = figure.axes[0].images[0].colorbar.ax.yaxis.label.get_window_extent()
    assert label.y0 >= 0 and label.y1 <= figure.bbox.y1


@pytest.mark.parametrize(
    ("outlier", "extend"), [(None, "neither"), (50.0, "max"), (-50.0, "min"), (np.inf, "max"), (np.nan, "neither")]
)
def test_a_colour_bar_has_an_arrow_where_it_saturates(outlier, extend):
    values = np.zeros((1, 20, 20))
    if outlier:
        values[0, 0, 0] = outlier
    answer = {"k_factor_db": values, "xs": np.arange(20.0), "ys": np.arange(20.0), "height": 1.5, "frequencies_hz": HERTZ[:1]}
    figure = draw_maps("k-factor", answer, WALLS, SOURCE)
    image = figure.axes[0].images[0]
    assert image.colorbar.extend == extend and np.isfinite(image.get_clim()).all()
    assert (~np.isfinite(image.get_array().filled(np.nan))).sum() == (outlier is not None and np.isnan(outlier))
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == ["receiver"]
    assert "box, wave field" in figure.get_suptitle()
