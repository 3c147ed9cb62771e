"""Pictures of the viewer for the documentation, and how fast it follows: a browser looks at a run and drags its transmitter.

python -m experiments.studies.viewer_pictures --run RUN [--pictures docs/images] [--out results/viewer.json]

Needs Chromium and the extra `dev`.
"""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # read with JAX; see wbgs_jax/_util/quiet.py

# isort: split

import contextlib
import io
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image

from experiments.results import FOLDER
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import write_json
from wbgs_jax.commands.view import Command as ViewCommand
from wbgs_jax.commands.view import start
from wbgs_jax.evaluation.report import environment
from wbgs_jax.viewer.app import Viewer
from wbgs_jax.viewer.page import Page
from wbgs_jax.viewer.panel import SHOWN_PATHS

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SIZE, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
TABS = "Truth", "Channel", "Paths", "Map", "Room", "Materials"
SHOWN = 960, 600
"""Largest size of a picture in the documentation, pixels."""
COLORS = 256
"""Number of colours of a picture, which keeps the files small."""
MEASURED_S = 5.0
MOVES = 25
"""Movements of the mouse whose delays are measured."""
SLOWEST_MS = 5000
SCRIPT = """() => {
  window.delays = [];
  let moved = null;
  const drawn = () => document.querySelector('image[filter*="predicted"]')?.getAttribute("href");
  let last = drawn();
  addEventListener("pointermove", (event) => { if (event.buttons && moved === null) moved = performance.now(); }, true);
  new MutationObserver(() => {
    const now = drawn();
    if (now === last) return;
    last = now;
    if (moved === null) return;
    const begin = moved;
    requestAnimationFrame(() => { delays.push(performance.now() - begin); moved = null; });
  }).observe(document.body, { subtree: true, childList: true, characterData: true });
}"""
"""Measures the time from a movement of the mouse to the next frame with another spectrum."""
FIRST = "Spectrum at the receiver, predicted"
"""Words on the page as soon as there is a prediction."""
HARMLESS = "Computed radius is NaN"
"""Message of viser 1.1 for any Gaussians."""
SETTLED_S = 2.5
"""Seconds that a browser without a graphics card takes to draw what has arrived."""


@dataclass(frozen=True)
class Command:
    """Take pictures of the viewer, and count its updates while the transmitter is dragged."""

    run: Path
    """Run folder."""
    pictures: Path = Path("docs/images")
    """Where viewer_*.png go."""
    out: Path = FOLDER / "viewer.json"
    """Where the figures go."""


@dataclass
class Window:
    """A page of the viewer in a browser."""

    page: Any
    """Playwright's."""
    errors: list[str] = field(default_factory=list)
    """Errors in the page's console."""

    def shot(self, path: Path, settle: float = SETTLED_S) -> None:
        """Waits until all is drawn, and takes a small picture."""
        self.page.wait_for_timeout(1000 * settle)
        path.parent.mkdir(parents=True, exist_ok=True)
        with Image.open(io.BytesIO(self.page.screenshot())) as image:
            image.thumbnail(SHOWN, Image.Resampling.LANCZOS)
            image.convert("RGB").quantize(COLORS, kmeans=1).save(path, optimize=True)

    def keep(self, kind: str, text: str) -> None:
        """Keeps a message of the console if it is an error."""
        if kind == "error" and HARMLESS not in text:
            self.errors.append(text)

    def tab(self, name: str) -> None:
        """Opens a tab of the panel."""
        self.page.get_by_role("tab", name=name).click()


def chromium() -> str | None:
    """Returns the path of a Chromium; None where there is none."""
    return next((path for name in CHROMIUM if (path := shutil.which(name))), None)


@contextlib.contextmanager
def window(viewer: Viewer | Page, size: dict[str, int] = SIZE, ready: str = FIRST) -> Iterator[Window]:
    """Opens a viewer in a browser without a screen, whose window has a size in pixels, and waits for the words `ready`.

    Raises:
        UserError: there is no browser.
    """
    path = chromium()
    if path is None:
        raise UserError("there is no Chromium; install one (apt-get install chromium)")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        page = browser.new_page(viewport=size)  # type: ignore[arg-type]
        opened = Window(page)
        page.on("console", lambda message: opened.keep(message.type, message.text))
        page.on("pageerror", lambda error: opened.errors.append(str(error)))
        page.goto(f"http://localhost:{viewer.port}", wait_until="commit")
        page.wait_for_selector("canvas")
        page.get_by_text(ready).wait_for()
        page.add_style_tag(content=".mantine-Notifications-root {display: none}")  # that there is no graphics card
        yield opened
        browser.close()


def on_screen(viewer: Viewer, place: np.ndarray) -> tuple[float, float]:
    """Returns where a place of the room is seen in the only browser's window, pixels."""
    (client,) = viewer.server.get_clients().values()
    camera = client.camera
    forward, up = camera.look_at - camera.position, camera.up_direction
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    offset = np.asarray(place) - camera.position
    depth, scale = offset @ forward, camera.image_height / 2 / np.tan(camera.fov / 2)
    x, y = offset @ right / depth, offset @ np.cross(right, forward) / depth
    return camera.image_width / 2 + scale * x, camera.image_height / 2 - scale * y


def arrow_on_screen(viewer: Viewer) -> tuple[float, float, np.ndarray]:
    """Returns where the transmitter's arrow along x is seen, and its direction there."""
    arrow = viewer.position + np.array([0.75 * viewer.view.handle_size, 0.0, 0.0])
    x, y = on_screen(viewer, arrow)
    tip = np.array(on_screen(viewer, arrow + np.array([0.2, 0.0, 0.0]))) - [x, y]
    return x, y, tip / np.linalg.norm(tip)


def delays_ms(viewer: Viewer, opened: Window) -> list[float]:
    """Drags the transmitter step by step, and returns the times from movements of the mouse to the new spectrum on the page."""
    x, y, tip = arrow_on_screen(viewer)
    page = opened.page
    page.evaluate(SCRIPT)
    page.mouse.move(x, y)
    page.mouse.down()
    for number in range(1, MOVES + 1):
        far = 6.0 * (number if number <= MOVES // 2 else MOVES - number)
        page.mouse.move(*(np.array([x, y]) + far * tip))
        with contextlib.suppress(Exception):  # a movement that changed nothing
            page.wait_for_function("count => delays.length >= count", arg=number, timeout=SLOWEST_MS)
        page.wait_for_timeout(200)
    page.mouse.up()
    return list(page.evaluate("delays"))


def drag(viewer: Viewer, opened: Window, pixels: float, seconds: float) -> int:
    """Drags the transmitter by the arrow along x, forwards and back, with the mouse; returns the updates that it caused."""
    x, y, tip = arrow_on_screen(viewer)
    mouse, before, begin = opened.page.mouse, viewer.updates, time.perf_counter()
    mouse.move(x, y)
    mouse.down()
    while (now := time.perf_counter() - begin) < seconds:
        far = pixels * np.sin(2 * np.pi * now / seconds)
        mouse.move(*(np.array([x, y]) + far * tip))
    mouse.up()
    return viewer.updates - before


def updates_a_second(viewer: Viewer, seconds: float = MEASURED_S) -> float:
    """Returns how often a second the viewer answers while its transmitter moves without a rest."""
    before, begin, home = viewer.updates, time.perf_counter(), viewer.position
    while (now := time.perf_counter() - begin) < seconds:
        viewer.move(home + np.array([0.3 * np.sin(2 * np.pi * now / seconds), 0.0, 0.0]))
        time.sleep(0.01)
    count = (viewer.updates - before) / (time.perf_counter() - begin)
    viewer.move(home)
    return count


def take_pictures(viewer: Viewer, opened: Window, folder: Path) -> None:
    """Takes a picture of every tab, and of a transmitter inside a closed body."""
    c, place = viewer.controls, viewer.position
    for name in TABS:
        opened.tab(name)
        if name == "Map":
            viewer.draw_map()
        if name == "Room" and c.gaussians is not None:
            viewer.set(c.gaussians, "signal")
            viewer.set(c.paths, 0)
            viewer.wait()
        opened.shot(folder / f"viewer_{name.lower()}.png", 2 * SETTLED_S)
        viewer.set(c.map.shown, False)
        if name == "Room" and c.gaussians is not None:
            viewer.set(c.gaussians, "off")
            viewer.set(c.paths, SHOWN_PATHS)
    if bodies := viewer.session.loaded.domain.bodies:
        centres = [body.triangles.reshape(-1, 3).mean(0).round(2) for body in bodies]
        opened.tab("Paths")
        viewer.move(min(centres, key=lambda centre: power_at(viewer, centre)))
        viewer.wait()
        opened.shot(folder / "viewer_inside.png", 2 * SETTLED_S)
        viewer.move(place)
        viewer.wait()


def power_at(viewer: Viewer, place: np.ndarray) -> float:
    """Returns the power of the strongest path from a place, dB; the weakest of all without any path."""
    paths = viewer.session.predict(place, viewer.frequency_hz).paths
    return float(paths.power_db[0]) if paths is not None and len(paths.power_db) else -np.inf


def main() -> None:
    """Entry point."""
    use_compilation_cache()
    command = tyro.cli(Command, prog="python -m experiments.studies.viewer_pictures")
    begin = time.perf_counter()
    viewer = start(ViewCommand(run=command.run, port=0, ghz=28.0))
    viewer.wait()
    loaded = time.perf_counter() - begin
    alone = updates_a_second(viewer)
    with window(viewer) as opened:
        opened.tab("Paths")
        opened.page.wait_for_timeout(1000 * SETTLED_S)
        delays = delays_ms(viewer, opened)
        moved = drag(viewer, opened, 60.0, MEASURED_S)
        viewer.move(viewer.start)
        take_pictures(viewer, opened, command.pictures)
        errors = opened.errors
    with window(viewer, PHONE) as opened:
        opened.shot(command.pictures / "viewer_phone.png", 2 * SETTLED_S)
        errors += opened.errors
    median = float(np.median(delays)) if delays else float("nan")
    figures = {
        "run": str(command.run),
        "field": viewer.session.trained.field.name,
        "seconds_until_the_first_prediction": round(loaded, 1),
        "updates_a_second": round(alone, 1),
        "updates_a_second_dragged_in_a_browser": round(moved / MEASURED_S, 1),
        "median_delay_of_the_spectrum_ms": round(median, 1),
        "measured_delays": len(delays),
        "console_errors": len(errors),
        "environment": environment(),
    }
    write_json(command.out, figures)
    dragged = f"{moved / MEASURED_S:.1f} while a browser on the same machine drags"
    say(f"first prediction after {loaded:.1f} s; {alone:.1f} updates a second; {dragged}")
    say(f"median delay {median:.0f} ms of {len(delays)}; {errors or 'no errors'}; pictures: {command.pictures}")
    viewer.stop()


if __name__ == "__main__":
    run_command(main)
