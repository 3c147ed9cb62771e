"""Wideband RF radiance fields with frequency-embedded 3D Gaussian splatting, in JAX.

Pure functions on pytrees, for use under `jax.jit`, `jax.vmap` and `jax.grad`. SI units: metres, hertz, radians. Names are
loaded on first use: importing this package changes nothing in the process, and the pure part does not need
the host's modules. `__init__.pyi` lists them with their types; docs/api.md describes them.

* fields: `hybrid` (the default, a combination of the next two), `wideband` (the paper's), `wave` (coherent), `wrfgs` and
  `nerf2` (baselines); `pas` is the differentiable function from parameters, receiver and query to spectra, `Field` the
  interface of a model
* splatting onto a receiver's hemisphere: `project`, `geometry_plan`, `render_splats`, `render_dense`
* the antenna array: `planar_array`, `steering_vector`, `cbf`, `snapshot_to_pas`, `pas_directions`
* data on the host: `load_dataset`, `load_scene`, `load_room`, `make_surface`, `make_mesh`, `surface_from_points`
* a trained field: `load_trained`, `at_receiver`, `predictor`, `power_predictor`, `predict_many`, `predict_blocks`,
  `predict_map`, `map_queries`, `expected_ssim`, `expected_power`, `export_field`, `load_exported` (docs/inference.md)
"""

import lazy_loader

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
