"""Wideband RF radiance fields with frequency-embedded 3D Gaussian splatting, in JAX.

Pure functions on pytrees, for use under `jax.jit`, `jax.vmap` and `jax.grad`. SI units: metres, hertz, radians; element
positions in wavelengths.

* the field of the paper: `wideband.init`, `wideband.plan`, `wideband.render`, `wideband.em_features`
* splatting onto a receiver's hemisphere: `project`, `geometry_plan`, `render_splats`, `render_dense`
* the antenna array: `planar_array`, `steering_vector`, `cbf`, `snapshot_to_pas`, `pas_directions`
* data on the host: `load_dataset`, `load_scene`, `make_surface`, `surface_from_points`
"""

from wbgs_jax.array import cbf, pas_directions, planar_array, snapshot_to_pas, steering_vector
from wbgs_jax.config import WidebandConfig
from wbgs_jax.encoding import frequency_encoding, positional_encoding
from wbgs_jax.fields import wideband
from wbgs_jax.losses import image_loss, ssim
from wbgs_jax.splat import Capacity, geometry_plan, measure_capacity, project, render_dense, render_splats
from wbgs_jax.types import Gaussians, Query, Receiver, Surface, make_query, make_receiver
from wbgs_jax.version import __version__

__all__ = [
    "Capacity",
    "Gaussians",
    "Query",
    "Receiver",
    "Surface",
    "WidebandConfig",
    "__version__",
    "cbf",
    "frequency_encoding",
    "geometry_plan",
    "image_loss",
    "load_dataset",
    "load_scene",
    "make_query",
    "make_receiver",
    "make_surface",
    "measure_capacity",
    "pas_directions",
    "planar_array",
    "positional_encoding",
    "project",
    "render_dense",
    "render_splats",
    "snapshot_to_pas",
    "ssim",
    "steering_vector",
    "surface_from_points",
    "wideband",
]

_HOST = {
    "load_dataset": "wbgs_jax.data",
    "load_scene": "wbgs_jax.data",
    "make_surface": "wbgs_jax.data.surface",
    "surface_from_points": "wbgs_jax.data.surface",
}


def __getattr__(name: str):
    """Import the host's part (files, meshes) only when it is asked for: the pure part stands alone."""
    if name in _HOST:
        import importlib

        return getattr(importlib.import_module(_HOST[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
