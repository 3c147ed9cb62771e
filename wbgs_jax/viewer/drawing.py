"""Numbers to what a browser shows: pictures, coloured points and lines. NumPy alone."""

import functools

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib import colormaps

from wbgs_jax.propagation.paths import NONE, TRANSMITTED
from wbgs_jax.radio.array import pas_directions
from wbgs_jax.radio.channel import NOT_HEARD_DB

ZOOM = 2
"""Screen pixels for one of a spectrum."""
DOME_STRIDE = 3
"""Every third direction along both axes is drawn at the receiver."""
PATH_RANGE_DB = 50.0
"""Weaker paths than the strongest by more are drawn in the last colour."""
BY_BOUNCES = np.array([[0, 114, 178], [230, 159, 0], [0, 158, 115], [204, 121, 167]], np.uint8)
"""Of paths without, with one, two and three reflections or diffractions (Okabe and Ito: told apart by the colour-blind)."""
MATERIAL_COLORS = "tab20"
MAP_MARGIN = 0.01
"""Share of the extreme values that colours of a map leave out."""


def colored(values: Float[np.ndarray, "*n"], low: float, high: float, name: str = "viridis") -> UInt8[np.ndarray, "*n 3"]:
    """Returns colours of values; those beyond the ends have the ends' colours."""
    share = (np.asarray(values, np.float64) - low) / max(high - low, 1e-12)
    return (255 * _table(name)[np.clip(share * 255, 0, 255).astype(int)]).astype(np.uint8)


@functools.cache
def _table(name: str) -> Float[np.ndarray, "256 3"]:
    return colormaps[name](np.linspace(0, 1, 256))[:, :3]


def spectrum_picture(pas: Float[np.ndarray, "90 360"]) -> UInt8[np.ndarray, "h w 3"]:
    """Returns a spectrum as a picture: zenith on top, azimuth from -180 to 180 degrees."""
    return np.repeat(np.repeat(colored(pas, 0.0, 1.0), ZOOM, 0), ZOOM, 1)


def dome(
    pas: Float[np.ndarray, "90 360"], rotation: Float[np.ndarray, "3 3"], radius: float
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Returns points around the receiver, the farther and brighter the more it hears from there (offsets in the world frame,
    metres), and their colours. `rotation` turns its local frame into the world frame."""
    heard = pas[::DOME_STRIDE, ::DOME_STRIDE].reshape(-1)
    directions = pas_directions()[::DOME_STRIDE, ::DOME_STRIDE].reshape(-1, 3) @ rotation.T
    return (radius * (0.35 + 0.65 * heard))[:, None] * directions, colored(heard, 0.0, 1.0)


def bounces(interaction: Int[np.ndarray, "k 5"]) -> Int[np.ndarray, " k"]:
    """Returns how often paths are reflected or diffracted."""
    return ((interaction != NONE) & (interaction != TRANSMITTED)).sum(-1)


def path_colors(power_db: Float[np.ndarray, " k"], bounce: Int[np.ndarray, " k"], by_power: bool) -> UInt8[np.ndarray, "k 3"]:
    """Returns a colour a path, by its power or by how often it is reflected."""
    if by_power:
        top = float(power_db.max(initial=-300.0))
        return colored(power_db, top - PATH_RANGE_DB, top + PATH_RANGE_DB / 5, "plasma")  # its last colours are pale
    return BY_BOUNCES[np.minimum(bounce, len(BY_BOUNCES) - 1)]


def linear(colors: UInt8[np.ndarray, "*n 3"]) -> UInt8[np.ndarray, "*n 3"]:
    """Returns colours as viser 1.1 wants them of lines and of many equal meshes: in proportion to light, not to how bright it
    looks (sRGB)."""
    return (255 * (colors / 255.0) ** 2.2).round().astype(np.uint8)


def path_segments(points: Float[np.ndarray, "k 5 3"], colors: UInt8[np.ndarray, "k 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the straight pieces of paths (n, 2, 3), and the colours of both ends of each (n, 2, 3)."""
    pieces = np.stack([points[:, :-1], points[:, 1:]], 2)
    long = np.linalg.norm(pieces[:, :, 1] - pieces[:, :, 0], axis=-1) > 1e-6
    ends = np.repeat(np.repeat(colors[:, None], 4, 1)[:, :, None], 2, 2)
    return pieces[long], ends[long]


def path_handles(points: Float[np.ndarray, "k 5 3"]) -> Float[np.ndarray, "k 3"]:
    """Returns a place on every path to click at: where it first changes its direction, or the middle of a straight one."""
    straight = np.linalg.norm(points[:, 1] - points[:, 2], axis=-1) < 1e-6
    return np.where(straight[:, None], (points[:, 0] + points[:, 1]) / 2, points[:, 1])


def stems(delay_ns: Float[np.ndarray, " k"], power_db: Float[np.ndarray, " k"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns a line that shows an impulse response: along the floor, and up to every path's power at its delay."""
    order = np.argsort(delay_ns)
    delay, power = delay_ns[order], power_db[order]
    floor = float(power.max(initial=-200.0)) - PATH_RANGE_DB
    up = np.stack([np.full(len(power), floor), np.maximum(power, floor), np.full(len(power), floor)], -1)
    return np.repeat(delay, 3), up.reshape(-1)


def map_picture(values: Float[np.ndarray, "ny nx"]) -> tuple[UInt8[np.ndarray, "ny nx 4"], float, float]:
    """Returns a map as a picture, the largest y on top, clear where nothing is heard; and the values of the first and the last
    colour."""
    heard = values > NOT_HEARD_DB
    low, high = np.quantile(values[heard], [MAP_MARGIN, 1 - MAP_MARGIN]) if heard.any() else (-100.0, 0.0)
    picture = np.concatenate([colored(values, float(low), float(high)), 230 * heard[..., None].astype(np.uint8)], -1)
    return np.ascontiguousarray(picture[::-1]), float(low), float(high)


def material_color(number: int) -> tuple[int, int, int]:
    """Returns the colour of a material's surfaces."""
    red, green, blue = (int(255 * part) for part in colormaps[MATERIAL_COLORS](number % 20)[:3])
    return red, green, blue
