"""Front-to-back blending of tile jobs: I += T alpha Sig, T *= 1 - alpha (paper, equation 6; see reference.py).

A job holds `CHUNK` Gaussians of one tile. Its footprints are computed once and shared by all queries; an unrolled multiply
chain gives the job's own (image, transmittance), and a short loop chains the jobs of every tile. The backward pass
recomputes the chain instead of storing it and turns its pixel sums into small matrix products (docs/performance.md).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Shaped

from wbgs_jax.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.geometry import AZIMUTH_PERIOD
from wbgs_jax.splat.footprint import footprint, mahalanobis2, windowed_exponential
from wbgs_jax.splat.tiles import CHUNK, TILE_COLUMNS, TILE_HEIGHT, TILE_ROWS, TILE_WIDTH, TileJobs

TILE_PIXELS = TILE_HEIGHT * TILE_WIDTH


def _group_size(jobs: int) -> int:
    """Jobs blended at a time: few keep a CPU's cache warm, many fill a GPU. A divisor of the capacity's multiple of 256."""
    return 16 if jax.default_backend() == "cpu" else jobs // 8


def _tile_offsets(dtype) -> tuple[Float[Array, "pixels"], Float[Array, "pixels"], Float[Array, "pixels 6"]]:
    """Pixel offsets (x, y) from a tile's centre, and the monomials 1, x, y, x^2, xy, y^2 of them."""
    y, x = np.meshgrid(
        np.arange(TILE_HEIGHT) - (TILE_HEIGHT - 1) / 2, np.arange(TILE_WIDTH) - (TILE_WIDTH - 1) / 2, indexing="ij"
    )
    x, y = x.ravel(), y.ravel()
    monomials = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
    return jnp.asarray(x, dtype), jnp.asarray(y, dtype), jnp.asarray(monomials, dtype)


def _gather(means2d, conics, attenuation, signal, jobs: TileJobs):
    """Per job and slot: geometry (u, v, conic) relative to the tile's centre, attenuation and signal of every query."""
    centre_x = (jobs.tile % TILE_COLUMNS) * TILE_WIDTH + (TILE_WIDTH - 1) / 2
    centre_y = (jobs.tile // TILE_COLUMNS) * TILE_HEIGHT + (TILE_HEIGHT - 1) / 2
    index = jnp.maximum(jobs.gaussian, 0)
    u = means2d[index, 0] - centre_x[:, None].astype(means2d.dtype)
    u = u - AZIMUTH_PERIOD * jnp.round(u / AZIMUTH_PERIOD)
    v = means2d[index, 1] - centre_y[:, None].astype(means2d.dtype)
    geometry = jnp.concatenate([jnp.stack([u, v], -1), conics[index]], -1)
    live = (jobs.gaussian >= 0)[..., None]
    return geometry, jnp.where(live, attenuation[index], 0), signal[index]


def _grouped(values: Shaped[Array, "jobs ..."], group: int) -> Shaped[Array, "groups group ..."]:
    return values.reshape((-1, group, *values.shape[1:]))


def _slots_first(values: Shaped[Array, "jobs chunk ..."], group: int) -> Shaped[Array, "groups chunk group ..."]:
    return jnp.moveaxis(_grouped(values, group), 2, 1)


def _job_q(geometry: Float[Array, "*n 5"], x: Float[Array, "pixels"], y: Float[Array, "pixels"]) -> Float[Array, "*n pixels"]:
    return mahalanobis2(x - geometry[..., 0:1], y - geometry[..., 1:2], geometry[..., None, 2:])


def _blend_jobs(geometry, attenuation, signal):
    """(image, transmittance) of every job on its own: two (jobs, b, pixels) arrays."""
    jobs, _, b = attenuation.shape
    group = _group_size(jobs)
    x, y, _ = _tile_offsets(attenuation.dtype)

    def blend(args):
        geometry, attenuation, signal = args
        # The barrier keeps XLA from fusing the exponential into every query's chain and computing it B times.
        g = lax.optimization_barrier(footprint(_job_q(geometry, x, y)))
        image = jnp.zeros((group, b, TILE_PIXELS), attenuation.dtype)
        transmittance = image + 1
        for slot in range(CHUNK):
            weight = attenuation[slot][..., None] * g[slot][:, None] * transmittance
            image = image + signal[slot][..., None] * weight
            transmittance = transmittance - weight
        return image, transmittance

    image, transmittance = lax.map(blend, tuple(_slots_first(a, group) for a in (geometry, attenuation, signal)))
    shape = (jobs, b, TILE_PIXELS)
    return image.reshape(shape), transmittance.reshape(shape)


def _put(
    values: Float[Array, "jobs ..."], job: Int[Array, "tiles"], new: Float[Array, "tiles ..."]
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


def _tiles_to_image(tiles: Float[Array, "tiles b pixels"]) -> Float[Array, "b 90 360"]:
    b = tiles.shape[1]
    grid = tiles.reshape(TILE_ROWS, TILE_COLUMNS, b, TILE_HEIGHT, TILE_WIDTH)
    return grid.transpose(2, 0, 3, 1, 4).reshape(b, PAS_HEIGHT, PAS_WIDTH)


def _image_to_tiles(image: Float[Array, "b 90 360"]) -> Float[Array, "tiles b pixels"]:
    b = image.shape[0]
    grid = image.reshape(b, TILE_ROWS, TILE_HEIGHT, TILE_COLUMNS, TILE_WIDTH)
    return grid.transpose(1, 3, 0, 2, 4).reshape(TILE_ROWS * TILE_COLUMNS, b, TILE_PIXELS)


@jax.custom_vjp
def composite(
    means2d: Float[Array, "n 2"],
    conics: Float[Array, "n 3"],
    attenuation: Float[Array, "n b"],
    signal: Float[Array, "n b"],
    jobs: TileJobs,
) -> Float[Array, "b 90 360"]:
    """Blend N splats for B queries. `attenuation` (delta) must lie in [0, 1); `jobs` must not have overflowed.

    Differentiable once, in reverse mode, with respect to the four float arguments.
    """
    image, transmittance = _blend_jobs(*_gather(means2d, conics, attenuation, signal, jobs))
    return _tiles_to_image(_chain_jobs(image, transmittance, jobs, keep_prefix=False)[0])


def _composite_fwd(means2d, conics, attenuation, signal, jobs):
    image, transmittance = _blend_jobs(*_gather(means2d, conics, attenuation, signal, jobs))
    tile_image, prefix = _chain_jobs(image, transmittance, jobs, keep_prefix=True)
    return _tiles_to_image(tile_image), (means2d, conics, attenuation, signal, jobs, tile_image, prefix)


def _blend_group_bwd(geometry, attenuation, signal, cotangent, behind, transmittance):
    """Backward of one group of jobs.

    `behind` is what this job and all later ones add to the pixel, so dI/dalpha = Sig T - (what lies behind) / (1 - alpha).
    Returns per slot: d attenuation, d signal, and the pixel moments of d q (from which all geometry gradients follow).
    """
    _, group, b = attenuation.shape
    x, y, monomials = _tile_offsets(attenuation.dtype)
    one = jnp.ones((TILE_PIXELS, 1), attenuation.dtype)

    def pixel_sum(values):
        flat = values.reshape(group * b, TILE_PIXELS)
        return jnp.matmul(flat, one, precision=lax.Precision.HIGHEST).reshape(group, b)

    def step(carry, slot):
        transmittance, behind = carry
        geometry, attenuation, signal = slot
        q = _job_q(geometry, x, y)
        g, attenuation, signal = footprint(q)[:, None], attenuation[..., None], signal[..., None]
        alpha = attenuation * g
        weight = alpha * transmittance
        behind = behind - signal * weight
        d_alpha = cotangent * (signal * transmittance - behind / (1 - alpha))
        d_q = jnp.sum(attenuation * d_alpha, 1) * windowed_exponential(q)
        return (transmittance - weight, behind), (
            pixel_sum(d_alpha * g),
            pixel_sum(cotangent * weight),
            jnp.matmul(d_q, monomials, precision=lax.Precision.HIGHEST),
        )

    return lax.scan(step, (transmittance, behind), (geometry, attenuation, signal))[1]


def _geometry_gradient(
    geometry: Float[Array, "jobs chunk 5"], moments: Float[Array, "jobs chunk 6"]
) -> Float[Array, "jobs chunk 5"]:
    """Gradients of (u, v, conic xx, xy, yy) from the moments of -2 dL/dq about the tile's centre."""
    u, v, a, b, c = jnp.moveaxis(geometry, -1, 0)
    m0, mx, my, mxx, mxy, myy = jnp.moveaxis(moments, -1, 0)
    dx, dy = mx - u * m0, my - v * m0
    dxx, dyy = mxx - 2 * u * mx + u * u * m0, myy - 2 * v * my + v * v * m0
    dxy = mxy - u * my - v * mx + u * v * m0
    return jnp.stack([a * dx + b * dy, c * dy + b * dx, -0.5 * dxx, -dxy, -0.5 * dyy], -1)


def _composite_bwd(residuals, cotangent):
    means2d, conics, attenuation, signal, jobs, tile_image, (prefix_t, prefix_image) = residuals
    n, b = attenuation.shape
    n_jobs = jobs.tile.shape[0]
    group = _group_size(n_jobs)
    tile_cotangent = _image_to_tiles(cotangent)
    geometry, job_attenuation, job_signal = _gather(means2d, conics, attenuation, signal, jobs)

    def backward(args):
        geometry, attenuation, signal, tile, transmittance, image = args
        return _blend_group_bwd(geometry, attenuation, signal, tile_cotangent[tile], tile_image[tile] - image, transmittance)

    slots = tuple(_slots_first(a, group) for a in (geometry, job_attenuation, job_signal))
    groups = tuple(_grouped(a, group) for a in (jobs.tile, prefix_t, prefix_image))
    d_attenuation, d_signal, moments = (
        jnp.moveaxis(a, 1, 2).reshape((n_jobs, CHUNK, *a.shape[3:])) for a in lax.map(backward, slots + groups)
    )
    per_slot = jnp.concatenate([_geometry_gradient(geometry, moments), d_attenuation, d_signal], -1).reshape(n_jobs * CHUNK, -1)
    owner = jnp.where(jobs.gaussian >= 0, jobs.gaussian, n).reshape(-1)
    total = jnp.zeros((n + 1, per_slot.shape[1]), per_slot.dtype).at[owner].add(per_slot)[:n]
    return total[:, :2], total[:, 2:5], total[:, 5 : 5 + b], total[:, 5 + b :], None


composite.defvjp(_composite_fwd, _composite_bwd)
