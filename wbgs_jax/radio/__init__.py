"""Antenna arrays, element patterns, frames, and what engineers read from a channel."""

from wbgs_jax._util.public_names import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
