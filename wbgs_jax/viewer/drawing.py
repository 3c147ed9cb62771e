"""Conversion of numbers to images, coloured points and lines for the browser, with NumPy only."""

import functools

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib import colormaps

from wbgs_jax.propagation.paths import is_vertex
from wbgs_jax.radio.array import pas_directions

COLORS, GAUSSIAN_COLORS = "viridis", "inferno"
"""Colormaps of spectra and maps, and of Gaussians."""
PATH_RANGE_DB = 40.0
"""Range of the colours of paths below the strongest one; weaker paths fade."""
BY_BOUNCES = np.array([[0, 114, 178], [230, 159, 0], [0, 158, 115], [204, 121, 167]], np.uint8)
"""Colours of paths with 0, 1, 2 and 3 reflections or diffractions (Okabe and Ito; distinguishable by the colour-blind)."""
BOUNCE_WORDS = "none", "one", "two", "three"


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
