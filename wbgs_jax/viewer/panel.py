"""The viewer's panel: its controls, and the display of predictions."""

import html
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from jaxtyping import Float

from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.inference.evaluate_quantities import lowest_frequency
from wbgs_jax.inference.trained_field import receiver_number
from wbgs_jax.types import MAX_FREQUENCY_HZ
from wbgs_jax.viewer import figures
from wbgs_jax.viewer.page import as_words
from wbgs_jax.viewer.session import Answer, LinkBudget, PathList, Sample, Session

SHOWN_PATHS = 30
"""Number of paths that are drawn at first."""
LABEL_ROOM = 0.14
"""Minimum distance of two marks of the frequency slider that are labelled, relative to its range."""
MOVED = "moved"


@dataclass
class MapControls:
    """Controls of the map."""

    shown: viser.GuiCheckboxHandle
    height: viser.GuiSliderHandle
    step: viser.GuiNumberHandle
    picture: viser.GuiHtmlHandle
    caption: viser.GuiHtmlHandle


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

    receiver: viser.GuiDropdownHandle
    position: viser.GuiVector3Handle
    ghz: viser.GuiSliderHandle
    samples: viser.GuiCheckboxHandle
    dbm: viser.GuiVector2Handle
    """Transmitted power and noise floor, dBm."""
    band: viser.GuiNumberHandle
    """Bandwidth of the frequency response, MHz."""
    paths: viser.GuiSliderHandle
    by_power: viser.GuiDropdownHandle
    map: MapControls
    cut: viser.GuiMultiSliderHandle
    gaussians: viser.GuiDropdownHandle | None
    play: viser.GuiCheckboxHandle
    speed: viser.GuiSliderHandle
    save: viser.GuiButtonHandle
    material: MaterialControls | None

    @property
    def budget(self) -> LinkBudget:
        """The link budget that is typed in."""
        transmitter, noise = self.dbm.value
        return LinkBudget(float(transmitter), float(noise))


@dataclass
class Display:
    """Elements of the panel that display a prediction."""

    summary: viser.GuiHtmlHandle
    spectrum: viser.GuiHtmlHandle
    truth: viser.GuiHtmlHandle
    channel: viser.GuiHtmlHandle
    paths: viser.GuiHtmlHandle
    gaussians: viser.GuiHtmlHandle


def make_panel(
    server: viser.ViserServer, session: Session, start: Float[np.ndarray, "3"], heights: tuple[float, float], top: float
) -> tuple[Controls, Display]:
    """Creates the panel of a field on a server. `start` is the initial position of the transmitter; `heights` is the initial
    range of drawn heights, and `top` its upper limit (metres)."""
    gui, known = server.gui, np.unique(session.dataset.frequencies_hz) / 1e9
    summary = gui.add_html(as_words("The first prediction compiles the field, which takes a while ..."))
    spectrum = gui.add_html("")
    names = receiver_names(session)
    number = receiver_number(session.dataset, session.receiver)
    shown = names[-1 if number is None else number]
    receiver = gui.add_dropdown("receiver", names, initial_value=shown, disabled=len(names) < 2)
    position = gui.add_vector3("transmitter", (start[0], start[1], start[2]), step=0.01, hint="x, y, z in metres")
    low, high = lowest_frequency(session.trained.field, session.dataset) / 1e9, MAX_FREQUENCY_HZ / 1e9
    first = float(known[len(known) // 2])
    ghz = gui.add_slider("GHz", low, high, step=0.01, initial_value=first, marks=marks_at(known, low, high))
    tabs = gui.add_tab_group()
    most_paths = 200
    most = most_paths if session.has_paths else 0
    with tabs.add_tab("Truth"):
        truth = gui.add_html("")
        samples = gui.add_checkbox("all transmitters", False, hint="Show the places of all transmitters of the data.")
    # Initial link budget; the noise is the thermal one of 100 MHz with a noise figure of 7 dB.
    transmitter_dbm, noise_dbm = 20.0, -87.0
    with tabs.add_tab("Channel"):
        off = not session.has_power
        dbm = gui.add_vector2(
            "TX, noise [dBm]",
            (transmitter_dbm, noise_dbm),
            step=0.1,
            disabled=off,
            hint="Transmitted power, and noise floor of the receiver",
        )
        band = gui.add_number("band [MHz]", 100.0, min=1.0, max=2000.0, step=10.0, disabled=not most)
        channel = gui.add_html("" if most else _without_paths(None))
    with tabs.add_tab("Paths"):
        paths = gui.add_slider("strongest", 0, most_paths, step=1, initial_value=min(SHOWN_PATHS, most), disabled=not most)
        by_power = gui.add_dropdown("color", ("by power", "by reflections"), disabled=not most)
        path_table = gui.add_html("" if most else _without_paths(None))
    with tabs.add_tab("Map"):
        map_controls = _map_controls(gui, session)
    with tabs.add_tab("Room"):
        lowest, highest = np.floor(100 * heights[0]) / 100, np.ceil(100 * top) / 100  # heights must lie between them
        cut = gui.add_multi_slider("heights [m]", lowest, max(highest, lowest + 0.01), step=0.01, initial_value=heights)
        gaussians = gui.add_dropdown("Gaussians", ("off", "signal", "attenuation")) if session.has_gaussians else None
        gaussian_scale = gui.add_html("")
        play = gui.add_checkbox("walk", False, hint="Move the transmitter through the room.")
        speed = gui.add_slider("speed [m/s]", 0.2, 3.0, step=0.1, initial_value=1.0)
        save = gui.add_button("save as HTML")
    with tabs.add_tab("Materials"):
        material = _material_controls(gui, session)
    radio = receiver, position, ghz, samples, dbm, band
    controls = Controls(*radio, paths, by_power, map_controls, cut, gaussians, play, speed, save, material)
    return controls, Display(summary, spectrum, truth, channel, path_table, gaussian_scale)


def number(control: Any) -> float:
    """Returns the value of a control within its limits, which a browser enforces only when typing ends."""
    return float(np.clip(control.value, control.min, control.max))


def receiver_names(session: Session) -> tuple[str, ...]:
    """Returns the choices of the receiver: those of the data by index and position and, if it can be moved, `MOVED`."""
    places = np.atleast_2d(np.asarray(session.dataset.receivers.position, float))
    names = tuple(f"{number}: {', '.join(f'{x:.2f}' for x in place)} m" for number, place in enumerate(places))
    return (*names, MOVED) if session.movable else names


def marks_at(ghz: Float[np.ndarray, " n"], low: float, high: float) -> tuple:
    """Returns the marks of the slider from `low` to `high`: all frequencies of the data, labelled if there is enough space."""
    marks: list[Any] = []
    last = -np.inf
    for f in ghz:
        enough = f - last > LABEL_ROOM * (high - low)
        marks.append((float(f), f"{f:.4g}") if enough else float(f))
        last = f if enough else last
    return tuple(marks)


def _map_controls(gui: viser.GuiApi, session: Session) -> MapControls:
    """Returns the controls of a map over a plane of constant z."""
    off, usual = not session.has_power, float(np.median(session.dataset.tx_positions[:, 2]))
    floor, top = (round(float(z), 2) for z in DatasetScene(session.dataset).box[:, 2])
    return MapControls(
        gui.add_checkbox("show", False, disabled=off, hint="Received power from transmitters all over a level plane"),
        gui.add_slider("height [m]", floor, top, step=0.01, initial_value=round(usual, 2), disabled=off),
        gui.add_number("step [m]", 0.25, min=0.05, max=2.0, step=0.05, disabled=off),
        gui.add_html(""),
        gui.add_html(as_words("This field does not predict power.") if off else ""),
    )


def _material_controls(gui: viser.GuiApi, session: Session) -> MaterialControls | None:
    """Returns the controls of a material: a menu, its permittivity, conductivity and thickness, and a button that undoes all
    changes; None if the field has no materials."""
    found = session.materials()
    if found is None:
        gui.add_html(as_words("This field has no materials."))
        return None
    names, properties = found
    permittivity, log_conductivity = (1.01, 12.0), (-6.0, 7.0)  # ranges of the sliders; the conductivity as log10 of S/m
    epsilon = round(float(np.clip(properties.permittivity[0], *permittivity)), 2)
    log_sigma = round(float(np.clip(np.log10(properties.conductivity[0]), *log_conductivity)), 2)
    thickness_mm = (0.5, 500.0)
    millimetres = float(np.clip(1e3 * properties.thickness[0], *thickness_mm))
    return MaterialControls(
        gui.add_dropdown("material", tuple(f"{number}: {name}" for number, name in enumerate(names))),
        gui.add_slider("permittivity", *permittivity, step=0.01, initial_value=epsilon, hint="Relative, at 1 GHz"),
        gui.add_slider("log10 S/m", *log_conductivity, step=0.01, initial_value=log_sigma, hint="Conductivity at 1 GHz"),
        gui.add_slider("thickness [mm]", *thickness_mm, step=0.5, initial_value=round(2 * millimetres) / 2),
        gui.add_button("as trained"),
    )


def figure(title: str, drawn: str) -> str:
    """Returns a figure with a title as an element of the panel."""
    return f'<div class="wbgs-panel"><div class="wbgs-title">{html.escape(title)}</div>{drawn}</div>'


def summary(answer: Answer, frequency_hz: float, budget: LinkBudget, has_power: bool) -> str:
    """Returns the figures of a link and its warnings, for the top of the panel."""
    lines = [[f"<b>{frequency_hz / 1e9:.4g} GHz</b>", *power_words(answer, budget)] if has_power else []]
    if not has_power:
        lines = [[f"<b>{frequency_hz / 1e9:.4g} GHz</b>"]]
    if answer.paths is not None and len(answer.paths.power_db):
        lines.append(channel_words(answer.paths))
    if answer.expected is not None and answer.level is not None:
        ssim, low, high = answer.expected
        lines.append([f"expected SSIM <b>{ssim:.2f}</b>", f"{100 * answer.level:.0f} % between {low:.2f} and {high:.2f}"])
    rows = "".join(
        f'<div class="wbgs-figures">{"".join(f"<span>{item}</span>" for item in line)}</div>' for line in lines if line
    )
    sentences = "".join(f'<div class="wbgs-warning">{html.escape(line)}</div>' for line in answer.warnings)
    return f'<div class="wbgs-panel" style="padding-top: 0.4em">{rows}{sentences}</div>'


def power_words(answer: Answer, budget: LinkBudget) -> list[str]:
    """Returns received power and SNR."""
    if answer.power_db is None:
        return ["<b>nothing is received</b>"]
    power = f"received <b>{budget.received_dbm(answer.power_db):.1f} dBm</b>"
    if answer.within_db is not None and answer.power_level is not None:
        power += f" ± {answer.within_db:.1f} dB ({100 * answer.power_level:.0f} %)"
    return [power, f"SNR <b>{budget.snr_db(answer.power_db):.1f} dB</b>"]


def channel_words(paths: PathList) -> list[str]:
    """Returns K-factor, delay spread and number of paths."""
    spread = f"delay spread <b>{1e9 * paths.delay_spread_s:.1f} ns</b>"
    several = len(paths.power_db) > 1
    return [*([f"K-factor <b>{paths.k_factor_db:.1f} dB</b>"] if several else []), spread, f"{len(paths.power_db)} paths"]


def spectrum_figure(pas: Float[np.ndarray, "90 360"]) -> str:
    """Returns the predicted spectrum."""
    return figure("Spectrum at the receiver, predicted", figures.spectrum(pas, "predicted"))


def truth_figure(sample: Sample | None) -> str:
    """Returns the observed spectrum of the nearest transmitter, and how well it is predicted."""
    if sample is None:
        return as_words("The data contain no spectra of this receiver.")
    place = f"{sample.distance_m:.2f} m away, at {sample.frequency_hz / 1e9:g} GHz, {sample.part}"
    below = f"Nearest transmitter of the data: {place}. SSIM of the prediction for it: <b>{sample.ssim:.3f}</b>"
    drawn = figures.spectrum(sample.pas, "observed")
    return figure("Spectrum at the receiver, observed", drawn + f'<div class="wbgs-words">{below}</div>')


def _without_paths(paths: PathList | None) -> str:
    """Returns why there are no paths to show."""
    return as_words(
        "This field does not predict paths." if paths is None else "No path carries power from here to the receiver."
    )


def channel_figures(paths: PathList | None, budget: LinkBudget, band_mhz: float) -> str:
    """Returns the frequency response of the link over a band around the carrier, and its impulse response."""
    if paths is None or not len(paths.power_db):
        return _without_paths(paths)
    offsets = np.linspace(-band_mhz / 2, band_mhz / 2, 201)
    response = budget.received_dbm(paths.frequency_response_db(1e6 * offsets))
    x = figures.axis_over(-band_mhz / 2, band_mhz / 2, "offset from the carrier [MHz]")
    high = float(np.ceil(response.max() / 5) * 5)
    dynamic_db = 40.0  # range of the axes of powers below the strongest value
    low = float(np.floor(max(response.min(), high - dynamic_db) / 5) * 5)
    y = figures.axis_over(low, high, "power [dBm]", 3)
    frequency = figure("Frequency response", figures.curve(offsets, response, x, y))
    power, delay = budget.received_dbm(paths.power_db), paths.delay_ns
    strong = power > power[0] - dynamic_db
    x = figures.axis_over(0.0, float(np.ceil(1.05 * delay[strong].max() / 5) * 5), "delay [ns]")
    high = float(np.ceil((power[0] + 1) / 5) * 5)
    y = figures.axis_over(high - dynamic_db - 5, high, "power [dBm]", 3)
    described = tuple(word for word, kept in zip(paths.words, strong, strict=True) if kept)
    return frequency + figure("Impulse response", figures.stems(delay[strong], power[strong], described, x, y))


def gaussian_legend(top: float, by: str) -> str:
    """Returns the colour bar of the Gaussians, which are coloured by "signal" or "attenuation" from 0 to `top`."""
    label = "signal towards the receiver, amplitude" if by == "signal" else "share of a wave that is attenuated"
    bar = figures.legend(figures.axis_over(0.0, top, label), figures.GAUSSIAN_COLORS)
    return f'<div class="wbgs-panel">{bar}</div>'


def path_list(paths: PathList | None, count: int, chosen: int | None, budget: LinkBudget, by_power: bool) -> str:
    """Returns the legend of the drawn paths and their table; `chosen` is the number of the path that is marked."""
    if paths is None or not len(paths.power_db):
        return _without_paths(paths)
    power = budget.received_dbm(paths.power_db)
    legend = figures.bounce_legend()
    if by_power:
        bar = figures.axis_over(float(power[0]) - figures.PATH_RANGE_DB, float(power[0]), "power [dBm]")
        legend = figures.power_legend(bar, figures.PATH_RANGE_DB)
    order = list(range(min(count, len(power))))
    if chosen is not None and chosen in order:
        order = [chosen, *(number for number in order if number != chosen)]
    rows = "".join(
        f'<tr class="{"chosen" if number == chosen else ""}"><td>{power[number]:.1f}</td><td>{paths.delay_ns[number]:.1f}</td>'
        f"<td>{html.escape(paths.words[number])}</td></tr>"
        for number in order
    )
    head = "<tr><th>dBm</th><th>ns</th><th>interactions</th></tr>"
    hint = path_words(paths, chosen) if chosen in order else "A click on the ball of a path marks it here."
    return (
        f'<div class="wbgs-panel">{legend}<div class="wbgs-words">{hint}</div>'
        f'<div class="wbgs-table"><table>{head}{rows}</table></div></div>'
    )


def path_words(paths: PathList, number: int | None) -> str:
    """Returns length and direction of the marked path."""
    assert number is not None, "a path is marked"
    zenith = np.degrees(np.arccos(np.clip(paths.direction[number, 2], -1, 1)))
    azimuth = np.degrees(np.arctan2(paths.direction[number, 1], paths.direction[number, 0]))
    return f"marked: {paths.length[number]:.2f} m long, arrives from zenith {zenith:.0f}°, azimuth {azimuth:.0f}°"


def map_caption(
    drawn: tuple[float, float] | None, outdated: bool, share: float | None, clicked: tuple[float, float, float] | None
) -> str:
    """Returns the line below a map.

    Args:
        drawn: frequency (hertz) and height (metres) of the drawn map, if there is one.
        outdated: whether the controls have changed since then.
        share: completed fraction of a newer map, if one is being computed.
        clicked: place (x, y, metres) of a click on the map, and the power there, dBm.
    """
    lines = []
    if drawn is not None:
        of = f"at {drawn[0] / 1e9:.4g} GHz, transmitters at z = {drawn[1]:.2f} m"
        lines.append(f"<b>An older map</b>, {of}." if outdated else f"Received power {of}.")
    if share is not None:
        lines.append(f"The new map is being computed: {100 * share:.0f} %.")
    if clicked is not None:
        x, y, dbm = clicked
        value = f"{dbm:.1f} dBm" if np.isfinite(dbm) else "nothing is received"
        lines.append(f"At ({x:.2f}, {y:.2f}) m: <b>{value}</b>.")
    return f'<div class="wbgs-panel"><div class="wbgs-words">{" ".join(lines)}</div></div>'
