"""The viewer without a browser: its queries, what it draws, its words (tests/viewer/test_browser.py opens one)."""

import base64
import dataclasses
import io
import re
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from builders.commands import assert_error_for_people, call
from builders.untrained import make_coherent_run, make_run
from PIL import Image

from wbgs_jax._util.errors import UserError
from wbgs_jax.commands import view
from wbgs_jax.inference.evaluate_quantities import LoadedField
from wbgs_jax.inference.predictor import make_predictor
from wbgs_jax.radio.array import SPEED_OF_LIGHT, pas_directions
from wbgs_jax.training.run_folder import load_trained
from wbgs_jax.types import make_receiver
from wbgs_jax.viewer import figures, panel, session
from wbgs_jax.viewer.app import Latest
from wbgs_jax.viewer.page import Page
from wbgs_jax.viewer.session import LinkBudget, Session
from wbgs_jax.viewer.surroundings import FIELD_OF_VIEW, camera_of

PLACE, HZ = np.array([0.4, -0.3, 1.2]), 10e9
BUDGET = LinkBudget(20.0, -87.0)


@pytest.fixture(scope="module")
def coherent(tmp_path_factory):
    trained = load_trained(make_coherent_run(tmp_path_factory.mktemp("view") / "box"))
    dataset = trained.dataset()
    return Session(LoadedField(trained, dataset, dataset.receiver()))


@pytest.fixture(scope="module")
def splatting(tmp_path_factory):
    trained = load_trained(make_run(tmp_path_factory.mktemp("view") / "box"))
    dataset = trained.dataset()
    return Session(LoadedField(trained, dataset, dataset.receiver()))


@pytest.mark.heavy
def test_an_answer_is_the_fields(coherent):
    answer = coherent.predict(PLACE, HZ)
    np.testing.assert_allclose(answer.pas, make_predictor(coherent.trained)(PLACE, HZ), atol=1e-5)
    assert answer.warnings == () and not answer.outside
    away = coherent.predict(np.array([90.0, 0, 1]), HZ)
    assert away.outside and "outside" in away.warnings[0]


@pytest.mark.heavy
def test_paths_run_from_transmitter_to_receiver_over_their_length(coherent):
    paths = coherent.predict(PLACE, HZ).paths
    rx = np.asarray(coherent.receiver.position)
    np.testing.assert_allclose(paths.points[:, 0], np.tile(PLACE, (len(paths.points), 1)), atol=1e-5)
    np.testing.assert_allclose(paths.points[:, -1], np.tile(rx, (len(paths.points), 1)), atol=1e-5)
    legs = np.linalg.norm(np.diff(paths.points, axis=1), axis=-1).sum(1)
    np.testing.assert_allclose(legs, paths.length, rtol=1e-4)
    assert (np.diff(paths.power_db) <= 1e-5).all() and len(paths.words) == len(paths.power_db) > 1


def test_the_nearest_sample_is_the_datas(coherent):
    data = coherent.dataset
    link = int(data.test[0])
    sample = coherent.nearest_sample(data.tx_positions[link] + 1e-4, data.frequencies_hz[link])
    np.testing.assert_array_equal(sample.pas, np.asarray(data.pas(np.array([link])))[0])
    assert sample.part == "test" and sample.distance_m < 1e-3 and -1 <= sample.ssim <= 1


def test_a_late_sample_is_not_one_of_changed_materials(coherent, monkeypatch):
    """Another thread changes a material while a sample is computed: the next question computes it anew."""
    one, asked = Session(coherent.loaded), []
    compute = one._sample

    def slowly(link):
        asked.append(one.version)
        if len(asked) == 1:
            one._changed()
        return compute(link)

    monkeypatch.setattr(one, "_sample", slowly)
    for _ in range(3):
        one.nearest_sample(PLACE, HZ)
    assert len(asked) == 2 and asked[1] == asked[0] + 1


def test_changed_materials_have_no_interval(coherent):
    one = Session(coherent.loaded)
    assert not one.altered and not one.predict(PLACE, HZ).warnings
    one.change_material(0, 3.0, 1e-3)
    answer = one.predict(PLACE, HZ)
    assert answer.expected is None and answer.within_db is None and "materials are not as trained" in answer.warnings[-1]
    one.restore()
    assert not one.altered and not one.predict(PLACE, HZ).warnings


def test_typed_numbers_stay_within_the_limits_of_their_control():
    for typed, used in ((0, 0.05), (0.3, 0.3), (9, 2.0)):
        assert panel.number(SimpleNamespace(value=typed, min=0.05, max=2.0)) == used


def test_a_sample_is_compared_with_what_would_be_observed(coherent, monkeypatch):
    one = Session(dataclasses.replace(coherent.loaded, trained=coherent.trained))
    truth = coherent.dataset.pas(coherent.dataset.test[:1])
    monkeypatch.setattr(session, "as_observed", lambda field, params, pas: np.asarray(truth))
    link = int(coherent.dataset.test[0])
    sample = one.nearest_sample(coherent.dataset.tx_positions[link], coherent.dataset.frequencies_hz[link])
    assert sample.ssim == pytest.approx(1, abs=1e-5)


def test_another_material_is_seen_at_once_and_taken_back(coherent):
    before, version = coherent.predict(PLACE, HZ).power_db, coherent.version
    names, properties = coherent.materials()
    assert len(names) == len(properties.permittivity)
    for number in range(len(names)):
        coherent.change_material(number, 1.01, 1e7)
    metal = coherent.predict(PLACE, HZ).power_db
    assert abs(metal - before) > 0.1 and coherent.version == version + len(names)
    coherent.restore()
    assert coherent.predict(PLACE, HZ).power_db == before


def test_another_thickness_is_seen_at_once_where_the_data_know_one_and_taken_back(coherent):
    """Of panes that are half a wavelength thick, which reflect least, and a quarter of one, which reflect most."""
    before, plan = coherent.predict(PLACE, HZ).power_db, coherent.plan
    found = []
    for share in (0.5, 0.25):
        for number in range(len(coherent.materials()[0])):
            coherent.change_material(number, 6.0, 1e-3)
            coherent.change_thickness(number, share * SPEED_OF_LIGHT / HZ / np.sqrt(6))
        found.append(coherent.predict(PLACE, HZ).power_db)
    assert abs(found[1] - found[0]) > 0.01
    assert coherent.materials()[1].thickness == pytest.approx(0.25 * SPEED_OF_LIGHT / HZ / np.sqrt(6))
    planned = dataclasses.replace(coherent.loaded, trained=coherent.trained)  # as for maps: planned with that thickness
    anew = Session(planned)
    assert anew.predict(PLACE, HZ).power_db == pytest.approx(found[1], abs=1e-4)
    coherent.restore()
    assert coherent.predict(PLACE, HZ).power_db == before and coherent.plan is plan


@pytest.mark.heavy
def test_gaussians_have_what_blending_uses(splatting, coherent):
    found = splatting.gaussians(PLACE, HZ)
    assert found.attenuation.shape == found.signal.shape == (len(found.gaussians.means), 1)
    assert ((found.attenuation >= 0) & (found.attenuation <= 1)).all()
    assert coherent.gaussians(PLACE, HZ) is None and splatting.predict(PLACE, HZ).paths is None


def test_a_dome_is_brightest_where_the_spectrum_is(rng):
    pas = np.zeros((90, 360))
    row, column = 32, 60  # multiples of the stride
    pas[row, column] = 1
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points, colors = figures.dome(pas, turn, 2.0)
    brightest = int(np.argmax(np.linalg.norm(points, axis=1)))
    np.testing.assert_allclose(points[brightest], 2.0 * turn @ pas_directions()[row, column], atol=1e-5)
    assert colors[brightest].sum() > colors[0].sum()


def test_pictures_of_maps_are_clear_where_nothing_is_received(rng):
    values = rng.uniform(-90, -50, (4, 6))
    values[0, 0] = np.nan
    low, high = figures.map_range(values)
    picture, dim = figures.map_picture(values, low, high), figures.map_picture(values, low, high, dim=True)
    assert picture.shape == (4, 6, 4) and picture[-1, 0, 3] == 0 and picture[0, 0, 3] > dim[0, 0, 3] > 0  # largest y on top
    assert -91 < low < high < -49


def test_weak_paths_fade_and_paths_without_power_are_not_listed(coherent, monkeypatch):
    power = np.array([-60.0, -99.0, -110.0, -130.0])
    for by_power in (True, False):
        colors = figures.path_colors(power, np.zeros(4, int), by_power).astype(int)
        away = np.linalg.norm(colors - 255, axis=1)
        assert away[1] > 2 * away[3] and away[2] > away[3]
    count = len(coherent.predict(PLACE, HZ).paths.power_db)
    monkeypatch.setattr(session, "decibels", lambda power: jnp.where(jnp.arange(len(power)) % 2 == 0, -300.0, -60.0))
    fewer = coherent.predict(PLACE, HZ).paths.power_db
    assert 0 < len(fewer) < count and (fewer > -250).all()
    monkeypatch.setattr(session, "decibels", lambda power: jnp.full(len(power), -300.0))
    silent = coherent.predict(PLACE, HZ)
    words = panel.summary(silent, HZ, BUDGET, True)
    assert len(silent.paths.power_db) == 0 and "K-factor" not in words
    assert "No path" in panel.channel_figures(silent.paths, BUDGET, 100.0)


def test_received_power_is_absolute(coherent):
    answer = coherent.predict(PLACE, HZ)
    for budget in (BUDGET, LinkBudget(-3.0, -90.0)):
        words = panel.summary(answer, HZ, budget, True)
        assert f"{answer.power_db + budget.transmitter_dbm:.1f} dBm" in words
        assert f"{answer.power_db + budget.transmitter_dbm - budget.noise_dbm:.1f} dB<" in words
    nothing = dataclasses.replace(answer, power_db=None)
    assert "nothing is received" in panel.summary(nothing, HZ, BUDGET, True)


def test_intervals_are_shown_only_where_they_hold(coherent):
    answer = dataclasses.replace(
        coherent.predict(PLACE, HZ), expected=(0.9, 0.8, 0.95), level=0.9, within_db=1.5, power_level=0.9
    )
    assert "90 % between 0.80 and 0.95" in panel.summary(answer, HZ, BUDGET, True)
    assert "± 1.5 dB (90 %)" in panel.summary(answer, HZ, BUDGET, True)
    for place, hertz in ((np.array([90.0, 0, 1]), HZ), (PLACE, 0.4e9)):
        found = coherent.predict(place, hertz)
        assert found.expected is None and found.within_db is None and found.warnings
        words = panel.summary(found, hertz, BUDGET, True)
        assert "between" not in words and "±" not in words and "wbgs-warning" in words


def test_the_frequency_response_is_the_sum_of_the_paths(coherent):
    """At the carrier that of an element, and one path alone is flat."""
    paths = coherent.predict(PLACE, HZ).paths
    found = paths.frequency_response_db(np.array([-5e7, 0.0, 5e7]))
    assert found[1] == pytest.approx(20 * np.log10(abs(paths.amplitude.sum())), abs=1e-3) and np.ptp(found) > 1e-3
    parts = {part.name: getattr(paths, part.name) for part in dataclasses.fields(paths)}
    single = type(paths)(**{name: part[:1] if hasattr(part, "__len__") else part for name, part in parts.items()})
    assert np.ptp(single.frequency_response_db(np.linspace(-1e8, 1e8, 9))) < 1e-4
    drawn = panel.channel_figures(paths, BUDGET, 100.0)
    assert drawn.count("<svg") == 2 and "offset from the carrier [MHz]" in drawn and "delay [ns]" in drawn


def test_paths_are_listed_with_a_power_scale_and_the_marked_one_first(coherent):
    paths = coherent.predict(PLACE, HZ).paths
    drawn = panel.path_list(paths, 4, 2, BUDGET, True)
    assert drawn.count("<tr") == 5 and "power [dBm]" in drawn and "fade" in drawn
    first = drawn[drawn.index("chosen") :]
    assert f"{paths.power_db[2] + 20:.1f}" in first[:80] and f"{paths.length[2]:.2f} m long" in drawn
    assert "three" in panel.path_list(paths, 4, None, BUDGET, False) and "A click" in panel.path_list(paths, 4, 9, BUDGET, True)
    assert "does not predict paths" in panel.path_list(None, 4, None, BUDGET, True)


def test_a_receiver_is_moved_where_the_field_allows_it(coherent, splatting):
    assert coherent.movable and not splatting.movable
    assert panel.receiver_names(coherent)[-1] == panel.MOVED and panel.MOVED not in panel.receiver_names(splatting)
    before, receiver = coherent.predict(PLACE, HZ).power_db, coherent.receiver
    coherent.use_receiver(dataclasses.replace(receiver, position=receiver.position + jnp.asarray([0.3, 0.2, 0.1])))
    moved = coherent.predict(PLACE, HZ)
    assert abs(moved.power_db - before) > 0.01
    np.testing.assert_allclose(moved.paths.points[0, -1], np.asarray(coherent.receiver.position), atol=1e-5)
    coherent.use_receiver(receiver)
    assert coherent.predict(PLACE, HZ).power_db == before
    with pytest.raises(UserError, match="only the receivers that it was trained with"):
        splatting.use_receiver(make_receiver([0.0, 0.0, 0.5]))


@pytest.mark.parametrize(("low", "high"), [(0.7, 2.5), (-0.003, 2.4), (1.5, 1.5)])
def test_the_panel_opens_for_a_room_of_any_height(low, high, coherent):
    """Heights in single precision, which may be just below those with two decimals."""
    page = Page(port=0)
    try:
        controls, _ = panel.make_panel(page.server, coherent, PLACE, (float(np.float32(low)), high), high)
        assert controls.cut.min <= controls.cut.value[0] and controls.cut.value[1] <= controls.cut.max
    finally:
        page.stop()


def test_the_truth_is_that_of_the_same_array(splatting, monkeypatch):
    assert len(splatting._links_with_spectra())
    turned = dataclasses.replace(splatting.receiver, orientation=jnp.array([0.8, 0, 0, 0.6]))
    monkeypatch.setattr(splatting, "receiver", turned)
    assert not len(splatting._links_with_spectra())


def grey(drawn):
    """Returns the pixels of the only image of a figure."""
    (encoded,) = re.findall(r'href="data:image/png;base64,([^"]+)"', drawn)
    with Image.open(io.BytesIO(base64.b64decode(encoded))) as image:
        return np.asarray(image)


def test_a_spectrum_has_axes_and_a_colour_bar_and_holds_its_values(rng):
    pas = rng.uniform(0, 1, (90, 360)).astype(np.float32)
    drawn = figures.spectrum(pas, "predicted")
    np.testing.assert_allclose(grey(drawn) / 255, pas, atol=0.5 / 255 + 1e-6)
    for words in ("azimuth [°]", "zenith [°]", "amplitude", ">-180<", ">90<", ">0.5<"):
        assert words in drawn


def test_a_map_has_axes_in_metres_and_no_colour_where_nothing_is_received(rng):
    values = rng.uniform(-80, -40, (3, 5))
    values[0, 1] = np.nan
    ranges = (-2.0, 3.0, "x [m]"), (0.0, 3.0, "y [m]"), (-80.0, -40.0, "received [dBm]")
    axes = tuple(figures.axis_over(*one) for one in ranges)
    drawn = figures.power_map(values, *axes, np.zeros((1, 2, 2)), {"T": (0.0, 1.0)})
    pixels = grey(drawn)
    assert pixels.shape == (3, 5, 2) and pixels[2, 1, 1] == 0 and (pixels[..., 1] == 0).sum() == 1
    np.testing.assert_allclose(pixels[0, :, 0] / 255, (values[2] + 80) / 40, atol=0.51 / 255)
    assert "x [m]" in drawn and "received [dBm]" in drawn and ">-60<" in drawn


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-83.7, -41.2), (0.0, 87.0), (-50.0, 50.0), (3.0, 3.0)])
def test_ticks_are_few_and_round_and_within(low, high):
    axis = figures.axis_over(low, high, "x [m]")
    assert 2 <= len(axis.ticks) <= 8 and all(axis.low - 1e-9 <= tick <= axis.high + 1e-9 for tick in axis.ticks)
    assert all(len(f"{tick:g}") <= 5 for tick in axis.ticks)


@pytest.mark.parametrize(("aspect", "window"), [(1.1, (0.0, 0.0, 0.88, 0.88)), (0.46, (0.0, 0.5, 0.9, 0.4))])
def test_the_camera_sees_the_whole_room(aspect, window):
    box, up = np.array([[-5.0, -3, 0], [5, 4, 3]]), np.array([0.0, 0, 1])
    position, target = camera_of(box, np.array([-0.1, -0.5, 0.6]), up, aspect, window)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    corners = np.array([[x, y, z] for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]]) - position
    depth, slope = corners @ forward, np.tan(FIELD_OF_VIEW / 2)
    seen = np.stack([corners @ right / aspect, corners @ np.cross(right, forward)], -1) / depth[:, None] / slope
    assert (np.abs(seen - window[:2]) <= np.array(window[2:]) + 0.03).all()
    assert np.abs(seen - window[:2]).max(0).max() > 0.8 * min(window[2:])  # and not from far away


def test_words_of_a_map_name_what_it_is_of():
    assert "at 28 GHz, transmitters at z = 1.50 m" in panel.map_caption((28e9, 1.5), False, None, None)
    old = panel.map_caption((28e9, 1.5), True, 0.4, (1.0, 2.0, np.nan))
    assert "An older map" in old and "40 %" in old and "nothing is received" in old


def test_path_segments_leave_out_what_is_filled_up():
    points = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 0], [1, 1, 0.0]]])
    segments, ends = figures.path_segments(points, np.array([[1, 2, 3]], np.uint8))
    assert segments.shape == ends.shape == (2, 2, 3)
    np.testing.assert_array_equal(figures.path_handles(points), [[1, 0, 0]])


def test_a_walk_is_as_long_as_its_way_and_closed(rng):
    way = session.stops_of_walk(rng.normal(size=(30, 3)))
    total = np.linalg.norm(np.diff(np.concatenate([way, way[:1]]), axis=0), axis=1).sum()
    np.testing.assert_allclose(session.place_on_walk(way, 0.3), session.place_on_walk(way, total + 0.3), atol=1e-9)
    steps = np.array([session.place_on_walk(way, s) for s in np.linspace(0, total, 2001)])
    assert np.linalg.norm(np.diff(steps, axis=0), axis=1).max() <= total / 2000 * (1 + 1e-6)


def test_only_the_newest_request_is_worked_on():
    import threading

    done, gate = [], threading.Event()
    wanted = [0]

    def work():
        gate.wait(5)
        done.append(wanted[0])

    latest = Latest(work)
    for number in range(1, 20):
        wanted[0] = number
        latest.request()
    gate.set()
    latest.wait()
    latest.stop()
    assert done[-1] == 19 and len(done) <= 2


def test_marks_leave_room_for_their_numbers():
    ghz = np.array([1, 2.4, 5, 10, 24.25, 37, 47, 60, 77, 94])
    marks = panel.marks_at(ghz, 0.3, 100.0)
    written = [mark[0] for mark in marks if isinstance(mark, tuple)]
    assert len(marks) == 10 and len(written) >= 4 and min(np.diff(written)) > panel.LABEL_ROOM * 99.7


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--html", "scene.htm"], "does not end in .html"),
        (["--port", "70000"], "is not a port"),
        (["--run", "nowhere"], "not a run"),
    ],
)
def test_errors_are_for_people(options, says, tmp_path):
    run = [] if "--run" in options else ["--run", tmp_path]
    assert_error_for_people(call(view.main, *run, *options), says)


def test_a_page_opens_without_python(tmp_path):
    run = make_coherent_run(tmp_path / "box")
    page = tmp_path / "scene.html"
    done = call(view.main, "--run", run, "--html", page, "--tx", "0.4,-0.3,1.2", "--ghz", "28", "--port", "0")
    assert done.code == 0, done.err
    text = page.read_text()
    assert text.lstrip().lower().startswith("<!doctype html") and "__VISER_EMBED_DATA__" in text


def test_electrical_properties_are_those_that_were_set(coherent):
    changed = coherent.trained.field.with_material(coherent.trained.params, 0, 3.5, 0.2)
    found = coherent.trained.field.material_properties(changed)
    assert found.permittivity[0] == pytest.approx(3.5, rel=1e-5) and found.conductivity[0] == pytest.approx(0.2, rel=1e-5)
    assert dataclasses.is_dataclass(changed) and bool(jnp.isfinite(changed.materials.slope).all())
