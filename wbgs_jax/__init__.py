"""Wideband RF radiance fields with frequency-embedded 3D Gaussian splatting, in JAX.

Pure functions on pytrees: `init_field`, `plan_field`, `render_field` for the paper's model, the splatting beneath it, and the
antenna array above it. They work under `jax.jit`, `jax.vmap` and `jax.grad`. SI units: metres, hertz, radians.
"""

from wbgs_jax.version import __version__

__all__ = ["__version__"]
