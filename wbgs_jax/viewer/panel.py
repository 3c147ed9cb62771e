"""The viewer's panel: its controls, and the display of predictions."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from jaxtyping import Float
from viser import uplot

from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.inference.evaluate_quantities import lowest_frequency
from wbgs_jax.types import MAX_FREQUENCY_HZ
from wbgs_jax.viewer import drawing
from wbgs_jax.viewer.session import Answer, Asker, PathList, Sample

BLACK = np.zeros((90, 360))
MOST_PATHS = 200
PERMITTIVITY, LOG_CONDUCTIVITY = (1.01, 12.0), (-6.0, 7.0)
"""Ranges of the sliders; the conductivity as log10 of S/m."""
THICKNESS_MM = (0.5, 500.0)
LABEL_ROOM = 0.27
"""Minimum distance, in decades, of two frequencies that are labelled below the slider."""


@dataclass
class MapControls:
    """Controls of the map."""

    height: viser.GuiSliderHandle
    step: viser.GuiNumberHandle
    draw: viser.GuiButtonHandle
    clear: viser.GuiButtonHandle
    progress: Any
    """Progress bar; viser does not export its type."""
    legend: viser.GuiMarkdownHandle


@dataclass
class MaterialControls:
    """Controls of the material."""

    chosen: viser.GuiDropdownHandle
    permittivity: viser.GuiSliderHandle
    conductivity: viser.GuiSliderHandle
    """log10 of S/m at 1 GHz."""
    thickness: viser.GuiSliderHandle
    """Millimetres."""
    reset: viser.GuiButtonHandle

    @property
    def number(self) -> int:
        """Index of the chosen material."""
        return int(str(self.chosen.value).split(":")[0])


@dataclass
class Controls:
    """Controls of the panel."""

    position: viser.GuiVector3Handle
    octave: viser.GuiSliderHandle
    """The frequency, as log10 of gigahertz."""
    ghz: viser.GuiNumberHandle
    play: viser.GuiCheckboxHandle
    speed: viser.GuiSliderHandle
    cut: viser.GuiMultiSliderHandle
    samples: viser.GuiCheckboxHandle
    paths: viser.GuiSliderHandle
    by_power: viser.GuiDropdownHandle
    gaussians: viser.GuiDropdownHandle | None
    map: MapControls
    material: MaterialControls | None
    save: viser.GuiButtonHandle


@dataclass
class Said:
    """Elements of the panel that display a prediction."""

    summary: viser.GuiMarkdownHandle
    spectrum: viser.GuiImageHandle
    truth: viser.GuiImageHandle
    truth_words: viser.GuiMarkdownHandle
    impulse: viser.GuiUplotHandle | None
    path: viser.GuiMarkdownHandle


def make_panel(
    server: viser.ViserServer, asker: Asker, start: Float[np.ndarray, "3"], heights: tuple[float, float], top: float
) -> tuple[Controls, Said]:
    """Creates the panel of a field on a server. `start` is the initial position of the transmitter; `heights` is the initial
    range of drawn heights, and `top` its upper limit (metres)."""
    gui, known = server.gui, np.unique(asker.dataset.frequencies_hz) / 1e9
    summary = gui.add_markdown("*compiling the field, which takes a while ...*")
    spectrum = gui.add_image(drawing.spectrum_picture(BLACK), label="spectrum at the receiver", format="jpeg", jpeg_quality=85)
    with gui.add_folder("Transmitter"):
        position = gui.add_vector3("x, y, z [m]", (start[0], start[1], start[2]), step=0.05)
        low = lowest_frequency(asker.trained.field, asker.dataset)
        first = float(known[len(known) // 2])
        ends = float(np.log10(low / 1e9)), float(np.log10(MAX_FREQUENCY_HZ / 1e9))
        octave = gui.add_slider("frequency", *ends, step=0.001, initial_value=float(np.log10(first)), marks=marks_at(known))
        ghz = gui.add_number("GHz", first, min=low / 1e9, max=MAX_FREQUENCY_HZ / 1e9, step=0.1)
        play = gui.add_checkbox("walk through the room", False)
        speed = gui.add_slider("metres per second", 0.2, 3.0, step=0.1, initial_value=1.0)
    tabs = gui.add_tab_group()
    with tabs.add_tab("Truth"):
        truth_words = gui.add_markdown("")
        truth = gui.add_image(drawing.spectrum_picture(BLACK), format="jpeg", jpeg_quality=85)
        samples = gui.add_checkbox("show all transmitters of the data", False)
    with tabs.add_tab("Paths"):
        most = MOST_PATHS if asker.knows_paths else 0
        paths = gui.add_slider("strongest", 0, MOST_PATHS, step=1, initial_value=min(30, most), disabled=not most)
        by_power = gui.add_dropdown("color", ("by power", "by reflections"), disabled=not most)
        path = gui.add_markdown("Click on the ball of a path." if most else "This field does not predict paths.")
    with tabs.add_tab("Room"):
        cut = gui.add_multi_slider("heights [m]", heights[0], top, step=0.01, initial_value=heights)
        gaussians = _gaussians(gui, asker)
        save = gui.add_button("save as HTML")
    with tabs.add_tab("Map"):
        map_controls = _map_controls(gui, asker)
    with tabs.add_tab("Materials"):
        material = _material_controls(gui, asker)
    impulse = _impulse_plot(gui) if most else None  # in an initially hidden tab it would have no width
    chosen = play, speed, cut, samples, paths, by_power, gaussians, map_controls, material, save
    return Controls(position, octave, ghz, *chosen), Said(summary, spectrum, truth, truth_words, impulse, path)


def marks_at(ghz: Float[np.ndarray, " n"]) -> tuple:
    """Returns the marks of the slider: all frequencies of the data, labelled if there is enough space."""
    marks, last = [], -np.inf
    for f in ghz:
        place = float(np.log10(f))
        marks.append((place, f"{f:g}") if place - last > LABEL_ROOM else place)
        last = place if isinstance(marks[-1], tuple) else last
    return tuple(marks)


def _impulse_plot(gui: viser.GuiApi) -> viser.GuiUplotHandle:
    return gui.add_uplot(
        (np.array([0.0, 1.0]), np.array([-100.0, -100.0])),
        (uplot.Series(label="delay [ns]"), uplot.Series(label="power [dB]", stroke="#0072b2", width=1.5)),
        scales={"x": uplot.Scale(time=False)},
        axes=(uplot.Axis(label="delay [ns]"), uplot.Axis(label="power [dB]")),
        aspect=1.7,
    )


def _gaussians(gui: viser.GuiApi, asker: Asker) -> viser.GuiDropdownHandle | None:
    """Returns the menu of what the colours of Gaussians show; None if the field has no Gaussians."""
    if asker.splatted(asker.dataset.tx_positions[0], float(asker.dataset.frequencies_hz[0])) is None:
        return None
    return gui.add_dropdown("Gaussians", ("off", "signal", "attenuation"))


def _map_controls(gui: viser.GuiApi, asker: Asker) -> MapControls:
    """Returns the controls of a map over a plane of constant z."""
    off, usual = not asker.knows_power, float(np.median(asker.dataset.tx_positions[:, 2]))
    floor, top = map(float, DatasetScene(asker.dataset).box[:, 2])
    return MapControls(
        gui.add_slider("z [m]", floor, top, step=0.05, initial_value=usual, disabled=off),
        gui.add_number("step [m]", 0.25, min=0.05, max=2.0, step=0.05, disabled=off),
        gui.add_button("draw received power", disabled=off),
        gui.add_button("remove", disabled=off),
        gui.add_progress_bar(0.0, visible=False),
        gui.add_markdown("This field does not predict power." if off else ""),
    )


def _material_controls(gui: viser.GuiApi, asker: Asker) -> MaterialControls | None:
    """Returns the controls of a material: a menu, its permittivity, conductivity and thickness, and a button that undoes all
    changes; None if the field has no materials."""
    found = asker.materials()
    if found is None:
        gui.add_markdown("This field has no materials.")
        return None
    names, properties = found
    epsilon = float(np.clip(properties.permittivity[0], *PERMITTIVITY))
    log_sigma = float(np.clip(np.log10(properties.conductivity[0]), *LOG_CONDUCTIVITY))
    millimetres = float(np.clip(1e3 * properties.thickness[0], *THICKNESS_MM))
    return MaterialControls(
        gui.add_dropdown("material", tuple(f"{number}: {name}" for number, name in enumerate(names))),
        gui.add_slider("relative permittivity", *PERMITTIVITY, step=0.01, initial_value=epsilon),
        gui.add_slider("log10 S/m at 1 GHz", *LOG_CONDUCTIVITY, step=0.01, initial_value=log_sigma),
        gui.add_slider("thickness [mm]", *THICKNESS_MM, step=0.5, initial_value=round(2 * millimetres) / 2),
        gui.add_button("as trained"),
    )


def summary_words(answer: Answer, frequency_hz: float) -> str:
    """Returns the text above the spectrum."""
    lines = [f"**{frequency_hz / 1e9:.4g} GHz**"]
    if answer.power_db is not None:
        lines[0] += f" · received {answer.power_db:.1f} dB"
    if answer.expected is not None and answer.level is not None:
        ssim, low, high = answer.expected
        lines.append(f"expected SSIM {ssim:.2f}, {100 * answer.level:.0f} % between {low:.2f} and {min(high, 1):.2f}")
    if answer.paths is not None and len(answer.paths.power_db):
        lines.append(channel_words(answer.paths))
    lines += [f"⚠️ **{line}**" for line in answer.doubts]
    return "  \n".join(lines)


def channel_words(paths: PathList) -> str:
    """Returns a line with K-factor, delay spread and number of paths."""
    spread = f"delay spread {1e9 * paths.delay_spread_s:.1f} ns"
    return f"K-factor {paths.k_factor_db:.1f} dB · {spread} · {len(paths.power_db)} paths"


def sample_words(sample: Sample | None) -> str:
    """Returns the text above the observed spectrum."""
    if sample is None:
        return "The data contain no spectra of this receiver."
    place = f"{sample.distance_m:.2f} m away, {sample.frequency_hz / 1e9:g} GHz, {sample.part}"
    return f"Nearest transmitter of the data ({place}). **SSIM of the field there: {sample.ssim:.3f}**"


def path_words(paths: PathList, number: int) -> str:
    """Returns a description of one path."""
    zenith = np.degrees(np.arccos(np.clip(paths.direction[number, 2], -1, 1)))
    azimuth = np.degrees(np.arctan2(paths.direction[number, 1], paths.direction[number, 0]))
    return "  \n".join(
        [
            f"**{paths.words[number]}**",
            f"{paths.power_db[number]:.1f} dB · {paths.length[number]:.2f} m · {paths.delay_ns[number]:.2f} ns",
            f"arrives from zenith {zenith:.1f}°, azimuth {azimuth:.1f}°",
        ]
    )
