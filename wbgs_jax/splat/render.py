"""Gaussians -> PAS: composes projection.py, tiles.py and composite.py.

The receiver is fixed, so everything geometric (projection, depth order, tile lists) is built once as a `GeometryPlan` and
shared by any number of queries, which differ only in attenuation and signal.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from wbgs_jax._util.checks import check_array
from wbgs_jax._util.pytree import pytree
from wbgs_jax.radio.geometry import Projection
from wbgs_jax.splat.composite import composite
from wbgs_jax.splat.projection import Splats, project
from wbgs_jax.splat.tiles import TileJobs, TileLimits, Tiling, build_tile_jobs, fit_limits
from wbgs_jax.types import Gaussians, Receiver


@pytree
class GeometryPlan:
    """What a fixed receiver sees of the Gaussians, independent of transmitter and frequency."""

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

    Gradients reach the Gaussians through a plan only where it is made inside the differentiated function; order and tile lists
    carry none. Without `limits` the tile lists are sized on the host (not under jit). With them the call is pure and jittable,
    and the caller must look at `plan.jobs.overflow`.
    """
    splats = project(gaussians, receiver, projection, means2d_offset)
    if limits is None:
        limits = measure_limits(splats)
    return GeometryPlan(splats, build_tile_jobs(splats, limits))


def measure_limits(splats: Splats, slack: float = 1.25, tiling: Tiling | None = None) -> TileLimits:
    """Returns the limits that splats need, found on the host by building the lists until they fit; in the tiles that are
    fastest on the device which computes here, or in others."""
    if isinstance(splats.depths, jax.core.Tracer):
        raise ValueError("the tile lists cannot be sized under jit: pass limits=..., found outside with measure_limits")
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
    """Returns the plan's Gaussians blended for B queries: attenuation (delta, [0, 1)) and signal (Sig) per Gaussian and query.

    An overflowed plan renders NaN, never a wrong image.
    """
    check_array("attenuation", attenuation, (plan.splats.depths.shape[0], "b"))
    check_array("signal", signal, attenuation.shape)
    image = composite(plan.splats.means2d, plan.splats.conics, attenuation, signal, plan.jobs)
    return jnp.where(plan.jobs.overflow, jnp.nan, image)
