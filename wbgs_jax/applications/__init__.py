"""Applications of a trained field: localisation of transmitters, choice of beams, placement of antennas and reflectors."""

from wbgs_jax._util.public_names import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
