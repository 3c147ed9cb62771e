"""Front-to-back blending of tile lists: I += T alpha Sig, T *= 1 - alpha (paper, equation 6; see reference.py).

A job holds `CHUNK` Gaussians of one tile. Its footprints are computed once and shared by all queries, and an unrolled multiply
chain blends it. Two forms of the same image; the platform that the code is lowered for decides (docs/performance.md):

* by tiles, on CPUs: `TILE_GROUP` tiles go through their jobs together, from near to far, and what they hold stays in the cache;
* by jobs, elsewhere: thousands of jobs are blended at once, each on its own, and a short loop chains those of every tile.

The backward passes recompute the chain instead of storing it and turn its pixel sums into small matrix products.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Shaped

from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.radio.geometry import AZIMUTH_PERIOD
from wbgs_jax.splat.footprint import footprint, mahalanobis2, windowed_exponential
from wbgs_jax.splat.reverse_mode import not_differentiable, reverse_mode_only
from wbgs_jax.splat.tiles import CHUNK, N_TILES, TILE_COLUMNS, TILE_HEIGHT, TILE_ROWS, TILE_WIDTH, TileJobs

TILE_PIXELS = TILE_HEIGHT * TILE_WIDTH
TILE_GROUP = 25
"""Tiles that a CPU blends together: many for its vector units, few for its caches, and few enough that XLA does not share every
small step between threads, which costs more than it gains. Divides `N_TILES`."""
JOB_GROUPS = 8
"""Elsewhere all jobs go in this many groups: large ones fill the device, one alone would need the memory of all footprints.
Divides the jobs of all limits."""


@jax.jit
def composite(
    means2d: Float[Array, "n 2"],
    conics: Float[Array, "n 3"],
    attenuation: Float[Array, "n b"],
    signal: Float[Array, "n b"],
    jobs: TileJobs,
) -> Float[Array, "b 90 360"]:
    """Returns N splats blended for B queries. `attenuation` (delta) must lie in [0, 1); `jobs` must not have overflowed.

    Differentiable once, in reverse mode, with respect to the four float arguments.

    Raises:
        TypeError: forward-mode differentiation or a second derivative, which the hand-written backward pass does not allow;
            of a jitted function when it is compiled, from `jax.linearize` when its result is called.
    """
    own = map(reverse_mode_only, (jnp.concatenate([means2d, conics], -1), attenuation, signal))
    tiles = lax.platform_dependent(*own, jobs, cpu=_by_tiles, default=_by_jobs)
    grid = tiles.reshape(TILE_ROWS, TILE_COLUMNS, -1, TILE_HEIGHT, TILE_WIDTH)
    return grid.transpose(2, 0, 3, 1, 4).reshape(-1, PAS_HEIGHT, PAS_WIDTH)


def _tile_offsets(dtype) -> tuple[Float[np.ndarray, " pixels"], Float[np.ndarray, " pixels"], Float[np.ndarray, "pixels 6"]]:
    """Pixel offsets (x, y) from a tile's centre, and the monomials 1, x, y, x^2, xy, y^2 of them."""
    y, x = np.meshgrid(
        np.arange(TILE_HEIGHT) - (TILE_HEIGHT - 1) / 2, np.arange(TILE_WIDTH) - (TILE_WIDTH - 1) / 2, indexing="ij"
    )
    x, y = x.ravel(), y.ravel()
    monomials = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
    return x.astype(dtype), y.astype(dtype), monomials.astype(dtype)


def _gather(geometry, attenuation, signal, gaussian: Int[Array, "jobs chunk"], tile: Int[Array, " jobs"]):
    """Per slot and job: geometry (u, v, conic) relative to the tile's centre, attenuation and signal of every query."""
    gaussian = gaussian.T
    index = jnp.maximum(gaussian, 0)
    own = geometry[index]
    centre_x = (tile % TILE_COLUMNS) * TILE_WIDTH + (TILE_WIDTH - 1) / 2
    centre_y = (tile // TILE_COLUMNS) * TILE_HEIGHT + (TILE_HEIGHT - 1) / 2
    u, v = own[..., 0] - centre_x.astype(own.dtype), own[..., 1] - centre_y.astype(own.dtype)
    u = u - AZIMUTH_PERIOD * jnp.round(u / AZIMUTH_PERIOD)
    own = jnp.concatenate([jnp.stack([u, v], -1), own[..., 2:]], -1)
    return own, jnp.where(gaussian[..., None] >= 0, attenuation[index], 0), signal[index]


def _q(
    geometry: Float[Array, "*n 5"], x: Float[np.ndarray, " pixels"], y: Float[np.ndarray, " pixels"]
) -> Float[Array, "*n pixels"]:
    return mahalanobis2(geometry[..., 0:1] - x, geometry[..., 1:2] - y, geometry[..., None, 2:])


def _blend(slots, image: Float[Array, "jobs b pixels"], transmittance: Float[Array, "jobs b pixels"]):
    """Image and transmittance behind one job of every tile, given those in front of it."""
    geometry, attenuation, signal = slots
    x, y, _ = _tile_offsets(attenuation.dtype)
    # The barrier keeps XLA from fusing the exponential into every query's chain and computing it B times.
    g = lax.optimization_barrier(footprint(_q(geometry, x, y)))
    for slot in range(CHUNK):
        weight = attenuation[slot][..., None] * g[slot][:, None] * transmittance
        image = image + signal[slot][..., None] * weight
        transmittance = transmittance - weight
    return image, transmittance


def _blend_bwd(slots, cotangent, behind, transmittance):
    """Backward of one job of every tile.

    `behind` is what these jobs and all later ones add to the pixel, so dI/dalpha = Sig T - (what lies behind) / (1 - alpha).
    Returns `behind` and `transmittance` for the next job, and per slot the gradients of geometry, attenuation and signal.
    """
    _, jobs, b = slots[1].shape
    x, y, monomials = _tile_offsets(cotangent.dtype)
    one = jnp.ones((TILE_PIXELS, 1), cotangent.dtype)

    def pixel_sum(values):
        flat = values.reshape(jobs * b, TILE_PIXELS)
        return jnp.matmul(flat, one, precision=lax.Precision.HIGHEST).reshape(jobs, b)

    def step(carry, slot):
        behind, transmittance = carry
        geometry, attenuation, signal = slot
        q = _q(geometry, x, y)
        g, attenuation, signal = footprint(q)[:, None], attenuation[..., None], signal[..., None]
        alpha = attenuation * g
        weight = alpha * transmittance
        behind = behind - signal * weight
        d_alpha = cotangent * (signal * transmittance - behind / (1 - alpha))
        d_q = jnp.sum(attenuation * d_alpha, 1) * windowed_exponential(q)
        return (behind, transmittance - weight), (
            jnp.matmul(d_q, monomials, precision=lax.Precision.HIGHEST),
            pixel_sum(d_alpha * g),
            pixel_sum(cotangent * weight),
        )

    (behind, transmittance), (moments, *gradients) = lax.scan(step, (behind, transmittance), slots)
    return behind, transmittance, jnp.concatenate([_geometry_gradient(slots[0], moments), *gradients], -1)


def _geometry_gradient(geometry: Float[Array, "*n 5"], moments: Float[Array, "*n 6"]) -> Float[Array, "*n 5"]:
    """Gradients of (u, v, conic xx, xy, yy) from the moments of -2 dL/dq about the tile's centre."""
    u, v, a, b, c = jnp.moveaxis(geometry, -1, 0)
    m0, mx, my, mxx, mxy, myy = jnp.moveaxis(moments, -1, 0)
    dx, dy = mx - u * m0, my - v * m0
    dxx, dyy = mxx - 2 * u * mx + u * u * m0, myy - 2 * v * my + v * v * m0
    dxy = mxy - u * my - v * mx + u * v * m0
    return jnp.stack([a * dx + b * dy, c * dy + b * dx, -0.5 * dxx, -dxy, -0.5 * dyy], -1)


def _no_gradient(attenuation: Float[Array, "n b"]) -> Float[Array, "n_1 f"]:
    """Zeros for every Gaussian's geometry, attenuation and signal, and one row more."""
    n, b = attenuation.shape
    return jnp.zeros((n + 1, 5 + 2 * b), attenuation.dtype)


def _sum_by_gaussian(total: Float[Array, "n_1 f"], gaussian: Int[Array, "jobs chunk"], per_slot: Float[Array, "chunk jobs f"]):
    """Add the gradients of slots to those of their Gaussians; empty slots go to a row past the end."""
    owner = jnp.where(gaussian >= 0, gaussian, total.shape[0] - 1).T
    return total.at[owner.reshape(-1)].add(per_slot.reshape(-1, total.shape[1]))


def _split_gradient(total: Float[Array, "n_1 f"], attenuation: Float[Array, "n b"]):
    """(d geometry, d attenuation, d signal, nothing for the jobs)."""
    b = attenuation.shape[1]
    return total[:-1, :5], total[:-1, 5 : 5 + b], total[:-1, 5 + b :], None


# By tiles


def _tile_groups(jobs: TileJobs) -> Int[Array, "groups tiles"]:
    """Tiles with lists of similar length go together."""
    return jnp.argsort(-jobs.count).reshape(-1, TILE_GROUP)


def _next_jobs(jobs: TileJobs, tiles: Int[Array, " tiles"], level: Int[Array, ""]) -> Int[Array, "tiles chunk"]:
    """The Gaussians of the tiles' jobs of a level; -1 where a tile has no such job."""
    live = level < jobs.count[tiles]
    gaussian = jobs.gaussian[jnp.where(live, jobs.first[tiles] + level, 0)]
    return jnp.where(live[:, None], gaussian, -1)


@jax.custom_vjp
def _by_tiles(geometry, attenuation, signal, jobs: TileJobs) -> Float[Array, "tiles b pixels"]:
    groups = _tile_groups(jobs)

    def blend_group(tiles):
        def blend_level(level, state):
            return _blend(_gather(geometry, attenuation, signal, _next_jobs(jobs, tiles, level), tiles), *state)

        blank = jnp.zeros((TILE_GROUP, attenuation.shape[1], TILE_PIXELS), attenuation.dtype)
        return lax.fori_loop(0, jnp.max(jobs.count[tiles]), blend_level, (blank, blank + 1))[0]

    image = lax.map(blend_group, groups)
    return image.reshape(N_TILES, *image.shape[2:])[jnp.argsort(groups.reshape(-1))]


def _by_tiles_fwd(geometry, attenuation, signal, jobs):
    image = _by_tiles(geometry, attenuation, signal, jobs)
    return image, (geometry, attenuation, signal, jobs, image)


def _by_tiles_bwd(residuals, cotangent):
    jobs, image = residuals[3:]
    geometry, attenuation, signal = map(not_differentiable, residuals[:3])

    def group_bwd(total, tiles):
        own = cotangent[tiles]

        def level_bwd(level, state):
            behind, transmittance, total = state
            gaussian = _next_jobs(jobs, tiles, level)
            slots = _gather(geometry, attenuation, signal, gaussian, tiles)
            behind, transmittance, per_slot = _blend_bwd(slots, own, behind, transmittance)
            return behind, transmittance, _sum_by_gaussian(total, gaussian, per_slot)

        state = image[tiles], jnp.ones_like(own), total
        return lax.fori_loop(0, jnp.max(jobs.count[tiles]), level_bwd, state)[2], None

    return _split_gradient(lax.scan(group_bwd, _no_gradient(attenuation), _tile_groups(jobs))[0], attenuation)


_by_tiles.defvjp(_by_tiles_fwd, _by_tiles_bwd)


# By jobs


def _map_jobs(function: Callable[..., Any], *arrays: Shaped[Array, "jobs ..."]) -> Any:
    """`function` of all jobs, in `JOB_GROUPS` calls."""
    results = lax.map(lambda group: function(*group), tuple(a.reshape(JOB_GROUPS, -1, *a.shape[1:]) for a in arrays))
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), results)


def _blend_jobs(geometry, attenuation, signal, jobs: TileJobs):
    """(image, transmittance) of every job on its own: two (jobs, b, pixels) arrays."""

    def blend_group(gaussian, tile):
        blank = jnp.zeros((len(tile), attenuation.shape[1], TILE_PIXELS), attenuation.dtype)
        return _blend(_gather(geometry, attenuation, signal, gaussian, tile), blank, blank + 1)

    return _map_jobs(blend_group, jobs.gaussian, jobs.tile)


def _put(
    values: Float[Array, "jobs ..."], job: Int[Array, " tiles"], new: Float[Array, "tiles ..."]
) -> Float[Array, "jobs ..."]:
    """Store a value for every tile's job; tiles without one point past the end."""
    return values.at[job].set(new, mode="drop", unique_indices=True)


def _chain_jobs(image, transmittance, jobs: TileJobs, keep_prefix: bool):
    """Blend the jobs of every tile in order. Returns the tiles' image and, if wanted, each job's (T, I) in front of it."""
    n_jobs = image.shape[0]
    blank = jnp.zeros((jobs.first.shape[0], *image.shape[1:]), image.dtype)
    prefix = (jnp.ones_like(image), jnp.zeros_like(image)) if keep_prefix else None

    def step(level, state):
        tile_image, tile_transmittance, prefix = state
        live = level < jobs.count
        job = jnp.where(live, jobs.first + level, n_jobs)
        if prefix is not None:
            prefix = (_put(prefix[0], job, tile_transmittance), _put(prefix[1], job, tile_image))
        job, live = jnp.minimum(job, n_jobs - 1), live[:, None, None]
        tile_image = jnp.where(live, tile_image + tile_transmittance * image[job], tile_image)
        tile_transmittance = jnp.where(live, tile_transmittance * transmittance[job], tile_transmittance)
        return tile_image, tile_transmittance, prefix

    tile_image, _, prefix = lax.fori_loop(0, jnp.max(jobs.count), step, (blank, blank + 1, prefix))
    return tile_image, prefix


@jax.custom_vjp
def _by_jobs(geometry, attenuation, signal, jobs: TileJobs) -> Float[Array, "tiles b pixels"]:
    image, transmittance = _blend_jobs(geometry, attenuation, signal, jobs)
    return _chain_jobs(image, transmittance, jobs, keep_prefix=False)[0]


def _by_jobs_fwd(geometry, attenuation, signal, jobs):
    image, transmittance = _blend_jobs(geometry, attenuation, signal, jobs)
    tile_image, prefix = _chain_jobs(image, transmittance, jobs, keep_prefix=True)
    return tile_image, (geometry, attenuation, signal, jobs, tile_image, prefix)


def _by_jobs_bwd(residuals, cotangent):
    jobs, image, (prefix_t, prefix_image) = residuals[3:]
    geometry, attenuation, signal = map(not_differentiable, residuals[:3])

    def group_bwd(gaussian, tile, transmittance, front):
        slots = _gather(geometry, attenuation, signal, gaussian, tile)
        return jnp.swapaxes(_blend_bwd(slots, cotangent[tile], image[tile] - front, transmittance)[2], 0, 1)

    per_slot = jnp.swapaxes(_map_jobs(group_bwd, jobs.gaussian, jobs.tile, prefix_t, prefix_image), 0, 1)
    return _split_gradient(_sum_by_gaussian(_no_gradient(attenuation), jobs.gaussian, per_slot), attenuation)


_by_jobs.defvjp(_by_jobs_fwd, _by_jobs_bwd)
