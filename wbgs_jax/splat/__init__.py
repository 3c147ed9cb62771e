"""Splatting onto the receiver's hemisphere: project.py -> tiles.py -> composite.py, composed by render.py.

`reference.py` is the dense, readable oracle of the same image.
"""

from wbgs_jax.splat.project import Splats, project
from wbgs_jax.splat.reference import render_dense
from wbgs_jax.splat.render import GeometryPlan, geometry_plan, measure_capacity, render_splats
from wbgs_jax.splat.tiles import Capacity, fit_capacity

__all__ = [
    "Capacity",
    "GeometryPlan",
    "Splats",
    "fit_capacity",
    "geometry_plan",
    "measure_capacity",
    "project",
    "render_dense",
    "render_splats",
]
