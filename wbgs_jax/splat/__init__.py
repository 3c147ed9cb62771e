"""Splatting onto the receiver's hemisphere: projection.py -> tiles.py -> composite.py.

`composite.render_dense` is a dense, readable reference implementation of the same image.
"""

from wbgs_jax._util.public_names import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
