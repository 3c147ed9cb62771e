"""Conversion of numbers to images, coloured points and lines for the browser, with NumPy only."""

import functools

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib import colormaps

from wbgs_jax.propagation.paths import is_vertex
from wbgs_jax.radio.array import pas_directions
from wbgs_jax.radio.channel import NO_PATH_DB

ZOOM = 2
"""Screen pixels per pixel of a spectrum, along both axes."""
DOME_STRIDE = 3
"""Stride of the directions that are drawn at the receiver, along both axes."""
PATH_RANGE_DB = 50.0
"""Range of the colours of paths below the strongest one; weaker paths have the last colour."""
BY_BOUNCES = np.array([[0, 114, 178], [230, 159, 0], [0, 158, 115], [204, 121, 167]], np.uint8)
"""Colours of paths with 0, 1, 2 and 3 reflections or diffractions (Okabe and Ito; distinguishable by the colour-blind)."""
MATERIAL_COLORS = "tab20"
MAP_MARGIN = 0.01
"""Fraction of the values at either end that lie beyond the colours of a map."""


def colored(values: Float[np.ndarray, "*n"], low: float, high: float, name: str = "viridis") -> UInt8[np.ndarray, "*n 3"]:
    """Returns the colours of values; values beyond the range have the colours of its ends."""
    share = (np.asarray(values, np.float64) - low) / max(high - low, 1e-12)
    return (255 * _table(name)[np.clip(share * 255, 0, 255).astype(int)]).astype(np.uint8)


@functools.cache
def _table(name: str) -> Float[np.ndarray, "256 3"]:
    return colormaps[name](np.linspace(0, 1, 256))[:, :3]


def spectrum_picture(pas: Float[np.ndarray, "90 360"]) -> UInt8[np.ndarray, "h w 3"]:
    """Returns a spectrum as an image: zenith at the top, azimuth from -180 to 180 degrees."""
    return np.repeat(np.repeat(colored(pas, 0.0, 1.0), ZOOM, 0), ZOOM, 1)


def dome(
    pas: Float[np.ndarray, "90 360"], rotation: Float[np.ndarray, "3 3"], radius: float
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Returns points around the receiver (offsets in the world frame, metres), whose distance and brightness grow with the
    amplitude from their direction, and their colours. `rotation` rotates the local frame into the world frame."""
    amplitude = pas[::DOME_STRIDE, ::DOME_STRIDE].reshape(-1)
    directions = pas_directions()[::DOME_STRIDE, ::DOME_STRIDE].reshape(-1, 3) @ rotation.T
    return (radius * (0.35 + 0.65 * amplitude))[:, None] * directions, colored(amplitude, 0.0, 1.0)


def bounces(interaction: Int[np.ndarray, "k 5"]) -> Int[np.ndarray, " k"]:
    """Returns the number of reflections and diffractions of paths."""
    return np.sum(is_vertex(interaction), -1)


def path_colors(power_db: Float[np.ndarray, " k"], bounce: Int[np.ndarray, " k"], by_power: bool) -> UInt8[np.ndarray, "k 3"]:
    """Returns a colour per path, by its power or by its number of reflections and diffractions."""
    if by_power:
        top = float(power_db.max(initial=-300.0))
        return colored(power_db, top - PATH_RANGE_DB, top + PATH_RANGE_DB / 5, "plasma")  # its last colours are pale
    return BY_BOUNCES[np.minimum(bounce, len(BY_BOUNCES) - 1)]


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


def stems(delay_ns: Float[np.ndarray, " k"], power_db: Float[np.ndarray, " k"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns delays and powers of a line that shows an impulse response: a floor, with a stem at the delay of every path."""
    order = np.argsort(delay_ns)
    delay, power = delay_ns[order], power_db[order]
    floor = float(power.max(initial=-200.0)) - PATH_RANGE_DB
    up = np.stack([np.full(len(power), floor), np.maximum(power, floor), np.full(len(power), floor)], -1)
    return np.repeat(delay, 3), up.reshape(-1)


def map_picture(values: Float[np.ndarray, "ny nx"]) -> tuple[UInt8[np.ndarray, "ny nx 4"], float, float]:
    """Returns a map as an image, with the largest y at the top, transparent where nothing is received; and the values of the
    first and the last colour."""
    received = values > NO_PATH_DB
    low, high = np.quantile(values[received], [MAP_MARGIN, 1 - MAP_MARGIN]) if received.any() else (-100.0, 0.0)
    picture = np.concatenate([colored(values, float(low), float(high)), 230 * received[..., None].astype(np.uint8)], -1)
    return np.ascontiguousarray(picture[::-1]), float(low), float(high)


def material_color(number: int) -> tuple[int, int, int]:
    """Returns the colour of a material's surfaces."""
    red, green, blue = (int(255 * part) for part in colormaps[MATERIAL_COLORS](number % 20)[:3])
    return red, green, blue
