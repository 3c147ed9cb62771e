"""Import and export of other programs' files and objects: splat viewers, Sionna RT, DeepMIMO (docs/interchange.md)."""

from wbgs_jax._util.public_names import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
