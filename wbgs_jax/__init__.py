"""Wideband RF radiance fields with frequency-embedded 3D Gaussian splatting, in JAX.

Pure functions on pytrees, for use under `jax.jit`, `jax.vmap` and `jax.grad`. SI units: metres, hertz, radians; element
positions in wavelengths.

* the field of the paper: `wideband.init`, `wideband.plan`, `wideband.render`, `wideband.em_features`
* the coherent field: `wave.init`, `wave.plan`, `wave.render`, `wave.snapshots`, `wave.channels` (docs/wave.md)
* splatting onto a receiver's hemisphere: `project`, `geometry_plan`, `render_splats`, `render_dense`
* the antenna array: `planar_array`, `steering_vector`, `cbf`, `snapshot_to_pas`, `pas_directions`
* data on the host: `load_dataset`, `load_scene`, `make_surface`, `surface_from_points`
* a trained field: `load_trained`, `predictor`, `predict_many`, `predict_blocks`, `predict_map`, `map_queries`,
  `export_field`, `load_exported` (docs/inference.md)
"""

import os
import sys

if any(argument.startswith("wbgs_jax.") for argument in sys.orig_argv):
    # For our command lines, before JAX is loaded: XLA logs errors about tuning flags of cached programs, of no consequence.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

from wbgs_jax.array import cbf, pas_directions, planar_array, snapshot_to_pas, steering_vector
from wbgs_jax.config import WaveConfig, WidebandConfig
from wbgs_jax.encoding import frequency_encoding, positional_encoding
from wbgs_jax.fields import wave, wideband
from wbgs_jax.losses import image_loss, ssim
from wbgs_jax.splat import Capacity, geometry_plan, measure_capacity, project, render_dense, render_splats
from wbgs_jax.types import Gaussians, Mesh, Query, Receiver, Surface, make_query, make_receiver
from wbgs_jax.version import __version__

__all__ = [
    "Capacity",
    "Gaussians",
    "Mesh",
    "Query",
    "Receiver",
    "Surface",
    "WaveConfig",
    "WidebandConfig",
    "__version__",
    "cbf",
    "export_field",
    "frequency_encoding",
    "geometry_plan",
    "image_loss",
    "load_dataset",
    "load_exported",
    "load_scene",
    "load_trained",
    "make_mesh",
    "make_query",
    "make_receiver",
    "make_surface",
    "map_queries",
    "measure_capacity",
    "pas_directions",
    "planar_array",
    "positional_encoding",
    "predict_blocks",
    "predict_many",
    "predict_map",
    "predictor",
    "project",
    "render_dense",
    "render_splats",
    "snapshot_to_pas",
    "ssim",
    "steering_vector",
    "surface_from_points",
    "wave",
    "wideband",
]

_HOST = {
    "export_field": "wbgs_jax.export",
    "load_dataset": "wbgs_jax.data",
    "load_exported": "wbgs_jax.export",
    "load_scene": "wbgs_jax.data",
    "load_trained": "wbgs_jax.runs",
    "make_mesh": "wbgs_jax.data.surface",
    "make_surface": "wbgs_jax.data.surface",
    "map_queries": "wbgs_jax.inference",
    "predict_blocks": "wbgs_jax.inference",
    "predict_many": "wbgs_jax.inference",
    "predict_map": "wbgs_jax.inference",
    "predictor": "wbgs_jax.inference",
    "surface_from_points": "wbgs_jax.data.surface",
}


def __getattr__(name: str):
    """Import the host's part (files, meshes) only when it is asked for: the pure part stands alone."""
    if name in _HOST:
        import importlib

        return getattr(importlib.import_module(_HOST[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
