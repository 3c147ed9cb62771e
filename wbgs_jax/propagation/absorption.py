"""What stands in the way of waves and is not in the mesh: furniture, plants, people. It is a grid of cells, each of which
weakens what passes through it:

    amplitude *= exp(-A),    A = integral of the density (nepers per metre) along the path

as in tomography. Shadows are all that this knows: what clutter reflects, and how it turns phases, it does not.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax._util.pytree import pytree
from wbgs_jax.mesh.facets import AnyArray
from wbgs_jax.propagation.transport import SHORTEST

SAMPLES = 64
"""Points along a path at which the density is looked up."""


@pytree
class Grid:
    """Where the cells are; how many of them there are along each axis is the shape of what they hold."""

    low: Float[AnyArray, "3"]
    """The corner of the first cell, world frame, metres."""
    cell: Float[AnyArray, ""]
    """The side of a cell, metres."""


def grid_around(points: Float[np.ndarray, "n 3"], finest_m: float, most: int) -> tuple[Grid, tuple[int, int, int]]:
    """Returns a grid over the bounding box of some points, and its shape (host): cubes of `finest_m` or, where that would be
    more than `most` cells, of as much more as it takes."""
    low, extent = points.min(0), np.ptp(points, axis=0)
    cell = finest_m
    while np.prod(shape := np.maximum(np.ceil(extent / cell), 1).astype(int)) > most:
        cell *= 1.05
    x, y, z = shape.tolist()
    return Grid(np.asarray(low, np.float32), np.asarray(cell, np.float32)), (x, y, z)


def smoothed(density: Float[Array, "x y z *n"]) -> Float[Array, "x y z *n"]:
    """Returns it with every cell a mean of itself (a half) and its two neighbours (a quarter each), axis by axis: what cells
    say of paths does not change suddenly from one to the next. Beyond the grid all is as in its last cells."""
    for axis, count in enumerate(density.shape[:3]):
        padded = jnp.pad(density, [(int(axis == other),) * 2 for other in range(density.ndim)], mode="edge")
        before, own, after = (jax.lax.slice_in_dim(padded, start, start + count, axis=axis) for start in range(3))
        density = 0.25 * before + 0.5 * own + 0.25 * after
    return density


def attenuation(points: Float[Array, "k p 3"], density: Float[Array, "x y z"], grid: Grid) -> Float[Array, " k"]:
    """Returns the integral of the density (1/m) along K paths, by the midpoint rule with `SAMPLES` points.

    Args:
        points: that the paths are straight between (the last ones may coincide), world frame, metres.
        density: of every cell; beyond the grid it is that of the nearest cell.
        grid: where the cells are.
    """
    start, leg = points[:, :-1], jnp.diff(points, axis=1)
    length = jnp.sqrt(jnp.maximum(jnp.sum(leg**2, -1), SHORTEST**2))
    gone = jnp.cumsum(length, -1) - length
    total = jnp.sum(length, -1)
    at = (jnp.arange(SAMPLES) + 0.5) / SAMPLES * total[:, None]
    share = jnp.clip((at[..., None] - gone[:, None]) / length[:, None], 0, 1)  # of every leg, how much lies behind
    place = start[:, None, 0] + jnp.sum(share[..., None] * leg[:, None], -2)
    last = jnp.asarray(density.shape) - 1
    x, y, z = jnp.moveaxis(jnp.clip(jnp.floor((place - grid.low) / grid.cell).astype(jnp.int32), 0, last), -1, 0)
    return total * jnp.mean(density[x, y, z], -1)
