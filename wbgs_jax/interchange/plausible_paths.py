"""What paths can be: delays that fit the places, angles in radians, gains without amplification. What is otherwise is of
another unit, and refused by name."""

import numpy as np

from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.ray_paths import RayPaths
from wbgs_jax.radio.array import SPEED_OF_LIGHT

LONGEST_M = 1e6
"""Of a path."""
SLACK, SLACK_M = 1e-3, 0.1
"""By which a path may be shorter than the straight line: rounding, and arrays whose elements stand beside their centre."""
LARGEST_GAIN = 3.0
"""Of a path's amplitude: antennas a hand's breadth apart."""


def check_paths(paths: RayPaths, name: str) -> None:
    """Raises a `UserError` for paths that contradict physics or their places; `name` is theirs."""
    valid = paths.valid
    if not valid.any():
        raise UserError(f"{name} holds no path")
    if not np.isfinite(paths.a[valid]).all() or (gain := np.abs(paths.a[valid]).max()) > LARGEST_GAIN:
        found = "no number" if not np.isfinite(paths.a[valid]).all() else f"{gain:.3g}"
        raise UserError(f"{name}: a path amplifies (|a| is {found}); give amplitudes, no decibels")
    for angle in ("theta_t", "phi_t", "theta_r", "phi_r"):
        largest = np.abs(getattr(paths, angle)[valid]).max()
        if not largest <= 2 * np.pi + 1e-3:
            raise UserError(f"{name}: {angle} is {largest:.3g}; give radians, no degrees")
    length = SPEED_OF_LIGHT * paths.tau
    if (longest := length[valid].max()) > LONGEST_M:
        raise UserError(f"{name}: a path is {longest:.3g} m long (tau {paths.tau[valid].max():.3g}); give delays in seconds")
    straight = np.linalg.norm(paths.targets[:, None] - paths.sources[None], axis=-1)
    short = valid & (length < straight[..., None] * (1 - SLACK) - SLACK_M)
    if short.any():
        r, t, k = np.argwhere(short)[0]
        raise UserError(
            f"{name}: a path is {length[r, t, k]:.3g} m long where transmitter {t + 1} and receiver {r + 1} are "
            f"{straight[r, t]:.3g} m apart; give delays in seconds from the transmitter on (Sionna: normalize_delays=False), "
            "positions in metres, and a row of three numbers for every place"
        )
