"""The viewer in a real browser: dragging, values under the pointer, layout, maps that follow, a stopped server, saving."""

import threading

import numpy as np
import pytest
from builders.untrained import make_coherent_run

from experiments.studies.viewer_pictures import PHONE, TABS, chromium, drag, on_screen, window
from wbgs_jax.commands import view
from wbgs_jax.inference.evaluate_quantities import LoadedField
from wbgs_jax.training.run_folder import load_trained
from wbgs_jax.viewer.app import Viewer
from wbgs_jax.viewer.page import STOPPED, Page
from wbgs_jax.viewer.session import Session

pytestmark = [
    pytest.mark.heavy,
    pytest.mark.skipif(
        chromium() is None, reason="there is no Chromium; apt-get install chromium brings it on Debian and Ubuntu"
    ),
]
DRAGS = 10
"""Times that the mouse tries."""
PATIENT_MS = 60_000
"""Milliseconds that a browser without a graphics card, on busy cores, may take."""
CUT_OFF = """() => {
  const cut = [];
  for (const input of document.querySelectorAll("input")) {
    if (input.offsetParent && input.type === "text" && input.scrollWidth > input.clientWidth + 1) cut.push(input.value);
  }
  for (let at = document.getElementById("wbgs-probe"); at; at = at.parentElement) {
    if (at.scrollHeight > at.clientHeight + 2 && ["auto", "scroll"].includes(getComputedStyle(at).overflowY)) {
      cut.push(`panel of ${at.clientHeight} pixels with ${at.scrollHeight}`);
    }
  }
  for (const svg of document.querySelectorAll("svg.wbgs")) {
    const box = svg.getBoundingClientRect();
    if (!box.width) continue;
    for (const text of svg.querySelectorAll("text")) {
      const inner = text.getBoundingClientRect();
      if (inner.left < box.left - 1 || inner.right > box.right + 1 || inner.bottom > box.bottom + 1) cut.push(text.textContent);
    }
  }
  return cut;
}"""
"""Returns what is cut off: numbers in fields, the panel, and labels of figures."""


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    viewer = view.start(view.Command(run=make_coherent_run(tmp_path_factory.mktemp("view") / "box"), port=0))
    viewer.wait()
    yield viewer
    viewer.stop()


@pytest.fixture
def opened(viewer):
    with window(viewer) as opened:
        yield opened
        assert opened.errors == []


def hover(opened, selector, share_x, share_y):
    """Moves the pointer over the picture of a figure, and returns the words that appear."""
    box = opened.page.locator(selector).first.bounding_box()
    opened.page.mouse.move(box["x"] + share_x * box["width"], box["y"] + share_y * box["height"])
    opened.page.wait_for_timeout(500)
    return opened.page.locator(selector).first.evaluate("own => own.closest('svg').querySelector('.wbgs-read').textContent")


def test_a_drag_changes_the_picture(viewer, opened):
    before, place = viewer.display.spectrum.content, viewer.position
    opened.tab("Paths")
    for _ in range(DRAGS):
        opened.page.wait_for_timeout(2000)
        drag(viewer, opened, 60.0, 3.0)
        opened.page.wait_for_timeout(1500)
        if np.linalg.norm(viewer.position - place) > 0.05:
            break
    viewer.wait()
    assert np.linalg.norm(viewer.position - place) > 0.05
    assert viewer.display.spectrum.content != before
    before = viewer.display.spectrum.content
    viewer.set(viewer.controls.material.thickness, 7.0)
    viewer.wait()
    assert viewer.display.spectrum.content != before


def test_the_value_under_the_pointer_is_that_of_the_spectrum(viewer, opened):
    pas = viewer.answer.pas
    for column, row in ((40, 20), (200, 70), (330, 45)):
        words = hover(opened, 'image[filter*="predicted"]', (column + 0.5) / 360, (row + 0.5) / 90)
        azimuth, zenith, amplitude = (float(part.strip("°")) for part in words.replace(",", "").replace(":", "").split()[1::2])
        assert abs(azimuth - (column + 0.5 - 180)) <= 1.5 and abs(zenith - (row + 0.5)) <= 1.5
        around = pas[max(row - 1, 0) : row + 2, column - 1 : column + 2]
        assert around.min() - 0.02 <= amplitude <= around.max() + 0.02


def test_the_strongest_path_is_read_in_the_impulse_response(viewer, opened):
    opened.tab("Channel")
    opened.page.get_by_text("Impulse response").wait_for(timeout=PATIENT_MS)
    circle = opened.page.locator("svg.wbgs g circle").first
    box = circle.bounding_box()
    opened.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    opened.page.wait_for_timeout(500)
    words = circle.evaluate("own => own.closest('svg').querySelector('.wbgs-read').textContent")
    paths = viewer.answer.paths
    assert any(word in words and f"{delay:.1f} ns" in words for word, delay in zip(paths.words, paths.delay_ns, strict=True))


def test_nothing_is_cut_off_on_any_tab(viewer, opened):
    for name in TABS:
        opened.tab(name)
        if name == "Map":
            viewer.draw_map()
        opened.page.wait_for_timeout(1500)
        assert opened.page.evaluate(CUT_OFF) == [], name
    viewer.set(viewer.controls.map.shown, False)


def test_both_ends_of_the_link_are_in_sight_on_a_phone(viewer):
    with window(viewer, PHONE) as opened:
        opened.page.wait_for_timeout(2000)
        sheet = opened.page.locator("#wbgs-probe").bounding_box()
        for place in (viewer.position, np.asarray(viewer.session.receiver.position, float)):
            x, y = on_screen(viewer, place)
            assert 0 < x < PHONE["width"] and 0 < y < sheet["y"]


def test_a_map_follows_the_frequency(viewer, opened):
    opened.tab("Map")
    viewer.set_ghz(28.0)
    viewer.wait()
    viewer.draw_map()
    opened.page.get_by_text("Received power at 28 GHz").wait_for(timeout=PATIENT_MS)
    first = viewer.map.values
    viewer.set_ghz(5.0)
    opened.page.get_by_text("Received power at 5 GHz").wait_for(timeout=PATIENT_MS)
    assert viewer.map.frequency_hz == 5e9 and np.nanmean(np.abs(viewer.map.values - first)) > 1
    words = hover(opened, 'image[filter*="map"]', 0.5, 0.5)
    assert words.endswith("dBm") and " m: " in words
    viewer.set(viewer.controls.map.shown, False)


def test_a_transmitter_outside_is_red_and_has_no_interval(viewer, opened):
    place = viewer.position
    viewer.move(np.array([40.0, 0.0, 1.0]))
    viewer.wait()
    opened.page.locator(".wbgs-warning").first.wait_for(timeout=PATIENT_MS)
    assert "lies outside" in opened.page.locator(".wbgs-warning").first.text_content()
    assert tuple(viewer.view._ball.color) == (214, 39, 40)
    assert "±" not in viewer.display.summary.content and "SSIM" not in viewer.display.summary.content
    viewer.move(place)
    viewer.wait()
    assert tuple(viewer.view._ball.color) != (214, 39, 40)


def test_the_room_is_saved(viewer, opened, tmp_path):
    opened.tab("Room")
    with opened.page.expect_download(timeout=PATIENT_MS) as download:
        opened.page.get_by_role("button", name="save as HTML").click()
    download.value.save_as(tmp_path / "room.html")
    assert "__VISER_EMBED_DATA__" in (tmp_path / "room.html").read_text()


def test_a_page_that_is_opened_early_becomes_the_viewer(tmp_path):
    trained = load_trained(make_coherent_run(tmp_path / "box"))
    page, dataset = Page(port=0), trained.dataset()
    with window(page, ready="starting") as opened:
        viewer = Viewer(Session(LoadedField(trained, dataset, dataset.receiver())), page)
        opened.page.get_by_text("Spectrum at the receiver, predicted").wait_for(timeout=PATIENT_MS)
        viewer.wait()
        opened.page.wait_for_timeout(1000)
        assert not opened.page.get_by_text("compiling the field").is_visible()
        for place in (viewer.position, np.asarray(viewer.session.receiver.position, float)):
            x, y = on_screen(viewer, place)
            assert 0 < x < 900 and 0 < y < 800
        assert opened.errors == []
    viewer.stop()


def test_a_page_shows_progress_and_then_that_its_server_has_stopped():
    page = Page(port=0)
    page.progress("reading the run", 10)
    with window(page, ready="reading the run") as opened:
        stopping = threading.Thread(target=page.stop)
        stopping.start()
        opened.page.get_by_role("alert").wait_for(timeout=PATIENT_MS)
        assert opened.page.get_by_role("alert").text_content() == STOPPED
        stopping.join()
