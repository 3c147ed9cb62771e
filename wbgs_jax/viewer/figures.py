"""Figures of the panel as SVG text: images and curves with axes, colour bars and the value under the pointer; numbers as
images, coloured points and lines of the scene.

Images are grey PNGs that the browser colours with a filter, so that `page.js` can read the value of a pixel. Curves carry their
points. Units of the drawing are about pixels of the panel.
"""

import base64
import functools
import html
import io
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib import colormaps
from PIL import Image

from wbgs_jax.propagation.paths import is_vertex
from wbgs_jax.radio.array import pas_directions

COLORS, GAUSSIAN_COLORS = "viridis", "inferno"
"""Colormaps of spectra and maps, and of Gaussians."""
PATH_RANGE_DB = 40.0
"""Range of the colours of paths below the strongest one; weaker paths fade."""
BY_BOUNCES = np.array([[0, 114, 178], [230, 159, 0], [0, 158, 115], [204, 121, 167]], np.uint8)
"""Colours of paths with 0, 1, 2 and 3 reflections or diffractions (Okabe and Ito; distinguishable by the colour-blind)."""


def colored(values: Float[np.ndarray, "*n"], low: float, high: float, name: str = COLORS) -> UInt8[np.ndarray, "*n 3"]:
    """Returns the colours of values; values beyond the range have the colours of its ends."""
    share = (np.asarray(values, np.float64) - low) / max(high - low, 1e-12)
    return (255 * color_table(name)[np.clip(share * 255, 0, 255).astype(int)]).astype(np.uint8)


@functools.cache
def color_table(name: str) -> Float[np.ndarray, "256 3"]:
    """Returns the colours of a colormap, red, green and blue from 0 to 1."""
    return colormaps[name](np.linspace(0, 1, 256))[:, :3]


def dome(
    pas: Float[np.ndarray, "90 360"], rotation: Float[np.ndarray, "3 3"], radius: float
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Returns points around the receiver (offsets in the world frame, metres), whose distance and brightness grow with the
    amplitude from their direction, and their colours. `rotation` rotates the local frame into the world frame."""
    dome_stride = 4  # stride of the directions that are drawn at the receiver, along both axes
    amplitude = pas[::dome_stride, ::dome_stride].reshape(-1)
    directions = pas_directions()[::dome_stride, ::dome_stride].reshape(-1, 3) @ rotation.T
    return (radius * (0.35 + 0.65 * amplitude))[:, None] * directions, colored(amplitude, 0.0, 1.0)


def bounces(interaction: Int[np.ndarray, "k 5"]) -> Int[np.ndarray, " k"]:
    """Returns the number of reflections and diffractions of paths."""
    return np.sum(is_vertex(interaction), -1)


def path_colors(power_db: Float[np.ndarray, " k"], bounce: Int[np.ndarray, " k"], by_power: bool) -> UInt8[np.ndarray, "k 3"]:
    """Returns a colour per path, by its power or by its number of reflections and diffractions. Paths that are `PATH_RANGE_DB`
    weaker than the strongest one fade into the background."""
    top = float(power_db.max(initial=-300.0))
    if by_power:
        colors = colored(power_db, top - PATH_RANGE_DB, top + PATH_RANGE_DB / 5, "plasma")  # its last colours are pale
    else:
        colors = BY_BOUNCES[np.minimum(bounce, len(BY_BOUNCES) - 1)]
    over_db, faintest = 20.0, 0.85  # weaker paths fade over this range to this share of the background
    faded = faintest * np.clip((top - PATH_RANGE_DB - power_db) / over_db, 0, 1)[:, None]
    return ((1 - faded) * colors + faded * 255).round().astype(np.uint8)


def linear(colors: UInt8[np.ndarray, "*n 3"]) -> UInt8[np.ndarray, "*n 3"]:
    """Returns sRGB colours as linear ones, which viser 1.1 expects for lines and for batches of equal meshes."""
    return (255 * (colors / 255.0) ** 2.2).round().astype(np.uint8)


def path_segments(points: Float[np.ndarray, "k 5 3"], colors: UInt8[np.ndarray, "k 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the segments of paths (n, 2, 3) and the colours of their ends (n, 2, 3)."""
    pieces = np.stack([points[:, :-1], points[:, 1:]], 2)
    long = np.linalg.norm(pieces[:, :, 1] - pieces[:, :, 0], axis=-1) > 1e-6
    ends = np.repeat(np.repeat(colors[:, None], 4, 1)[:, :, None], 2, 2)
    return pieces[long], ends[long]


def path_handles(points: Float[np.ndarray, "k 5 3"]) -> Float[np.ndarray, "k 3"]:
    """Returns a point to click on for every path: where it first changes its direction, or the middle of a straight path."""
    straight = np.linalg.norm(points[:, 1] - points[:, 2], axis=-1) < 1e-6
    return np.where(straight[:, None], (points[:, 0] + points[:, 1]) / 2, points[:, 1])


def map_range(values: Float[np.ndarray, "ny nx"]) -> tuple[float, float]:
    """Returns the values of the first and the last colour of a map (NaN where nothing is received)."""
    known = values[np.isfinite(values)]
    map_margin = 0.01  # fraction of the values at either end that lie beyond the colours of a map
    low, high = np.quantile(known, [map_margin, 1 - map_margin]) if len(known) else (-100.0, 0.0)
    return float(low), float(high)


def map_picture(values: Float[np.ndarray, "ny nx"], low: float, high: float, dim: bool = False) -> UInt8[np.ndarray, "ny nx 4"]:
    """Returns a map as an image, with the largest y at the top, transparent where the values are NaN. `low` and `high` are the
    values of the first and the last colour; `dim` shows it as an outdated one."""
    known = np.isfinite(values)
    opaque, outdated = 230, 70  # opacity of a map, and of an outdated one, of 255
    opacity = (outdated if dim else opaque) * known[..., None].astype(np.uint8)
    picture = np.concatenate([colored(np.where(known, values, low), low, high), opacity], -1)
    return np.ascontiguousarray(picture[::-1])


def material_color(number: int) -> tuple[int, int, int]:
    """Returns the colour of a material's surfaces."""
    red, green, blue = (int(255 * part) for part in colormaps["tab20"](number % 20)[:3])
    return red, green, blue


WIDTH = 350.0
LEFT, RIGHT, TOP, BOTTOM = 40.0, 52.0, 15.0, 27.0
"""Margins of axes: labels at the left, a colour bar at the right, the value under the pointer at the top, labels below."""
CURVE_HEIGHT = 84.0
KNOTS = 33
"""Colours of a filter, between which the browser interpolates."""


@dataclass(frozen=True)
class Axis:
    """An axis of a figure."""

    low: float
    """Value at the left end or at the bottom, ..."""
    high: float
    """... and at the other end."""
    label: str
    """Its name with its unit."""
    ticks: tuple[float, ...]

    def share(self, value: Any) -> Any:
        """Returns where values lie: 0 at `low`, 1 at `high`."""
        return (np.asarray(value, float) - self.low) / (self.high - self.low)


def axis_over(low: float, high: float, label: str, count: int = 4) -> Axis:
    """Returns an axis from `low` to `high` with about `count` round ticks."""
    high = high if high > low else low + 1.0
    rough = (high - low) / count
    power = 10 ** np.floor(np.log10(rough))
    steps = (1.0, 2.0, 2.5, 5.0, 10.0)
    step = power * next(s for s in steps if s * power >= rough * (1 - 1e-9))
    ticks = step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1)
    return Axis(low, high, label, tuple((ticks + 0.0).tolist()))  # -0 becomes 0


AZIMUTH = Axis(-180.0, 180.0, "azimuth [°]", (-180.0, -90.0, 0.0, 90.0, 180.0))
ZENITH = Axis(90.0, 0.0, "zenith [°]", (0.0, 45.0, 90.0))
AMPLITUDE = Axis(0.0, 1.0, "amplitude", (0.0, 0.5, 1.0))


def spectrum(pas: Float[np.ndarray, "90 360"], name: str) -> str:
    """Returns a figure of a spectrum: azimuth to the right, zenith 0 at the top, amplitude relative to the maximum as colour.
    `name` distinguishes the figures of a page."""
    box = LEFT, TOP, WIDTH - LEFT - RIGHT, 76.0
    read = "azimuth {x}°, zenith {y}°: amplitude {v}"
    return _figure(
        [_image(pas, box, AMPLITUDE, name), _axes(box, AZIMUTH, ZENITH), _color_bar(box, AMPLITUDE, name)],
        box,
        _data(box, AZIMUTH, ZENITH, read, (0, 0, 2)) | _range(AMPLITUDE),
    )


def power_map(
    values: Float[np.ndarray, "ny nx"],
    x: Axis,
    y: Axis,
    power: Axis,
    walls: Float[np.ndarray, "n 2 2"],
    marks: dict[str, tuple[float, float]],
    dim: bool = False,
) -> str:
    """Returns a figure of a map.

    Args:
        values: powers; NaN where nothing is received. The first row has the smallest y.
        x, y: axes, metres.
        power: axis of the colours.
        walls: ends of the walls that the plane cuts, metres.
        marks: places (x, y) that are marked by their first letter, by name.
        dim: whether the map is shown as an outdated one.
    """
    wide, highest = WIDTH - LEFT - RIGHT, 168.0
    per_metre = min(wide / (x.high - x.low), highest / (y.high - y.low))
    box = LEFT, TOP, per_metre * (x.high - x.low), per_metre * (y.high - y.low)
    lines = "".join(
        f'<line x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}"/>'
        for a, b in _place(walls.reshape(-1, 2), box, x, y).reshape(-1, 2, 2)
    )
    signs = []
    for word, at in marks.items():
        (u, v) = _place(np.array([at]), box, x, y)[0]
        signs.append(
            f'<circle cx="{u:.1f}" cy="{v:.1f}" r="5.5" fill="#fff" stroke="#222"/>'
            f'<text x="{u:.1f}" y="{v + 3:.1f}" text-anchor="middle" font-size="8" fill="#222">{html.escape(word[:1])}</text>'
        )
    parts = [
        f'<g opacity="{0.35 if dim else 1}">{_image(values[::-1], box, power, "map")}</g>',
        f'<g stroke="#222" stroke-width="0.8">{lines}</g>',
        *signs,
        _axes(box, x, y),
        _color_bar(box, power, "map"),
    ]
    return _figure(parts, box, _data(box, x, y, "({x}, {y}) m: {v}", (2, 2, 1)) | _range(power) | {"unit": " " + _unit(power)})


def curve(x_values: Float[np.ndarray, " n"], y_values: Float[np.ndarray, " n"], x: Axis, y: Axis, digits: int = 1) -> str:
    """Returns a figure of a curve; `digits` are those of x in the value under the pointer."""
    box = LEFT, TOP, WIDTH - LEFT - 12, CURVE_HEIGHT
    points = _place(np.stack([x_values, np.clip(y_values, y.low, y.high)], -1), box, x, y)
    line = " ".join(f"{u:.1f},{v:.1f}" for u, v in points)
    drawn = f'<polyline points="{line}" fill="none" stroke="#0072b2" stroke-width="1.4"/>'
    known = [
        [round(float(u), 1), round(float(v), 1), f"{a:.{digits}f} {_unit(x)}: {b:.1f} {_unit(y)}"]
        for (u, v), a, b in zip(points, x_values, y_values, strict=True)
    ]
    return _figure([_axes(box, x, y), drawn], box, {"points": json.dumps(known)})


def stems(
    x_values: Float[np.ndarray, " n"], y_values: Float[np.ndarray, " n"], words: tuple[str, ...], x: Axis, y: Axis
) -> str:
    """Returns a figure with a vertical line for each value; `words` describe them under the pointer."""
    box = LEFT, TOP, WIDTH - LEFT - 12, CURVE_HEIGHT
    points = _place(np.stack([x_values, np.clip(y_values, y.low, y.high)], -1), box, x, y)
    floor = box[1] + box[3]
    lines = "".join(
        f'<line x1="{u:.1f}" x2="{u:.1f}" y1="{floor:.1f}" y2="{v:.1f}"/><circle cx="{u:.1f}" cy="{v:.1f}" r="1.6"/>'
        for u, v in points
    )
    drawn = f'<g stroke="#0072b2" stroke-width="1.2" fill="#0072b2">{lines}</g>'
    known = [
        [round(float(u), 1), round(float(v), 1), f"{a:.1f} {_unit(x)}, {b:.1f} {_unit(y)}: {word}"]
        for (u, v), a, b, word in zip(points, x_values, y_values, words, strict=True)
    ]
    return _figure([_axes(box, x, y), drawn], box, {"points": json.dumps(known)})


def power_legend(power: Axis, fade_db: float) -> str:
    """Returns a horizontal colour bar of the powers of paths; paths fade `fade_db` below the strongest one."""
    label = f"{power.label}; paths {fade_db:.0f} dB below the strongest fade"
    return legend(Axis(power.low, power.high, label, power.ticks), "plasma", (0.0, 5 / 6))


def legend(axis: Axis, colors: str, part: tuple[float, float] = (0.0, 1.0)) -> str:
    """Returns a horizontal colour bar of a part of a colour map."""
    box = LEFT, 4.0, WIDTH - 2 * LEFT, 9.0
    stops = _stops(colors, np.linspace(0, 1, KNOTS), part)
    parts = [
        f'<defs><linearGradient id="{colors}-bar">{stops}</linearGradient></defs>',
        f'<rect x="{box[0]}" y="{box[1]}" width="{box[2]}" height="{box[3]}" fill="url(#{colors}-bar)"/>',
        _x_ticks(box, axis),
        _text(WIDTH / 2, 36.0, axis.label),
    ]
    return _svg(parts, 41.0, {})


def bounce_legend() -> str:
    """Returns the legend of the colours of paths by their number of reflections and diffractions."""
    parts = []
    bounce_words = "none", "one", "two", "three"
    for number, (color, word) in enumerate(zip(BY_BOUNCES, bounce_words, strict=True)):
        u = 8 + 84 * number
        parts.append(f'<rect x="{u}" y="6" width="10" height="10" fill="rgb{tuple(int(c) for c in color)}"/>')
        parts.append(f'<text x="{u + 14}" y="15">{word}</text>')
    return _svg([*parts, _text(WIDTH / 2, 34.0, "reflections and diffractions")], 41.0, {})


def _figure(parts: list[str], box: tuple[float, float, float, float], data: dict[str, str]) -> str:
    spot = '<circle class="wbgs-spot" r="3" fill="none" stroke="#d62728" visibility="hidden"/>'
    read = f'{spot}<text class="wbgs-read" x="{box[0]}" y="10"/>'
    return _svg([*parts, read], box[1] + box[3] + BOTTOM, data)


def _svg(parts: list[str], height: float, data: dict[str, str]) -> str:
    attributes = "".join(f' data-{name}="{html.escape(value, quote=True)}"' for name, value in data.items())
    return f'<svg class="wbgs" viewBox="0 0 {WIDTH:g} {height:.0f}"{attributes}>{"".join(parts)}</svg>'


def _data(box: tuple[float, ...], x: Axis, y: Axis, read: str, digits: tuple[int, int, int]) -> dict[str, str]:
    return {
        "box": json.dumps([round(side, 2) for side in box]),
        "x": json.dumps([x.low, x.high]),
        "y": json.dumps([y.low, y.high]),
        "read": read,
        "digits": json.dumps(digits),
    }


def _range(axis: Axis) -> dict[str, str]:
    return {"v": json.dumps([axis.low, axis.high])}


def _unit(axis: Axis) -> str:
    return axis.label[axis.label.find("[") + 1 : -1] if "[" in axis.label else ""


def _place(points: Float[np.ndarray, "n 2"], box: tuple[float, ...], x: Axis, y: Axis) -> Float[np.ndarray, "n 2"]:
    u = box[0] + box[2] * x.share(points[:, 0])
    v = box[1] + box[3] * (1 - y.share(points[:, 1]))
    return np.stack([u, v], -1)


def _image(values: Float[np.ndarray, "h w"], box: tuple[float, ...], axis: Axis, name: str) -> str:
    """Returns an image of values, the first row at the top, transparent where they are NaN, with its filter of colours."""
    known = np.isfinite(values)
    levels = 255  # grey levels of an image
    grey = (levels * np.clip(axis.share(np.where(known, values, axis.low)), 0, 1)).round().astype(np.uint8)
    stream = io.BytesIO()
    if known.all():
        picture = Image.fromarray(grey)
    else:
        picture = Image.fromarray(np.stack([grey, levels * known.astype(np.uint8)], -1), "LA")
    picture.save(stream, "png", compress_level=1)
    table = color_table(COLORS)[np.linspace(0, 255, KNOTS).astype(int)]
    channels = "".join(
        f'<feFunc{channel} type="table" tableValues="{" ".join(f"{value:.3f}" for value in table[:, i])}"/>'
        for i, channel in enumerate("RGB")
    )
    return (
        f'<defs><filter id="{name}-colors" color-interpolation-filters="sRGB" x="0" y="0" width="1" height="1">'
        f"<feComponentTransfer>{channels}</feComponentTransfer></filter></defs>"
        f'<image x="{box[0]}" y="{box[1]}" width="{box[2]:.2f}" height="{box[3]:.2f}" preserveAspectRatio="none" '
        f'decoding="sync" filter="url(#{name}-colors)" '
        f'href="data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}"/>'
    )


def _axes(box: tuple[float, ...], x: Axis, y: Axis) -> str:
    left, top, width, height = box
    parts = [f'<rect x="{left}" y="{top}" width="{width:.2f}" height="{height:.2f}" fill="none" stroke="#888"/>']
    parts.append(_x_ticks(box, x))
    for tick in y.ticks:
        v = top + height * (1 - float(y.share(tick)))
        parts.append(f'<line x1="{left - 3}" x2="{left}" y1="{v:.1f}" y2="{v:.1f}" stroke="#888"/>')
        parts.append(f'<text x="{left - 5}" y="{v + 3:.1f}" text-anchor="end">{tick:g}</text>')
    parts.append(_text(left + width / 2, top + height + 24, x.label))
    parts.append(_text(9.0, top + height / 2, y.label, turned=True))
    return "".join(parts)


def _text(u: float, v: float, words: str, turned: bool = False) -> str:
    turn = f' transform="rotate(-90 {u:.1f} {v:.1f})"' if turned else ""
    return f'<text x="{u:.1f}" y="{v:.1f}" text-anchor="middle"{turn}>{html.escape(words)}</text>'


def _x_ticks(box: tuple[float, ...], x: Axis) -> str:
    left, top, width, height = box
    below = top + height
    parts = []
    for tick in x.ticks:
        u = left + width * float(x.share(tick))
        parts.append(f'<line x1="{u:.1f}" x2="{u:.1f}" y1="{below:.1f}" y2="{below + 3:.1f}" stroke="#888"/>')
        parts.append(f'<text x="{u:.1f}" y="{below + 12:.1f}" text-anchor="middle">{tick:g}</text>')
    return "".join(parts)


def _color_bar(box: tuple[float, ...], axis: Axis, name: str) -> str:
    left, top, height = box[0] + box[2] + 6, box[1], box[3]
    stops = _stops(COLORS, np.linspace(0, 1, KNOTS), (0.0, 1.0))
    size = f'x="{left:.1f}" y="{top}" width="8" height="{height:.2f}"'
    parts = [
        f'<defs><linearGradient id="{name}-bar" x1="0" x2="0" y1="1" y2="0">{stops}</linearGradient></defs>',
        f'<rect {size} fill="url(#{name}-bar)" stroke="#888" stroke-width="0.5"/>',
    ]
    for tick in axis.ticks:
        v = top + height * (1 - float(axis.share(tick)))
        parts.append(f'<text x="{left + 10:.1f}" y="{v + 3:.1f}">{tick:g}</text>')
    parts.append(_text(left + 40, top + height / 2, axis.label, turned=True))
    return "".join(parts)


def _stops(colors: str, steps: Float[np.ndarray, " n"], part: tuple[float, float]) -> str:
    """Returns the colours of a gradient, those of a part of a colour map."""
    table = color_table(colors)
    places = (255 * (part[0] + (part[1] - part[0]) * steps)).astype(int)
    return "".join(
        f'<stop offset="{step:.3f}" stop-color="rgb{tuple(int(255 * c) for c in table[place])}"/>'
        for step, place in zip(steps, places, strict=True)
    )
