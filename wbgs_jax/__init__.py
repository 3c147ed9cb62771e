"""Wideband RF radiance fields with frequency-embedded 3D Gaussian splatting, in JAX.

Pure functions on pytrees, for use under `jax.jit`, `jax.vmap` and `jax.grad`. SI units: metres, hertz, radians. Names are
loaded on first use: importing this package changes nothing in the process, and the pure part does not need the host's modules.
`__init__.pyi` lists the names, here and in every group; docs/api.md describes them.

* data: `load_dataset`, `load_scene`, `load_room`, `make_mesh`, `make_surface`
* training: `train_field`, `evaluate`; models: `Field`, `get_field`, `register`
* a trained field: `load_trained`, `make_predictor`, `make_power_predictor`, `predict_paths`, `predict_map`, `export_field`
* what functions take and return: `Receiver`, `Query`, `Links`, `Paths`, `Mesh`, `Surface`
* groups: `radio` (antenna arrays and channels), `splat` (rendering of Gaussians), `wideband` and `coherent` (the two models),
  `applications` (localisation, beams, placement), `interchange` (files of other programs), `power_map` (measured powers),
  `fields` (all models, and what a new one needs)
"""

from wbgs_jax._util.public_names import attach

__version__ = "0.2.0"

_RENAMED = {
    **{name: f"radio.{name}" for name in ("cbf", "pas_directions", "planar_array", "snapshot_to_pas", "steering_vector")},
    **{
        name: f"splat.{name}"
        for name in (
            "Gaussians",
            "TileLimits",
            "geometry_plan",
            "measure_limits",
            "project",
            "render_dense",
            "render_splats",
        )
    },
    **{
        name: f"applications.{name}"
        for name in (
            "Located",
            "Locator",
            "Reflector",
            "boresight_quaternion",
            "choose_beams",
            "mean_power",
            "place_antenna",
            "place_reflector",
            "power_at_users",
            "rank_beams",
            "score_beams",
            "soft_minimum",
            "straight_powers",
            "tenth_percentile",
        )
    },
    **{
        name: f"interchange.{name}"
        for name in (
            "RayPaths",
            "as_deepmimo",
            "from_deepmimo",
            "from_sionna",
            "load_deepmimo",
            "load_paths",
            "read_deepmimo",
            "read_gaussians",
            "save_paths",
            "scene_of_paths",
            "scene_of_sionna",
            "scene_of_snapshots",
            "write_deepmimo",
            "write_gaussians",
        )
    },
    **{name: f"power_map.{name}" for name in ("cell_means", "learn_map", "load_readings", "load_walls", "received_power")},
    **{
        name: f"fields.{name}"
        for name in ("frequency_encoding", "hybrid", "image_loss", "nerf2", "positional_encoding", "wrfgs")
    },
    "WaveConfig": "coherent.WaveConfig",
    "WidebandConfig": "wideband.WidebandConfig",
    "arrivals_anywhere": "applications.predict_isotropic_paths",
    "arrivals_of": "predict_paths",
    "from_arrivals": "interchange.from_paths",
    "locator": "applications.make_locator",
    "power_predictor": "make_power_predictor",
    "power_when_turned": "applications.power_when_rotated",
    "predictor": "make_predictor",
    "reflector": "applications.make_reflector",
    "turn_array": "applications.rotate_array",
    "wave": "coherent",
}
"""Earlier names with those that replace them; they work, and warn, for one release."""

__getattr__, __dir__, __all__ = attach(__name__, __file__, _RENAMED)
