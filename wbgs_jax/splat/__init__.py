"""Splatting onto the receiver's hemisphere: projection.py -> tiles.py -> composite.py, composed by render.py.

`reference.py` is a dense, readable reference implementation of the same image.
"""

from wbgs_jax.splat.projection import Splats, project
from wbgs_jax.splat.reference import render_dense
from wbgs_jax.splat.render import GeometryPlan, geometry_plan, measure_limits, render_splats
from wbgs_jax.splat.tiles import TileLimits, fit_limits, grown_slots, slots_for

__all__ = [
    "GeometryPlan",
    "Splats",
    "TileLimits",
    "fit_limits",
    "geometry_plan",
    "grown_slots",
    "measure_limits",
    "project",
    "render_dense",
    "render_splats",
    "slots_for",
]
