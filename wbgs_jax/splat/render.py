"""Gaussians -> PAS: composes projection.py, tiles.py and composite.py.

The receiver is fixed, so everything geometric (projection, depth order, tile lists) is computed once as a `GeometryPlan` and
shared by any number of queries, which differ only in attenuation and signal.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from wbgs_jax._util.checks import check_array
from wbgs_jax._util.pytree import AnyArray, pytree
from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.radio.geometry import Projection
from wbgs_jax.splat.composite import composite
from wbgs_jax.splat.projection import Splats, footprint, mahalanobis2, project, wrap_azimuth
from wbgs_jax.splat.tiles import TileJobs, TileLimits, Tiling, build_tile_jobs, fit_limits
from wbgs_jax.types import Gaussians, Receiver


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
