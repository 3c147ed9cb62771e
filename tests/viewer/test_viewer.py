"""The viewer: what it asks, what it draws, and a real browser in which a transmitter is dragged."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from builders.commands import assert_error_for_people, call
from builders.untrained import make_coherent_run, make_run

from experiments.studies.viewer_pictures import chromium, drag, window
from wbgs_jax.commands import view
from wbgs_jax.inference.evaluate_quantities import LoadedField
from wbgs_jax.inference.predictor import make_predictor
from wbgs_jax.radio.array import SPEED_OF_LIGHT, pas_directions
from wbgs_jax.training.run_folder import load_trained
from wbgs_jax.viewer import drawing, panel, session, walk
from wbgs_jax.viewer.app import Latest
from wbgs_jax.viewer.session import Asker

PLACE, HZ = np.array([0.4, -0.3, 1.2]), 10e9
DRAGS = 10
"""Times that the mouse tries."""


@pytest.fixture(scope="module")
def coherent(tmp_path_factory):
    trained = load_trained(make_coherent_run(tmp_path_factory.mktemp("view") / "box"))
    dataset = trained.dataset()
    return Asker(LoadedField(trained, dataset, dataset.receiver()))


@pytest.fixture(scope="module")
def splatting(tmp_path_factory):
    trained = load_trained(make_run(tmp_path_factory.mktemp("view") / "box"))
    dataset = trained.dataset()
    return Asker(LoadedField(trained, dataset, dataset.receiver()))


@pytest.mark.heavy
def test_an_answer_is_the_fields(coherent):
    answer = coherent.ask(PLACE, HZ)
    np.testing.assert_allclose(answer.pas, make_predictor(coherent.trained)(PLACE, HZ), atol=1e-5)
    assert answer.doubts == () and "outside" in coherent.ask(np.array([90.0, 0, 1]), HZ).doubts[0]


def test_paths_run_from_transmitter_to_receiver_over_their_length(coherent):
    paths = coherent.ask(PLACE, HZ).paths
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


def test_a_sample_is_compared_with_what_would_be_observed(coherent, monkeypatch):
    asker = Asker(dataclasses.replace(coherent.loaded, trained=coherent.trained))
    truth = coherent.dataset.pas(coherent.dataset.test[:1])
    monkeypatch.setattr(session, "as_observed", lambda field, params, pas: np.asarray(truth))
    link = int(coherent.dataset.test[0])
    sample = asker.nearest_sample(coherent.dataset.tx_positions[link], coherent.dataset.frequencies_hz[link])
    assert sample.ssim == pytest.approx(1, abs=1e-5)


def test_another_material_is_seen_at_once_and_taken_back(coherent):
    before, trained = coherent.ask(PLACE, HZ).power_db, coherent.trained
    names, properties = coherent.materials()
    assert len(names) == len(properties.permittivity)
    for number in range(len(names)):
        coherent.change_material(number, 1.01, 1e7)
    metal = coherent.ask(PLACE, HZ).power_db
    assert abs(metal - before) > 0.1
    coherent.restore(trained)
    assert coherent.ask(PLACE, HZ).power_db == before


def test_another_thickness_is_seen_at_once_where_the_data_know_one_and_taken_back(coherent):
    """Of panes that are half a wavelength thick, which reflect least, and a quarter of one, which reflect most."""
    before, trained, plan = coherent.ask(PLACE, HZ).power_db, coherent.trained, coherent.plan
    found = []
    for share in (0.5, 0.25):
        for number in range(len(coherent.materials()[0])):
            coherent.change_material(number, 6.0, 1e-3)
            coherent.change_thickness(number, share * SPEED_OF_LIGHT / HZ / np.sqrt(6))
        found.append(coherent.ask(PLACE, HZ).power_db)
    assert abs(found[1] - found[0]) > 0.01
    assert coherent.materials()[1].thickness == pytest.approx(0.25 * SPEED_OF_LIGHT / HZ / np.sqrt(6))
    planned = dataclasses.replace(coherent.loaded, trained=coherent.trained)  # as for maps: planned with that thickness
    anew = Asker(planned)
    assert anew.ask(PLACE, HZ).power_db == pytest.approx(found[1], abs=1e-4)
    coherent.restore(trained)
    assert coherent.ask(PLACE, HZ).power_db == before and coherent.plan is plan


@pytest.mark.heavy
def test_gaussians_have_what_blending_uses(splatting, coherent):
    found = splatting.splatted(PLACE, HZ)
    assert found.attenuation.shape == found.signal.shape == (len(found.gaussians.means), 1)
    assert ((found.attenuation >= 0) & (found.attenuation <= 1)).all()
    assert coherent.splatted(PLACE, HZ) is None and splatting.ask(PLACE, HZ).paths is None


def test_a_dome_is_brightest_where_the_spectrum_is(rng):
    pas = np.zeros((90, 360))
    row, column = 30, 60  # multiples of the stride
    pas[row, column] = 1
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points, colors = drawing.dome(pas, turn, 2.0)
    brightest = int(np.argmax(np.linalg.norm(points, axis=1)))
    np.testing.assert_allclose(points[brightest], 2.0 * turn @ pas_directions()[row, column], atol=1e-5)
    assert colors[brightest].sum() > colors[0].sum()


def test_pictures_of_maps_are_clear_where_nothing_is_heard(rng):
    values = rng.uniform(-90, -50, (4, 6))
    values[0, 0] = -300.0
    picture, low, high = drawing.map_picture(values)
    assert picture.shape == (4, 6, 4) and picture[-1, 0, 3] == 0 and picture[0, 0, 3] > 0  # the largest y on top
    assert -91 < low < high < -49


def test_path_segments_leave_out_what_is_filled_up():
    points = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 0], [1, 1, 0.0]]])
    segments, ends = drawing.path_segments(points, np.array([[1, 2, 3]], np.uint8))
    assert segments.shape == ends.shape == (2, 2, 3)
    np.testing.assert_array_equal(drawing.path_handles(points), [[1, 0, 0]])


def test_a_walk_is_as_long_as_its_way_and_closed(rng):
    way = walk.stops(rng.normal(size=(30, 3)))
    total = np.linalg.norm(np.diff(np.concatenate([way, way[:1]]), axis=0), axis=1).sum()
    np.testing.assert_allclose(walk.place_on(way, 0.3), walk.place_on(way, total + 0.3), atol=1e-9)
    steps = np.array([walk.place_on(way, s) for s in np.linspace(0, total, 2001)])
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
    marks = panel.marks_at(np.array([1, 2.4, 5, 10, 24.25, 37, 47, 60, 77, 94]))
    written = [mark[0] for mark in marks if isinstance(mark, tuple)]
    assert len(marks) == 10 and min(np.diff(written)) > panel.LABEL_ROOM


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


@pytest.mark.heavy
@pytest.mark.skipif(chromium() is None, reason="there is no Chromium; apt-get install chromium brings it on Debian and Ubuntu")
def test_a_drag_in_a_browser_changes_the_picture(tmp_path):
    viewer = view.start(view.Command(make_coherent_run(tmp_path / "box"), port=0))
    viewer.wait()
    before, place = viewer.said.spectrum.image.copy(), viewer.position
    with window(viewer) as opened:
        opened.tab("Paths")
        for _ in range(DRAGS):  # a browser without a graphics card, on busy cores, may take a while to draw what is dragged
            opened.page.wait_for_timeout(2000)
            drag(viewer, opened, 60.0, 3.0)
            opened.page.wait_for_timeout(1500)
            if np.linalg.norm(viewer.position - place) > 0.05:
                break
        viewer.wait()
        assert np.linalg.norm(viewer.position - place) > 0.05
        assert (viewer.said.spectrum.image != before).mean() > 0.01
        before = viewer.said.spectrum.image.copy()
        viewer.set(viewer.controls.material.thickness, 7.0)
        viewer.wait()
        assert (viewer.said.spectrum.image != before).mean() > 0.01
        assert opened.errors == []
    viewer.stop()


def test_electrical_properties_are_those_that_were_set(coherent):
    changed = coherent.trained.field.with_material(coherent.trained.params, 0, 3.5, 0.2)
    found = coherent.trained.field.material_properties(changed)
    assert found.permittivity[0] == pytest.approx(3.5, rel=1e-5) and found.conductivity[0] == pytest.approx(0.2, rel=1e-5)
    assert dataclasses.is_dataclass(changed) and bool(jnp.isfinite(changed.materials.slope).all())
