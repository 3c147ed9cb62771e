"""What paths can be: delays that fit the places, angles in radians, gains without amplification. What is otherwise is of
another unit, and refused by name."""

import numpy as np
from jaxtyping import Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.interchange.ray_paths import NONE, RayPaths, directions_of
from wbgs_jax.radio.array import SPEED_OF_LIGHT

LONGEST_M = 1e6
"""Of a path."""
SLACK, SLACK_M = 1e-3, 0.1
"""By which a path may be shorter than the straight line: rounding, and arrays whose elements stand beside their centre."""
SAME, SAME_M = 1e-4, 0.01
"""By which the length of a path may differ from the straight line that is the line of sight."""
ASIDE_DEGREES, NEAREST_M = 10.0, 0.5
"""By which the angles of lines of sight may differ from those of their ends, and how far apart these are at least."""
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
    _check_vertices(paths, name, length)
    _check_sight(paths, name, length, straight[..., None])


def _check_vertices(paths: RayPaths, name: str, length: Float[np.ndarray, "r t k"]) -> None:
    """Raises a `UserError` where most paths are of another length than the line through their vertices, or between their ends
    where they have none."""
    if not len(paths.interactions):  # nobody has recorded them
        return
    here, along = np.broadcast_to(paths.sources[None, :, None], (*length.shape, 3)), np.zeros(length.shape)
    for met, there in zip(paths.interactions != NONE, paths.vertices, strict=True):
        along = along + np.where(met, np.linalg.norm(there - here, axis=-1), 0)
        here = np.where(met[..., None], there, here)
    along = along + np.linalg.norm(paths.targets[:, None, None] - here, axis=-1)
    known = paths.valid & np.isfinite(along)
    other = known & (np.abs(length - along) > length * SLACK + SLACK_M)
    if other.sum() > known.sum() / 2:
        r, t, k = np.argwhere(other)[0]
        long, drawn = length[r, t, k], along[r, t, k]
        raise UserError(
            f"{name}: a path from transmitter {t + 1} to receiver {r + 1} is {long:.3g} m long, and {drawn:.3g} m "
            "through its vertices; give positions in metres, in one frame, a row of three numbers for every place"
        )


def _check_sight(paths: RayPaths, name: str, length: Float[np.ndarray, "r t k"], straight: Float[np.ndarray, "r t 1"]) -> None:
    """Raises a `UserError` where lines of sight come from elsewhere than the other end."""
    sight = paths.valid & (np.abs(length - straight) <= straight * SAME + SAME_M) & (straight > NEAREST_M)
    if not sight.any():
        return
    towards = (paths.sources - paths.targets[:, None])[:, :, None] / np.maximum(straight, NEAREST_M)[..., None]
    for end, sign in (("r", 1), ("t", -1)):
        found = directions_of(getattr(paths, f"theta_{end}"), getattr(paths, f"phi_{end}"))
        cosine = np.sum(found * sign * towards, -1)[sight]
        if (aside := np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1)))) > ASIDE_DEGREES:
            raise UserError(
                f"{name}: theta_{end}, phi_{end} of lines of sight point {aside:.0f} degrees beside the other end; give angles "
                "in the frame of the positions, theta from +z, phi from +x, outwards at both ends"
            )
