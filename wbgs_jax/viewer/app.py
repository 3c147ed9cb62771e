"""The viewer application: changes of the controls are queried and the results drawn; outdated requests are skipped."""

import contextlib
import io
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import viser
from jaxtyping import Float

from wbgs_jax._util.cli import say
from wbgs_jax._util.files import atomic_write
from wbgs_jax.inference.radio_map import plane_over
from wbgs_jax.viewer import drawing, panel, walk
from wbgs_jax.viewer.session import Answer, Asker
from wbgs_jax.viewer.surroundings import SceneView

STEPS_A_SECOND = 20
"""Animation steps of a walk, per second."""
HANDLE_SHARE = 0.06
"""Size of the transmitter's arrows, relative to that of the room."""


class Latest:
    """Runs work in a separate thread for the newest request; older requests that are still waiting are dropped."""

    def __init__(self, work: Callable[[], None]):
        self._work, self._wanted, self._stopped, self._busy = work, threading.Event(), False, False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

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
            except Exception as error:  # the viewer continues, and its terminal shows why nothing changed
                say(f"viewer: {type(error).__name__}: {error}")
            self._busy = False


class Viewer:
    """A server that shows one trained field."""

    def __init__(self, asker: Asker, host: str = "localhost", port: int = 8080, html: Path = Path("scene.html"), up: str = "z"):
        self.asker, self.html, self.updates, self._ended = asker, html, 0, False
        data = asker.dataset
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a table; the command prints one line instead
            self.server = viser.ViserServer(host=host, port=port, label="wbgs-jax", verbose=False)
        self.view = SceneView(self.server, data, asker.receiver, up)
        self.start = np.median(data.tx_positions, axis=0)
        self.start = data.tx_positions[np.argmin(np.linalg.norm(data.tx_positions - self.start, axis=1))]
        top = float(self.view.box[1, self.view.up])
        self.controls, self.said = panel.make_panel(self.server, asker, self.start, self.view.heights(), top)
        self.answer: Answer | None = None
        self.chosen: int | None = None
        self._way, self._walked, self._syncing, self._trained = walk.stops(data.tx_positions), 0.0, False, asker.trained
        self._drag = self._transmitter()
        self._look_in()
        self._spectrum, self._map = Latest(self._show), Latest(self._draw_map)
        self._connect()
        threading.Thread(target=self._walk, daemon=True).start()
        self._spectrum.request()

    @property
    def port(self) -> int:
        """The port of the server."""
        return self.server.get_port()

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """Position of the transmitter, metres."""
        return np.array(self.controls.position.value, float)

    @property
    def frequency_hz(self) -> float:
        """The queried frequency, hertz."""
        return 1e9 * float(self.controls.ghz.value)

    @property
    def handle_size(self) -> float:
        """Length of the transmitter's arrows, metres."""
        return HANDLE_SHARE * self.view.size

    def draw_map(self) -> None:
        """Draws the received power over the plane of the controls, and returns when it is drawn."""
        self._map.request()
        self._map.wait()

    def stop(self) -> None:
        """Stops the server and its threads."""
        self._ended = True
        self._spectrum.stop()
        self._map.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def move(self, position: Float[np.ndarray, "3"], drag: bool = True) -> None:
        """Moves the transmitter to a position (metres); `drag` also moves its arrows."""
        x, y, z = (float(part) for part in position)
        self._quietly(self.controls.position, (x, y, z))
        if drag:
            self._drag.position = (x, y, z)
        self._spectrum.request()

    def set_ghz(self, ghz: float) -> None:
        """Sets the frequency (GHz)."""
        self._quietly(self.controls.ghz, round(ghz, 4))
        self._quietly(self.controls.octave, round(float(np.log10(ghz)), 3))
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

    def _transmitter(self) -> viser.TransformControlsHandle:
        scene = self.server.scene
        handle = scene.add_transform_controls(
            "/transmitter", self.handle_size, disable_rotations=True, position=tuple(self.start)
        )
        scene.add_icosphere("/transmitter/ball", 0.07, (214, 39, 40))
        scene.add_label("/transmitter/name", "transmitter", position=(0, 0, 0.15))
        return handle

    def _look_in(self) -> None:
        low, high = self.view.box
        middle, size = (low + high) / 2, self.view.size
        aside = np.roll([-0.08, -0.45, 0.6], self.view.up - 2)
        self.server.initial_camera.position = tuple(middle + aside * size)
        self.server.initial_camera.look_at = tuple(middle)

    def _connect(self) -> None:
        """Connects every control with its action."""
        c = self.controls
        self._drag.on_update(lambda _: self.move(np.array(self._drag.position), drag=False))
        c.position.on_update(lambda _: None if self._syncing else self.move(self.position))
        c.octave.on_update(lambda _: None if self._syncing else self.set_ghz(10 ** float(c.octave.value)))
        c.ghz.on_update(lambda _: None if self._syncing else self.set_ghz(float(c.ghz.value)))
        for control in (c.paths, c.by_power, c.gaussians):
            if control is not None:
                control.on_update(lambda _: self._spectrum.request())
        c.cut.on_update(lambda _: self.view.clip(*map(float, c.cut.value)))
        c.samples.on_update(lambda _: setattr(self.view.samples, "visible", c.samples.value))
        c.map.draw.on_click(lambda _: self._map.request())
        c.map.clear.on_click(lambda _: self._remove_map())
        c.save.on_click(lambda event: self._offer(event.client))
        if (m := c.material) is not None:
            m.chosen.on_update(lambda _: self._show_material(m))
            for slider in (m.permittivity, m.conductivity):
                slider.on_update(lambda _: None if self._syncing else self._change_material(m))
            m.thickness.on_update(lambda _: None if self._syncing else self._change_thickness(m))
            m.reset.on_click(lambda _: self._as_trained(m))

    def _quietly(self, control: Any, value: Any) -> None:
        """Sets a control without triggering its action."""
        self._syncing = True
        try:
            control.value = value
        finally:
            self._syncing = False

    def _show(self) -> None:
        """Queries the field and draws the prediction."""
        position, frequency, c, said = self.position, self.frequency_hz, self.controls, self.said
        answer = self.answer = self.asker.ask(position, frequency)
        with self.server.atomic():
            said.spectrum.image = drawing.spectrum_picture(answer.pas)
            said.summary.content = panel.summary_words(answer, frequency)
            self.view.draw_dome(answer.pas)
            self._draw_paths()
            if c.gaussians is not None:
                off = c.gaussians.value == "off"
                self.view.draw_gaussians(None if off else self.asker.splatted(position, frequency), c.gaussians.value)
        sample = self.asker.nearest_sample(position, frequency)
        said.truth_words.content = panel.sample_words(sample)
        said.truth.image = drawing.spectrum_picture(panel.BLACK if sample is None else sample.pas)
        self.updates += 1

    def _draw_paths(self) -> None:
        c, paths = self.controls, self.answer.paths if self.answer else None
        self.view.draw_paths(paths, int(c.paths.value), c.by_power.value == "by power", self.chosen, self._choose)
        if paths is None or not len(paths.power_db):
            return
        if self.said.impulse is not None:
            delay, power = drawing.stems(paths.delay_ns, paths.power_db)
            self.said.impulse.data = (delay, power)
        if self.chosen is not None and self.chosen < len(paths.power_db):
            self.said.path.content = panel.path_words(paths, self.chosen)

    def _choose(self, number: int) -> None:
        self.chosen = number
        self._draw_paths()

    def _draw_map(self) -> None:
        m, (low, high) = self.controls.map, self.view.box
        plane = plane_over(low[:2], high[:2], float(m.height.value), float(m.step.value))
        m.progress.value, m.progress.visible = 0.0, True
        frequency = self.frequency_hz
        values = self.asker.power_plane(plane, frequency, lambda share: setattr(m.progress, "value", 100 * share))
        first, last = self.view.draw_map(values, plane)
        m.progress.visible = False
        m.legend.content = (
            f"Received power at {frequency / 1e9:.4g} GHz from transmitters at z = {plane.height:.2f} m: "
            f"dark {first:.0f} dB to bright {last:.0f} dB relative to the transmitted power."
        )

    def _remove_map(self) -> None:
        self.view.draw_map(None, None)
        self.controls.map.legend.content = ""

    def _show_material(self, m: panel.MaterialControls) -> None:
        found = self.asker.materials()
        assert found is not None, "material controls exist only if there are materials"
        epsilon, sigma = (float(values[m.number]) for values in (found[1].permittivity, found[1].conductivity))
        self._quietly(m.permittivity, round(epsilon, 2))
        self._quietly(m.conductivity, round(float(np.log10(sigma)), 2))
        self._quietly(m.thickness, round(1e3 * float(found[1].thickness[m.number]), 1))

    def _change_material(self, m: panel.MaterialControls) -> None:
        self.asker.change_material(m.number, float(m.permittivity.value), 10 ** float(m.conductivity.value))
        self._spectrum.request()

    def _change_thickness(self, m: panel.MaterialControls) -> None:
        self.asker.change_thickness(m.number, 1e-3 * float(m.thickness.value))
        self._spectrum.request()

    def _as_trained(self, m: panel.MaterialControls) -> None:
        self.asker.restore(self._trained)
        self._show_material(m)
        self._spectrum.request()

    def _offer(self, client: viser.ClientHandle | None) -> None:
        """Sends the page to the browser in which the button was pressed."""
        if client is not None:
            client.send_file_download(self.html.name, self.server.scene.as_html().encode())

    def _walk(self) -> None:
        while not self._ended:
            time.sleep(1 / STEPS_A_SECOND)
            if self.controls.play.value:
                self._walked += float(self.controls.speed.value) / STEPS_A_SECOND
                self.move(walk.place_on(self._way, self._walked))
