"""Pictures of the viewer for the documentation, and how fast it follows: a browser looks at a run and drags its transmitter.

python -m experiments.studies.viewer_pictures --run RUN [--pictures docs/images] [--out results/viewer.json]

Needs Chromium and the extra `dev`.
"""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # read with JAX; see wbgs_jax/_util/quiet.py

# isort: split

import contextlib
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments.results import FOLDER
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import write_json
from wbgs_jax.commands.view import Command as ViewCommand
from wbgs_jax.commands.view import start
from wbgs_jax.evaluation.report import environment
from wbgs_jax.viewer.app import Viewer

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SIZE = {"width": 1440, "height": 900}
MEASURED_S = 5.0
HARMLESS = "Computed radius is NaN"
"""What viser 1.1 says of any Gaussians."""
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
    """What the page's console complained of."""

    def shot(self, path: Path, settle: float = SETTLED_S) -> None:
        """Waits until all is drawn, and takes a picture."""
        self.page.wait_for_timeout(1000 * settle)
        path.parent.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=str(path))

    def hear(self, kind: str, text: str) -> None:
        """Keeps what the console says if it is an error."""
        if kind == "error" and HARMLESS not in text:
            self.errors.append(text)

    def tab(self, name: str) -> None:
        """Opens a tab of the panel."""
        self.page.get_by_role("tab", name=name).click()


def chromium() -> str | None:
    """Returns the path of a Chromium; None where there is none."""
    return next((path for name in CHROMIUM if (path := shutil.which(name))), None)


@contextlib.contextmanager
def window(viewer: Viewer) -> Iterator[Window]:
    """Opens a viewer in a browser without a screen.

    Raises:
        UserError: there is no browser.
    """
    path = chromium()
    if path is None:
        raise UserError("there is no Chromium; install one (apt-get install chromium)")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        page = browser.new_page(viewport=SIZE)  # type: ignore[arg-type]
        opened = Window(page)
        page.on("console", lambda message: opened.hear(message.type, message.text))
        page.on("pageerror", lambda error: opened.errors.append(str(error)))
        page.goto(f"http://localhost:{viewer.port}")
        page.wait_for_selector("canvas")
        page.get_by_text("spectrum at the receiver").wait_for()
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
    depth, scale = offset @ forward, SIZE["height"] / 2 / np.tan(camera.fov / 2)
    x, y = offset @ right / depth, offset @ np.cross(right, forward) / depth
    return SIZE["width"] / 2 + scale * x, SIZE["height"] / 2 - scale * y


def drag(viewer: Viewer, opened: Window, pixels: float, seconds: float) -> int:
    """Drags the transmitter by the arrow along x, forwards and back, with the mouse; returns the updates that it caused."""
    arrow = viewer.position + np.array([0.75 * viewer.handle_size, 0.0, 0.0])
    x, y = on_screen(viewer, arrow)
    tip = np.array(on_screen(viewer, arrow + np.array([0.2, 0.0, 0.0]))) - [x, y]
    tip /= np.linalg.norm(tip)
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
    """Takes the three pictures of the documentation: paths, Gaussians, a map of power."""
    c = viewer.controls
    opened.tab("Paths")
    opened.shot(folder / "viewer_paths.png", 2 * SETTLED_S)
    if c.gaussians is not None:
        viewer.set(c.gaussians, "signal")
        viewer.set(c.paths, 0)
        opened.tab("Room")
        opened.shot(folder / "viewer_gaussians.png", 2 * SETTLED_S)
        viewer.set(c.gaussians, "off")
    viewer.draw_map()
    opened.tab("Map")
    opened.shot(folder / "viewer_map.png", 2 * SETTLED_S)


def main() -> None:
    """Entry point."""
    use_compilation_cache()
    command = tyro.cli(Command, prog="python -m experiments.studies.viewer_pictures")
    viewer = start(ViewCommand(command.run, port=0, ghz=28.0))
    viewer.wait()
    alone = updates_a_second(viewer)
    with window(viewer) as opened:
        take_pictures(viewer, opened, command.pictures)
        moved = drag(viewer, opened, 60.0, MEASURED_S)
        errors = opened.errors
    figures = {
        "run": str(command.run),
        "field": viewer.asker.trained.field.name,
        "updates_a_second": round(alone, 1),
        "updates_a_second_dragged_in_a_browser": round(moved / MEASURED_S, 1),
        "console_errors": len(errors),
        "environment": environment(),
    }
    write_json(command.out, figures)
    dragged = f"{moved / MEASURED_S:.1f} while a browser on the same machine drags"
    say(f"{alone:.1f} updates a second; {dragged}; {errors or 'no errors'}; pictures: {command.pictures}")
    viewer.stop()


if __name__ == "__main__":
    run_command(main)
