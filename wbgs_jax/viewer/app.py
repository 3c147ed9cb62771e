"""The viewer application: changes of the controls are queried and the results drawn; outdated requests are skipped."""

import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import viser
from jaxtyping import Float

from wbgs_jax._util.cli import say
from wbgs_jax._util.files import atomic_write
from wbgs_jax.inference.radio_map import Plane, cut_at, plane_over
from wbgs_jax.types import Receiver
from wbgs_jax.viewer import figures, panel
from wbgs_jax.viewer.page import Page, as_words
from wbgs_jax.viewer.session import Answer, Session, place_on_walk, stops_of_walk
from wbgs_jax.viewer.surroundings import FIELD_OF_VIEW, SceneView


class Latest:
    """Runs work in a separate thread for the newest request; older requests that are still waiting are dropped."""

    def __init__(self, work: Callable[[], None], on_error: Callable[[str], None] = say):
        self._work, self._on_error = work, on_error
        self._wanted, self._stopped, self._busy = threading.Event(), False, False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> bool:
        """Whether there is a request that is newer than the current work."""
        return self._wanted.is_set()

    def request(self) -> None:
        """Requests that the work be done (again)."""
        self._wanted.set()

    def wait(self) -> None:
        """Waits until all requested work is done."""
        while self._wanted.is_set() or self._busy:
            time.sleep(0.01)

    def stop(self) -> None:
        """Stops the thread after its current work."""
        self._stopped = True
        self._wanted.set()
        self._thread.join()

    def _run(self) -> None:
        while True:
            self._wanted.wait()
            self._busy = True
            self._wanted.clear()
            if self._stopped:
                return
            try:
                self._work()
            except Exception as error:  # the viewer continues, and shows why nothing changed
                with contextlib.suppress(Exception):  # standard error may be closed
                    self._on_error(f"{type(error).__name__}: {error}")
            finally:
                self._busy = False


class _OutdatedError(Exception):
    """A newer request replaces the work."""


@dataclass(frozen=True)
class DrawnMap:
    """A map of received power."""

    values: Float[np.ndarray, "ny nx"]
    """dB relative to the transmitted power; NaN where nothing is received."""
    plane: Plane
    conditions: tuple[Any, ...]
    """Frequency, height and so on, for which it was computed (`Viewer.map_conditions`)."""
    frequency_hz: float


class Viewer:
    """A server that shows one trained field."""

    def __init__(self, session: Session, page: Page | None = None, html: Path = Path("scene.html"), up: str = "z"):
        self.session, self.html, self.updates, self._ended = session, html, 0, False
        self.page = page or Page()
        self.server = self.page.server
        data = session.dataset
        self.start = np.median(data.tx_positions, axis=0)
        self.start = data.tx_positions[np.argmin(np.linalg.norm(data.tx_positions - self.start, axis=1))].round(2)
        self.view = SceneView(self.server, data, session.receiver, self.start, up)
        top = float(self.view.box[1, self.view.up])
        self.controls, self.display = panel.make_panel(self.server, session, self.start, self.view.heights(), top)
        self.answer: Answer | None = None
        self.chosen: int | None = None
        self.map: DrawnMap | None = None
        self._clicked: tuple[float, float] | None = None
        self._receiver = session.receiver
        self._way, self._walked, self._syncing = stops_of_walk(data.tx_positions), 0.0, threading.local()
        # Actions of controls run in threads of their own: the last change of the session is that of the newest value, ...
        self._changing = threading.Lock()
        # ... and the newest map is the one that is drawn.
        self._drawing, self._beside_due = threading.RLock(), 0.0
        self._look_in()
        self._spectrum = Latest(self._show, self._show_error)
        self._map = Latest(self._draw_map, self._show_map_error)
        self._connect()
        threading.Thread(target=self._walk, daemon=True).start()
        self.page.progress("compiling the field", 60)
        self._spectrum.request()

    @property
    def port(self) -> int:
        """The port of the server."""
        return self.page.port

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """Position of the transmitter, metres."""
        return np.array(self.controls.position.value, float)

    @property
    def frequency_hz(self) -> float:
        """The queried frequency, hertz."""
        return 1e9 * panel.number(self.controls.ghz)

    @property
    def map_conditions(self) -> tuple[Any, ...]:
        """Everything that a map depends on."""
        m, where = self.controls.map, np.asarray(self.session.receiver.position).tolist()
        return self.frequency_hz, panel.number(m.height), panel.number(m.step), *where, self.session.version

    def draw_map(self) -> None:
        """Draws the received power over the plane of the controls, and returns when it is drawn."""
        self._quietly(self.controls.map.shown, True)
        self._map.request()
        self._map.wait()

    def stop(self) -> None:
        """Stops the server and its threads."""
        self._ended = True
        self._spectrum.stop()
        self._map.stop()
        self.page.stop()

    def move(self, position: Float[np.ndarray, "3"], drag: bool = True) -> None:
        """Moves the transmitter to a position (metres); `drag` also moves its arrows."""
        x, y, z = (float(part) for part in position)
        self._quietly(self.controls.position, (x, y, z))
        if drag:
            self.view.transmitter.position = (x, y, z)
        self._spectrum.request()

    def move_receiver(self, receiver: Receiver) -> None:
        """Uses another receiver: one of the data or, if the field predicts others, any one."""
        self._receiver = receiver
        self._spectrum.request()

    def set_ghz(self, ghz: float) -> None:
        """Sets the frequency (GHz)."""
        self._quietly(self.controls.ghz, round(ghz, 4))
        self._spectrum.request()

    def wait(self) -> None:
        """Waits until the requested prediction is drawn."""
        self._spectrum.wait()

    def set(self, control: Any, value: Any) -> None:
        """Sets a control of the panel, with the same effect as in the browser."""
        control.value = value

    def save(self) -> Path:
        """Writes the current view as a page that opens without Python, and returns its path."""
        with atomic_write(self.html) as stream:
            stream.write(self.server.scene.as_html().encode())
        return self.html

    def _look_in(self) -> None:
        """Shows the room to browsers that are, or will be, connected."""
        initial = self.server.initial_camera
        wide = 1.2  # aspect of a picture whose browser is not known
        initial.position, initial.look_at = (tuple(place) for place in self.view.camera(wide))
        initial.fov = FIELD_OF_VIEW
        self.server.on_client_connect(self._aim)
        for client in self.server.get_clients().values():
            self._aim(client)

    def _aim(self, client: viser.ClientHandle) -> None:
        """Shows the room to a browser, whose picture loses the width of the panel if it is wide."""
        width, height = client.camera.image_width, client.camera.image_height
        panel_px = 388  # width of the panel, pixels
        aspect = width / height if width < height else max(width - panel_px, height) / height
        client.camera.position, client.camera.look_at = self.view.camera(aspect)

    def _connect(self) -> None:
        """Connects every control with its action."""
        c, drag = self.controls, self.view.transmitter
        drag.on_update(lambda _: self.move(np.array(drag.position).round(2), drag=False))
        self._on(c.position, lambda: self.move(self.position))
        for control in (c.ghz, c.paths, c.by_power, c.gaussians, c.dbm, c.band):
            if control is not None:
                self._on(control, self._spectrum.request)
        self._on(c.receiver, self._choose_receiver)
        if self.session.movable:
            arrows = self.view.add_receiver_handle()
            arrows.on_update(lambda _: self._drag_receiver(np.array(arrows.position)))
        self._on(c.cut, lambda: self.view.clip(*map(float, c.cut.value)))
        self._on(c.samples, lambda: setattr(self.view.samples, "visible", c.samples.value))
        for of_map in (c.map.shown, c.map.height, c.map.step):
            self._on(of_map, self._map.request)
        c.save.on_click(lambda event: self._offer(event.client))
        if (m := c.material) is not None:
            self._on(m.chosen, lambda: self._show_material(m))
            for slider in (m.permittivity, m.conductivity):
                self._on(slider, lambda: self._change_material(m))
            self._on(m.thickness, lambda: self._change_thickness(m))
            m.reset.on_click(lambda _: self._as_trained(m))

    def _on(self, control: Any, action: Callable[[], None]) -> None:
        """Connects a control with an action, which `_quietly` does not trigger."""
        control.on_update(lambda _: None if getattr(self._syncing, "now", False) else action())

    def _quietly(self, control: Any, value: Any) -> None:
        """Sets a control without triggering its action."""
        self._syncing.now = True
        try:
            control.value = value
        finally:
            self._syncing.now = False

    def _choose_receiver(self) -> None:
        chosen = str(self.controls.receiver.value)
        if chosen == panel.MOVED:
            return  # it starts from where it is
        receiver = self.session.dataset.receiver(int(chosen.split(":")[0]))
        if self.view.receiver_handle is not None:
            self.view.receiver_handle.position = tuple(np.asarray(receiver.position, float))
        self.move_receiver(receiver)

    def _drag_receiver(self, position: Float[np.ndarray, "3"]) -> None:
        self._quietly(self.controls.receiver, panel.MOVED)
        self.move_receiver(dataclasses.replace(self._receiver, position=jnp.asarray(position, jnp.float32)))

    def _follow_receiver(self) -> None:
        """Makes the session use the newest receiver."""
        wanted = self._receiver
        if wanted is self.session.receiver:
            return
        try:
            with self._changing:
                self.session.use_receiver(wanted)
        except Exception:
            self._receiver = self.session.receiver
            raise
        self.view.show_receiver(wanted)
        if self.controls.material is not None:
            self._show_material(self.controls.material)

    def _show(self) -> None:
        """Queries the field and draws the prediction."""
        position, frequency, c, d = self.position, self.frequency_hz, self.controls, self.display
        with self._notice():
            self._follow_receiver()
            answer = self.answer = self.session.predict(position, frequency)
        d.spectrum.content = panel.spectrum_figure(answer.pas)
        d.summary.content = panel.summary(answer, frequency, c.budget, self.session.has_power)
        self.server.flush()  # the panel does not wait for the room, which takes longer to draw
        with self.server.atomic():
            self.view.mark_transmitter(not answer.outside)
            self.view.draw_dome(answer.pas)
            self._draw_paths()
            if c.gaussians is not None:
                self._draw_gaussians(str(c.gaussians.value))
        self.page.ready()
        self.updates += 1
        least_often_s = 0.5  # the rest is drawn at least so often, even while the transmitter moves on
        if not self._spectrum.waiting or time.monotonic() > self._beside_due:
            self._show_beside(position, frequency)
            self._beside_due = time.monotonic() + least_often_s

    @contextlib.contextmanager
    def _notice(self) -> Iterator[None]:
        """Shows a line if a prediction takes long, since the field is compiled for it."""
        line = as_words("The field is being compiled for this query ...")
        slow_s = 0.7  # seconds after which a prediction counts as slow
        timer = threading.Timer(slow_s, lambda: setattr(self.display.summary, "content", line))
        timer.start()
        try:
            yield
        finally:
            timer.cancel()
            timer.join()

    def _show_beside(self, position: Float[np.ndarray, "3"], frequency_hz: float) -> None:
        """Draws what may lag behind while the transmitter moves."""
        assert self.answer is not None, "the prediction is drawn first"
        c, d = self.controls, self.display
        d.channel.content = panel.channel_figures(self.answer.paths, c.budget, panel.number(c.band))
        d.truth.content = panel.truth_figure(self.session.nearest_sample(position, frequency_hz))
        if self.map is not None:
            self._show_map()
            if self.map.conditions != self.map_conditions:
                self._map.request()

    def _show_error(self, words: str) -> None:
        shown = f"{words} What is drawn is an earlier prediction." if self.answer is not None else words
        self.display.summary.content = as_words(shown, "wbgs-warning")
        self.page.ready()
        say(f"viewer: {words}")

    def _show_map_error(self, words: str) -> None:
        self.controls.map.caption.content = as_words(words, "wbgs-warning")
        say(f"viewer: {words}")

    def _draw_paths(self) -> None:
        c, paths = self.controls, self.answer.paths if self.answer else None
        count, by_power = int(c.paths.value), c.by_power.value == "by power"
        self.view.draw_paths(paths, count, by_power, self.chosen, self._choose)
        self.display.paths.content = panel.path_list(paths, count, self.chosen, c.budget, by_power)

    def _draw_gaussians(self, by: str) -> None:
        shown = by != "off" and self.session.has_gaussians
        top = self.view.draw_gaussians(self.session.gaussians(self.position, self.frequency_hz) if shown else None, by)
        self.display.gaussians.content = panel.gaussian_legend(top, by) if shown else ""

    def _choose(self, number: int) -> None:
        self.chosen = number
        self._spectrum.request()  # in one thread with all other drawing of paths

    def _draw_map(self) -> None:
        """Computes and draws the map, unless it is drawn already."""
        m, (low, high) = self.controls.map, self.view.box
        if not m.shown.value:
            with self._drawing:
                self.map = self._clicked = None
                self.view.remove_map()
                m.picture.content = m.caption.content = ""
            return
        conditions, frequency = self.map_conditions, self.frequency_hz
        if self.map is None or self.map.conditions != conditions:
            plane = plane_over(low[:2], high[:2], panel.number(m.height), panel.number(m.step))
            self._show_map(0.0)

            def progress(share: float) -> None:
                if self._map.waiting or conditions != self.map_conditions:
                    self._map.request()
                    raise _OutdatedError
                self._show_caption(share)

            try:
                values = self.session.power_plane(plane, frequency, progress)
            except _OutdatedError:
                return
            self.map, self._clicked = DrawnMap(values, plane, conditions, frequency), None
        self._show_map()
        if self.map.conditions != self.map_conditions:
            self._map.request()

    def _show_map(self, share: float | None = None) -> None:
        """Draws the map that there is; `share` is the completed fraction of a newer one."""
        with self._drawing:
            self._redraw_map(share)

    def _redraw_map(self, share: float | None) -> None:
        self._show_caption(share)
        drawn = self.map
        if drawn is None:
            return
        budget, plane, outdated = self.controls.budget, drawn.plane, drawn.conditions != self.map_conditions
        values = budget.received_dbm(drawn.values)
        span = figures.map_range(values)
        self.view.draw_map(values, plane, span, outdated, self._click_map)
        steps = [(axis[1] - axis[0]) / 2 if len(axis) > 1 else 0.5 for axis in (plane.xs, plane.ys)]
        x, y = (
            figures.axis_over(float(axis[0] - step), float(axis[-1] + step), f"{name} [m]")
            for axis, step, name in zip((plane.xs, plane.ys), steps, "xy", strict=True)
        )
        power = figures.axis_over(*span, "received [dBm]")
        marks = {"T": tuple(self.position[:2]), "R": tuple(np.asarray(self.session.receiver.position[:2], float))}
        walls = cut_at(self.session.dataset, plane.height)
        picture = figures.power_map(values, x, y, power, walls, marks, outdated)
        self.controls.map.picture.content = f'<div class="wbgs-panel">{picture}</div>'

    def _show_caption(self, share: float | None) -> None:
        m, drawn = self.controls.map, self.map
        m.caption.content = panel.map_caption(
            None if drawn is None else (drawn.frequency_hz, drawn.plane.height),
            drawn is not None and drawn.conditions != self.map_conditions,
            share,
            self._map_value(),
        )

    def _map_value(self) -> tuple[float, float, float] | None:
        """Returns the place of the last click on the map and the power there, dBm."""
        if self.map is None or self._clicked is None:
            return None
        (x, y), plane = self._clicked, self.map.plane
        column, row = int(np.abs(plane.xs - x).argmin()), int(np.abs(plane.ys - y).argmin())
        return x, y, float(self.controls.budget.received_dbm(self.map.values[row, column]))

    def _click_map(self, x: float, y: float) -> None:
        self._clicked = x, y
        self._show_caption(None)

    def _show_material(self, m: panel.MaterialControls) -> None:
        found = self.session.materials()
        assert found is not None, "material controls exist only if there are materials"
        epsilon, sigma = (float(values[m.number]) for values in (found[1].permittivity, found[1].conductivity))
        self._quietly(m.permittivity, round(epsilon, 2))
        self._quietly(m.conductivity, round(float(np.log10(sigma)), 2))
        self._quietly(m.thickness, round(1e3 * float(found[1].thickness[m.number]), 1))

    def _change_material(self, m: panel.MaterialControls) -> None:
        with self._changing:
            self.session.change_material(m.number, panel.number(m.permittivity), 10 ** panel.number(m.conductivity))
        self._spectrum.request()

    def _change_thickness(self, m: panel.MaterialControls) -> None:
        with self._changing:
            self.session.change_thickness(m.number, 1e-3 * panel.number(m.thickness))
        self._spectrum.request()

    def _as_trained(self, m: panel.MaterialControls) -> None:
        with self._changing:
            self.session.restore()
        self._show_material(m)
        self._spectrum.request()

    def _offer(self, client: viser.ClientHandle | None) -> None:
        """Sends the page to the browser in which the button was pressed, which saves it."""
        if client is not None:
            client.send_file_download(self.html.name, self.server.scene.as_html().encode(), save_immediately=True)

    def _walk(self) -> None:
        steps_a_second = 20  # animation steps of a walk, per second
        while not self._ended:
            time.sleep(1 / steps_a_second)
            if self.controls.play.value:
                self._walked += float(self.controls.speed.value) / steps_a_second
                self.move(place_on_walk(self._way, self._walked))
