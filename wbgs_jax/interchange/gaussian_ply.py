"""Import and export of Gaussians as PLY files of 3D Gaussian splatting (Kerbl et al. 2023), which splat viewers open.

Each Gaussian is a vertex, float32, binary little endian: x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0..2 rot_0..3.
Opacity is stored before its sigmoid, scales as natural logarithms, the rotation as a unit quaternion w x y z; colours are the
constant term of spherical harmonics. Radio signals have no colours: the caller decides what the colours represent.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.mesh.ply import read_elements, write_elements
from wbgs_jax.types import Gaussians

SH_CONSTANT = 0.28209479177387814
"""Y_0^0; a colour is 0.5 + SH_CONSTANT * f_dc."""
PLACE, COLOUR, SCALE, TURN = (
    ("x", "y", "z"),
    ("f_dc_0", "f_dc_1", "f_dc_2"),
    *(tuple(f"{name}_{i}" for i in range(count)) for name, count in (("scale", 3), ("rot", 4))),
)
NAMES = (*PLACE, "nx", "ny", "nz", *COLOUR, *(f"f_rest_{i}" for i in range(45)), "opacity", *SCALE, *TURN)
NEEDED = (*PLACE, *COLOUR, "opacity", *SCALE, *TURN)


def write_gaussians(
    path: Path | str,
    gaussians: Gaussians,
    colours: Float[np.ndarray, "n 3"] | None = None,
    opacity: Float[np.ndarray, " n"] | None = None,
) -> int:
    """Writes the Gaussians that are alive and returns their number.

    Args:
        path: of the file.
        gaussians: in the world frame.
        colours: red, green, blue from 0 to 1; grey by default.
        opacity: from 0 to 1; by default that of the Gaussians, `sigmoid(opacity_logits)`.

    Returns:
        Number of Gaussians in the file.

    Raises:
        UserError: the file cannot be written.
    """
    alive = np.asarray(gaussians.alive)
    logits = np.asarray(gaussians.opacity_logits, np.float32)
    most_certain = 1e-6  # minimum distance of opacities from 0 and 1
    if opacity is not None:
        share = np.clip(opacity, most_certain, 1 - most_certain)
        logits = np.log(share / (1 - share))
    rgb = np.full((len(alive), 3), 0.5) if colours is None else np.clip(colours, 0, 1)
    parts = {PLACE: gaussians.means, COLOUR: (rgb - 0.5) / SH_CONSTANT, ("opacity",): logits[:, None]}
    length = np.linalg.norm(gaussians.quats, axis=1, keepdims=True)  # some viewers do not normalise quaternions
    shortest = 1e-12  # lower bound on the length of a quaternion
    parts |= {SCALE: gaussians.log_scales, TURN: gaussians.quats / np.maximum(length, shortest)}
    rows = np.zeros(int(alive.sum()), [(name, "<f4") for name in NAMES])
    for names, values in parts.items():
        for name, column in zip(names, np.asarray(values, np.float32)[alive].T, strict=True):
            rows[name] = column
    write_elements(path, {"vertex": rows})
    return len(rows)


def read_gaussians(path: Path | str) -> tuple[Gaussians, Float[np.ndarray, "n 3"]]:
    """Returns the Gaussians of a splatting PLY file, and their colours from 0 to 1.

    Args:
        path: of the file.

    Returns:
        Gaussians (world frame, metres) and red, green, blue (n, 3).

    Raises:
        UserError: the file is missing, damaged, or has no Gaussians.
    """
    rows = read_elements(path).get("vertex", {})
    missing = [name for name in NEEDED if not isinstance(rows.get(name), np.ndarray)]
    if missing:
        raise UserError(f"{path} has no {missing[0]}: it contains points or a mesh, not Gaussians; export it as splats")
    columns = {
        names: np.stack([np.asarray(rows[name], np.float32) for name in names], -1) for names in (PLACE, COLOUR, SCALE, TURN)
    }
    opacity = np.asarray(rows["opacity"], np.float32)
    if not all(np.isfinite(values).all() for values in (*columns.values(), opacity)):
        raise UserError(f"{path} has NaN or infinite values in its Gaussians; clean it and export it again")
    place, scale, turn = (jnp.asarray(columns[names]) for names in (PLACE, SCALE, TURN))
    colours = np.clip(0.5 + SH_CONSTANT * columns[COLOUR], 0, 1)
    return Gaussians(place, scale, turn, jnp.asarray(opacity)), colours
