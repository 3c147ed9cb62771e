"""Absorption grid: attenuation by objects that are not in the mesh, such as furniture, plants and people. Each cell attenuates
the waves that pass through it,

    amplitude *= exp(-A),    A = integral of the density (nepers per metre) along the path

as in tomography. The grid models shadowing only: neither reflections by these objects nor phase changes.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax._util.pytree import AnyArray, pytree
from wbgs_jax.propagation.transport import SHORTEST

SAMPLES = 64
"""Sample points of the density along a path."""


@pytree
class Grid:
    """Position and size of the cells; their number along each axis is the shape of the density array."""

    low: Float[AnyArray, "3"]
    """Corner of the first cell, world frame, metres."""
    cell: Float[AnyArray, ""]
    """Edge length of a cell, metres."""


def grid_around(points: Float[np.ndarray, "n 3"], finest_m: float, most: int) -> tuple[Grid, tuple[int, int, int]]:
    """Returns a grid over the bounding box of points, and its shape (computed on the host).

    Args:
        points: world frame, metres.
        finest_m: smallest edge length of the cubic cells, metres; enlarged until there are at most `most` cells.
        most: largest number of cells.
    """
    low, extent = points.min(0), np.ptp(points, axis=0)
    cell = finest_m
    while np.prod(shape := np.maximum(np.ceil(extent / cell), 1).astype(int)) > most:
        cell *= 1.05
    x, y, z = shape.tolist()
    return Grid(np.asarray(low, np.float32), np.asarray(cell, np.float32)), (x, y, z)


def smoothed(density: Float[Array, "x y z *n"]) -> Float[Array, "x y z *n"]:
    """Returns the density with every cell replaced by a mean of itself (1/2) and its two neighbours (1/4 each), axis by axis,
    so that the attenuation of paths varies gradually from cell to cell. Beyond the grid the outermost cells are repeated."""
    for axis, count in enumerate(density.shape[:3]):
        padded = jnp.pad(density, [(int(axis == other),) * 2 for other in range(density.ndim)], mode="edge")
        before, own, after = (jax.lax.slice_in_dim(padded, start, start + count, axis=axis) for start in range(3))
        density = 0.25 * before + 0.5 * own + 0.25 * after
    return density


def attenuation(points: Float[Array, "k p 3"], density: Float[Array, "x y z"], grid: Grid) -> Float[Array, " k"]:
    """Returns the integral of the density (1/m) along K paths, by the midpoint rule with `SAMPLES` points.

    Args:
        points: vertices of the paths, joined by straight segments (the last ones may coincide), world frame, metres.
        density: nepers per metre of every cell; beyond the grid, that of the nearest cell.
        grid: position and size of the cells.
    """
    start, segment = points[:, :-1], jnp.diff(points, axis=1)
    length = jnp.sqrt(jnp.maximum(jnp.sum(segment**2, -1), SHORTEST**2))
    passed = jnp.cumsum(length, -1) - length
    total = jnp.sum(length, -1)
    at = (jnp.arange(SAMPLES) + 0.5) / SAMPLES * total[:, None]
    share = jnp.clip((at[..., None] - passed[:, None]) / length[:, None], 0, 1)  # of every segment: the fraction passed so far
    place = start[:, None, 0] + jnp.sum(share[..., None] * segment[:, None], -2)
    last = jnp.asarray(density.shape) - 1
    x, y, z = jnp.moveaxis(jnp.clip(jnp.floor((place - grid.low) / grid.cell).astype(jnp.int32), 0, last), -1, 0)
    return total * jnp.mean(density[x, y, z], -1)
