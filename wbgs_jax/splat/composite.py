"""Front-to-back alpha blending of tile lists: I += T alpha Sig, T *= 1 - alpha (paper, equation 6; see `render_dense`), and the
image of Gaussians, composed of projection.py, tiles.py and the blending here.

The receiver is fixed, so everything geometric (projection, depth order, tile lists) is computed once as a `GeometryPlan` and
shared by any number of queries, which differ only in attenuation and signal.

A job holds `CHUNK` Gaussians of one tile. Its footprints are computed once and shared by all queries; an unrolled chain of
products blends them. There are two implementations of the same image, chosen by the platform that the code is lowered for
(docs/performance.md):

* by tiles (this module): a group of tiles steps through its jobs from near to far, so that the working set stays in a CPU's
  cache;
* by jobs, on NVIDIA GPUs (fused_kernels.py): thousands of jobs are blended independently and then joined tile by tile.

The backward passes recompute the chain instead of storing it and turn its sums over pixels into matrix products.

The hand-written backward pass allows neither forward-mode nor second derivatives. JAX rejects these too, but its messages refer
to an internal function or to a loop inside it. `reverse_mode_only` and `not_differentiable` therefore raise a clear error; both
are the identity and cost nothing at run time.
"""

from typing import Any, NoReturn

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float, Int

from wbgs_jax._util.checks import check_array
from wbgs_jax._util.pytree import AnyArray, pytree
from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.radio.geometry import AZIMUTH_PERIOD, Projection
from wbgs_jax.splat.per_platform import per_platform
from wbgs_jax.splat.projection import Splats, footprint, mahalanobis2, project, windowed_exponential, wrap_azimuth
from wbgs_jax.splat.tiles import CHUNK, TileJobs, TileLimits, Tiling, build_tile_jobs, fit_limits
from wbgs_jax.types import Gaussians, Receiver


def _refuse(*_: Any, **__: Any) -> NoReturn:
    raise TypeError(
        "splatting is differentiable in reverse mode only: use jax.grad, jax.vjp or jax.jacrev instead of jax.jvp, jax.jacfwd "
        "or jax.linearize, and no second derivatives"
    )


_tangent = Primitive("reverse_mode_only")
"""(x, its tangent) -> the tangent. Reverse mode transposes it away. Forward mode evaluates it, compiles it, or maps it over
several tangents of one x; all three raise."""


def _map(arguments: Any, axes: Any) -> Any:
    if axes[0] is None:  # x is not mapped: forward mode over several tangents
        _refuse()
    x, tangent = arguments[0], jnp.moveaxis(arguments[1], axes[1], axes[0])
    return _tangent.bind(x, tangent), axes[0]


def _differentiate_again(arguments: Any, tangents: Any) -> Any:
    (x, tangent), further = arguments, tangents[1]
    return _tangent.bind(x, tangent), further if isinstance(further, ad.Zero) else _tangent.bind(x, further)


_tangent.def_abstract_eval(lambda x, tangent: tangent)
_tangent.def_impl(_refuse)
mlir.register_lowering(_tangent, _refuse)
batching.primitive_batchers[_tangent] = _map
ad.primitive_jvps[_tangent] = _differentiate_again
ad.primitive_transposes[_tangent] = lambda cotangent, x, tangent: [None, cotangent]


@jax.custom_jvp
def reverse_mode_only(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns x. Forward-mode differentiation raises a TypeError; under jit this happens at compile time."""
    return x


@reverse_mode_only.defjvp
def _reverse_mode_only_jvp(primals, tangents):
    return reverse_mode_only(*primals), _tangent.bind(*primals, *tangents)


@jax.custom_jvp
def not_differentiable(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns x. Differentiation of any kind raises a TypeError."""
    return x


not_differentiable.defjvp(_refuse)


TILE_GROUP = 25
"""Maximum number of tiles that a CPU blends together: enough to fill its vector units, few enough for its caches, and few
enough that XLA does not split every small step between threads, which costs more than it saves."""


@jax.jit
def composite(
    means2d: Float[Array, "n 2"],
    conics: Float[Array, "n 3"],
    attenuation: Float[Array, "n b"],
    signal: Float[Array, "n b"],
    jobs: TileJobs,
) -> Float[Array, "b 90 360"]:
    """Returns N splats blended for B queries.

    Differentiable once, in reverse mode, with respect to the four float arguments.

    Args:
        means2d: centres, pixels.
        conics: inverse 2D covariances (xx, xy, yy), 1 / px^2.
        attenuation: delta of every Gaussian and query, in [0, 1).
        signal: Sig of every Gaussian and query.
        jobs: tile lists, which must not have overflowed.

    Raises:
        TypeError: forward-mode differentiation or a second derivative, which the hand-written backward pass does not allow;
            for a jitted function at compile time, for `jax.linearize` when its result is called.
    """
    arrays = jnp.concatenate([means2d, conics], -1), attenuation, signal
    precision = jnp.result_type(*arrays)  # they differ if the queries are in double precision and the field is in single
    own = (reverse_mode_only(array.astype(precision)) for array in arrays)
    return assembled(_blend_tiles(*own, jobs), jobs.tiling)


def assembled(tiles: Float[Array, "tiles b pixels"], tiling: Tiling) -> Float[Array, "b 90 360"]:
    """Returns images (pixels) assembled from their tiles."""
    grid = tiles.reshape(tiling.rows, tiling.columns, -1, tiling.height, tiling.width)
    return grid.transpose(2, 0, 3, 1, 4).reshape(-1, tiling.rows * tiling.height, PAS_WIDTH)[:, :PAS_HEIGHT]


# The two implementations


def _forward_shapes(geometry: Any, attenuation: Any, signal: Any, jobs: TileJobs) -> list[Any]:
    """Returns the shapes of the tiles' image and of the image and transmittance in front of every job. The implementation by
    tiles leaves the last two zero; outputs that are not read cost nothing."""
    b, tiling = attenuation.shape[1], jobs.tiling
    shapes = [(tiling.tiles, b, tiling.pixels), *[(jobs.tile.shape[0], b, tiling.lanes)] * 2]
    return [jax.ShapeDtypeStruct(shape, attenuation.dtype) for shape in shapes]


def _forward_by_tiles(geometry: Any, attenuation: Any, signal: Any, jobs: TileJobs) -> list[Any]:
    unused = _forward_shapes(geometry, attenuation, signal, jobs)[1:]
    return [blend_by_tiles(geometry, attenuation, signal, jobs), *(jnp.zeros(leaf.shape, leaf.dtype) for leaf in unused)]


def _has_kernels(attenuation: Any) -> bool:
    """Returns whether the Pallas kernels apply: single precision and a static number of queries. Exported files have a symbolic
    number of queries and use plain operations, since compiled kernels would not work with another version of JAX."""
    return attenuation.dtype == jnp.float32 and isinstance(attenuation.shape[1], int)


def _forward_by_jobs(geometry: Any, attenuation: Any, signal: Any, jobs: TileJobs) -> list[Any]:
    if not _has_kernels(attenuation):
        return _forward_by_tiles(geometry, attenuation, signal, jobs)
    from wbgs_jax.splat import fused_kernels  # imported here because a CPU does not need Pallas

    image, *front = fused_kernels.forward(geometry, attenuation, signal, jobs)
    return [image[..., : jobs.tiling.pixels], *front]


def _backward_shapes(geometry: Any, attenuation: Any, signal: Any, *_: Any) -> list[Any]:
    return [geometry, attenuation, signal]


def _backward_by_tiles(geometry: Any, attenuation: Any, signal: Any, jobs: TileJobs, blended: Any, cotangent: Any) -> list[Any]:
    return list(blend_by_tiles_backward(geometry, attenuation, signal, jobs, blended[0], cotangent))


def _backward_by_jobs(geometry: Any, attenuation: Any, signal: Any, jobs: TileJobs, blended: Any, cotangent: Any) -> list[Any]:
    if not _has_kernels(attenuation):
        return _backward_by_tiles(geometry, attenuation, signal, jobs, blended, cotangent)
    from wbgs_jax.splat import fused_kernels

    dead = jobs.tiling.lanes - jobs.tiling.pixels
    image, cotangent = (jnp.pad(tiles, ((0, 0), (0, 0), (0, dead))) for tiles in (blended[0], cotangent))
    return list(fused_kernels.backward(geometry, attenuation, signal, jobs, image, blended[1], blended[2], cotangent))


_forward = per_platform("splat_forward", _forward_shapes, _forward_by_tiles, cuda=_forward_by_jobs)
_backward = per_platform("splat_backward", _backward_shapes, _backward_by_tiles, cuda=_backward_by_jobs)


@jax.custom_vjp
def _blend_tiles(geometry, attenuation, signal, jobs: TileJobs) -> Float[Array, "tiles b pixels"]:
    return _forward(geometry, attenuation, signal, jobs)[0]


def _blend_tiles_fwd(*arrays_and_jobs):
    *arrays, jobs = arrays_and_jobs
    own = tuple(map(not_differentiable, arrays))
    blended = _forward(*own, jobs)
    return blended[0], (own, jobs, blended)


def _blend_tiles_bwd(residuals, cotangent):
    own, jobs, blended = residuals
    return *_backward(*map(not_differentiable, own), jobs, blended, cotangent), None


_blend_tiles.defvjp(_blend_tiles_fwd, _blend_tiles_bwd)


# By tiles


def _gather(geometry, attenuation, signal, gaussian: Int[Array, "jobs chunk"], tile: Int[Array, " jobs"], tiling: Tiling):
    """Returns, by slot and job, the geometry (u, v, conic) relative to the tile's centre, and every query's attenuation and
    signal."""
    gaussian = gaussian.T
    index = jnp.maximum(gaussian, 0)
    own = geometry[index]
    centre_x = (tile % tiling.columns) * tiling.width + (tiling.width - 1) / 2
    centre_y = (tile // tiling.columns) * tiling.height + (tiling.height - 1) / 2
    u, v = own[..., 0] - centre_x.astype(own.dtype), own[..., 1] - centre_y.astype(own.dtype)
    u = u - AZIMUTH_PERIOD * jnp.round(u / AZIMUTH_PERIOD)
    own = jnp.concatenate([jnp.stack([u, v], -1), own[..., 2:]], -1)
    return own, jnp.where(gaussian[..., None] >= 0, attenuation[index], 0), signal[index]


def _q(geometry: Float[Array, "*n 5"], tiling: Tiling) -> Float[Array, "*n pixels"]:
    x, y = (offsets.astype(geometry.dtype) for offsets in tiling.offsets())
    return mahalanobis2(geometry[..., 0:1] - x, geometry[..., 1:2] - y, geometry[..., None, 2:])


def _blend(slots, tiling: Tiling, image: Float[Array, "jobs b pixels"], transmittance: Float[Array, "jobs b pixels"]):
    """Returns image and transmittance behind one job of every tile, given those in front of it."""
    geometry, attenuation, signal = slots
    # The barrier keeps XLA from fusing the exponential into every query's chain and computing it B times.
    g = lax.optimization_barrier(footprint(_q(geometry, tiling)))
    for slot in range(CHUNK):
        weight = attenuation[slot][..., None] * g[slot][:, None] * transmittance
        image = image + signal[slot][..., None] * weight
        transmittance = transmittance - weight
    return image, transmittance


def _blend_bwd(slots, tiling: Tiling, cotangent, behind, transmittance):
    """Returns the backward pass of one job of every tile.

    `behind` is the contribution of these jobs and all later ones to the pixel, so dI/dalpha = Sig T - behind / (1 - alpha) with
    the Gaussian's own contribution taken out of `behind`. The result is `behind` and `transmittance` for the next job and, by
    slot, the gradients of geometry, attenuation and signal.
    """
    _, jobs, b = slots[1].shape
    monomials, one = tiling.monomials().astype(cotangent.dtype), jnp.ones((tiling.pixels, 1), cotangent.dtype)

    def pixel_sum(values):
        flat = values.reshape(jobs * b, tiling.pixels)
        return jnp.matmul(flat, one, precision=lax.Precision.HIGHEST).reshape(jobs, b)

    def step(carry, slot):
        behind, transmittance = carry
        geometry, attenuation, signal = slot
        q = _q(geometry, tiling)
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
    """Returns the gradients of (u, v, conic xx, xy, yy) from the moments of -2 dL/dq about the tile's centre."""
    u, v, a, b, c = jnp.moveaxis(geometry, -1, 0)
    m0, mx, my, mxx, mxy, myy = jnp.moveaxis(moments, -1, 0)
    dx, dy = mx - u * m0, my - v * m0
    dxx, dyy = mxx - 2 * u * mx + u * u * m0, myy - 2 * v * my + v * v * m0
    dxy = mxy - u * my - v * mx + u * v * m0
    return jnp.stack([a * dx + b * dy, c * dy + b * dx, -0.5 * dxx, -dxy, -0.5 * dyy], -1)


def _no_gradient(attenuation: Float[Array, "n b"]) -> Float[Array, "n_1 f"]:
    """Returns zero gradients of every Gaussian's geometry, attenuation and signal, with one extra row."""
    n, b = attenuation.shape
    return jnp.zeros((n + 1, 5 + 2 * b), attenuation.dtype)


def _sum_by_gaussian(total: Float[Array, "n_1 f"], gaussian: Int[Array, "jobs chunk"], per_slot: Float[Array, "chunk jobs f"]):
    """Returns the total with the gradients of slots added to those of their Gaussians; empty slots go to the extra row."""
    owner = jnp.where(gaussian >= 0, gaussian, total.shape[0] - 1).T
    return total.at[owner.reshape(-1)].add(per_slot.reshape(-1, total.shape[1]))


def _tile_groups(jobs: TileJobs) -> Int[Array, "groups tiles"]:
    """Returns groups of tiles with lists of similar length."""
    tiles = jobs.tiling.tiles
    size = max(size for size in range(1, TILE_GROUP + 1) if tiles % size == 0)
    return jnp.argsort(-jobs.count).reshape(-1, size)


def _next_jobs(jobs: TileJobs, tiles: Int[Array, " tiles"], level: Int[Array, ""]) -> Int[Array, "tiles chunk"]:
    """Returns the Gaussians of the tiles' jobs at one level; -1 where a tile has no such job."""
    live = level < jobs.count[tiles]
    gaussian = jobs.gaussian[jnp.where(live, jobs.first[tiles] + level, 0)]
    return jnp.where(live[:, None], gaussian, -1)


def blend_by_tiles(
    geometry: Float[Array, "n 5"], attenuation: Float[Array, "n b"], signal: Float[Array, "n b"], jobs: TileJobs
) -> Float[Array, "tiles b pixels"]:
    """Returns the image of every tile. `geometry` holds the centre (pixels) and the conic of each Gaussian."""
    groups, tiling = _tile_groups(jobs), jobs.tiling

    def blend_group(tiles):
        def blend_level(level, state):
            slots = _gather(geometry, attenuation, signal, _next_jobs(jobs, tiles, level), tiles, tiling)
            return _blend(slots, tiling, *state)

        blank = jnp.zeros((tiles.shape[0], attenuation.shape[1], tiling.pixels), attenuation.dtype)
        return lax.fori_loop(0, jnp.max(jobs.count[tiles]), blend_level, (blank, blank + 1))[0]

    image = lax.map(blend_group, groups)
    return image.reshape(tiling.tiles, *image.shape[2:])[jnp.argsort(groups.reshape(-1))]


def blend_by_tiles_backward(
    geometry: Float[Array, "n 5"],
    attenuation: Float[Array, "n b"],
    signal: Float[Array, "n b"],
    jobs: TileJobs,
    image: Float[Array, "tiles b pixels"],
    cotangent: Float[Array, "tiles b pixels"],
) -> tuple[Float[Array, "n 5"], Float[Array, "n b"], Float[Array, "n b"]]:
    """Returns the gradients of geometry, attenuation and signal, given the image and its gradient."""

    def group_bwd(total, tiles):
        own = cotangent[tiles]

        def level_bwd(level, state):
            behind, transmittance, total = state
            gaussian = _next_jobs(jobs, tiles, level)
            slots = _gather(geometry, attenuation, signal, gaussian, tiles, jobs.tiling)
            behind, transmittance, per_slot = _blend_bwd(slots, jobs.tiling, own, behind, transmittance)
            return behind, transmittance, _sum_by_gaussian(total, gaussian, per_slot)

        state = image[tiles], jnp.ones_like(own), total
        return lax.fori_loop(0, jnp.max(jobs.count[tiles]), level_bwd, state)[2], None

    total, b = lax.scan(group_bwd, _no_gradient(attenuation), _tile_groups(jobs))[0], attenuation.shape[1]
    return total[:-1, :5], total[:-1, 5 : 5 + b], total[:-1, 5 + b :]


@pytree
class GeometryPlan:
    """The projected Gaussians of a fixed receiver and their tile lists, independent of transmitter and frequency."""

    splats: Splats
    jobs: TileJobs


def geometry_plan(
    gaussians: Gaussians,
    receiver: Receiver,
    limits: TileLimits | None = None,
    projection: Projection = "hemisphere",
    means2d_offset: Float[Array, "n 2"] | None = None,
) -> GeometryPlan:
    """Returns the projected and sorted Gaussians.

    Gradients reach the Gaussians through a plan only if it is built inside the differentiated function; depth order and tile
    lists carry none.

    Args:
        gaussians: world frame, metres.
        receiver: fixed receiver.
        limits: capacities of the tile lists. Without them the lists are sized on the host (not under jit). With them the call
            is pure and jittable, and the caller must check `plan.jobs.overflow`.
        projection: mapping from angles to pixels.
        means2d_offset: pixels, added to the centres (`project`).

    Returns:
        The plan, for `render_splats` with any attenuation and signal.

    Raises:
        ValueError: there are no Gaussians, or limits are missing under jit.
    """
    splats = project(gaussians, receiver, projection, means2d_offset)
    if limits is None:
        limits = measure_limits(splats)
    return GeometryPlan(splats, build_tile_jobs(splats, limits))


def measure_limits(splats: Splats, slack: float = 1.25, tiling: Tiling | None = None) -> TileLimits:
    """Returns the limits that splats need, found on the host by building the lists until they fit.

    Args:
        splats: projected Gaussians.
        slack: factor on the required counts.
        tiling: tile size; by default the fastest one on the default device.

    Returns:
        The limits, for `geometry_plan`.

    Raises:
        ValueError: called under jit.
    """
    if isinstance(splats.depths, jax.core.Tracer):
        raise ValueError(
            "tile lists cannot be sized under jit: pass capacity (of geometry_plan: limits), computed outside of jit"
        )
    limits = fit_limits(0, 0, tiling=tiling)
    while True:
        jobs = build_tile_jobs(splats, limits)
        fitted = fit_limits(int(jobs.required_entries), int(jobs.required_jobs), slack, limits.tiling)
        if not jobs.overflow:
            return fitted
        limits = limits.grown_to(fitted)


def render_splats(
    plan: GeometryPlan, attenuation: Float[Array, "n b"], signal: Float[Array, "n b"]
) -> Float[Array, "b 90 360"]:
    """Returns the plan's Gaussians blended for B queries.

    Args:
        plan: of one receiver. If its tile lists overflowed, the image is NaN, never wrong.
        attenuation: delta of every Gaussian and query, in [0, 1).
        signal: Sig of every Gaussian and query.

    Returns:
        Images (b, 90, 360), in the unit of the signal.
    """
    check_array("attenuation", attenuation, (plan.splats.depths.shape[0], "b"))
    check_array("signal", signal, attenuation.shape)
    image = composite(plan.splats.means2d, plan.splats.conics, attenuation, signal, plan.jobs)
    return jnp.where(plan.jobs.overflow, jnp.nan, image)


def render_dense(
    splats: Splats, attenuation: Float[AnyArray, "n b"], signal: Float[AnyArray, "n b"]
) -> Float[Array, "b 90 360"]:
    """Returns N splats blended for B queries; attenuation (delta, in [0, 1)) and signal (Sig) are per Gaussian and query.

    The reference: equation 6 of the paper, Gaussian by Gaussian over all pixels. Slow, short, differentiable.

        I(p) = sum_i  T_i(p) alpha_i(p) Sig_i,     T_i(p) = prod_{j<i} (1 - alpha_j(p)),     alpha_i(p) = delta_i G_i(p)

    over the Gaussians from near to far. delta in [0, 1) is the attenuation that a Gaussian inflicts on everything behind it
    (the paper's delta is the surviving factor, 1 - alpha here), and G is its footprint. As in the authors' code and in 3D
    Gaussian splatting, a Gaussian radiates with the same weight with which it occludes.

    Args:
        splats: from `project`.
        attenuation: delta of every Gaussian and query, in [0, 1).
        signal: Sig of every Gaussian and query.

    Returns:
        Images (b, 90, 360), in the unit of the signal.
    """
    check_array("attenuation", attenuation, (splats.depths.shape[0], "b"))
    check_array("signal", signal, attenuation.shape)
    attenuation, signal = jnp.asarray(attenuation), jnp.asarray(signal)
    order = jnp.argsort(jax.lax.stop_gradient(splats.depths))
    x = jnp.arange(PAS_WIDTH, dtype=attenuation.dtype)[None, :]
    y = jnp.arange(PAS_HEIGHT, dtype=attenuation.dtype)[:, None]

    def blend(carry, i):
        image, transmittance = carry
        dx, dy = wrap_azimuth(x - splats.means2d[i, 0]), y - splats.means2d[i, 1]
        g = footprint(mahalanobis2(dx, dy, splats.conics[i]))
        alive = jnp.isfinite(splats.depths[i])
        alpha = jnp.where(alive, attenuation[i][:, None, None] * g, 0)
        image = image + transmittance * alpha * signal[i][:, None, None]
        return (image, transmittance * (1 - alpha)), None

    blank = jnp.zeros((attenuation.shape[1], PAS_HEIGHT, PAS_WIDTH), attenuation.dtype)
    (image, _), _ = jax.lax.scan(blend, (blank, blank + 1), order)
    return image
