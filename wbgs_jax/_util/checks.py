"""Checks at the public door: wrong shapes, dtypes and units raise an error that says what was expected.

Shapes and dtypes are checked also under jit, vmap and grad (they are static there); values only where they are concrete.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def check_array(name: str, value: Any, shape: tuple[Any, ...]) -> None:
    """Raises unless `value` is a real floating-point array of a shape; strings in `shape` name free axes."""
    if not hasattr(value, "shape") or not hasattr(value, "dtype"):
        raise TypeError(f"{name} is a {type(value).__name__}; give an array of shape {_text(shape)}")
    if not jnp.issubdtype(value.dtype, jnp.floating):
        raise TypeError(f"{name} has dtype {value.dtype}; give a real floating-point array, such as float32")
    fits = len(value.shape) == len(shape) and all(isinstance(s, str) or s == n for s, n in zip(shape, value.shape, strict=True))
    if not fits:
        raise ValueError(f"{name} has shape {tuple(value.shape)}; expected {_text(shape)}")


def concrete(value: Any) -> np.ndarray | None:
    """Returns the value of an array, or None while it is traced."""
    return None if isinstance(value, jax.core.Tracer | jax.ShapeDtypeStruct) else np.asarray(value)


def _text(shape: tuple[Any, ...]) -> str:
    return "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"
