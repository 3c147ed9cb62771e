"""Checks of arguments of the public interface: wrong shapes, dtypes and units raise an error that states what was expected.

Shapes and dtypes are also checked under jit, vmap and grad, where they are static; values only where they are concrete.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def check_array(name: str, value: Any, shape: tuple[Any, ...]) -> None:
    """Raises an error unless `value` is a real floating-point array of the given shape; strings in `shape` are free axes.

    Raises:
        TypeError: not an array, or of another dtype.
        ValueError: of another shape.
    """
    if not hasattr(value, "shape") or not hasattr(value, "dtype"):
        raise TypeError(f"{name} is a {type(value).__name__}; pass an array of shape {_text(shape)}")
    if not jnp.issubdtype(value.dtype, jnp.floating):
        raise TypeError(f"{name} has dtype {value.dtype}; pass a real floating-point array, such as float32")
    fits = len(value.shape) == len(shape) and all(isinstance(s, str) or s == n for s, n in zip(shape, value.shape, strict=True))
    if not fits:
        raise ValueError(f"{name} has shape {tuple(value.shape)}; expected {_text(shape)}")


def concrete(value: Any) -> np.ndarray | None:
    """Returns the value of an array, or None while it is traced."""
    return None if isinstance(value, jax.core.Tracer | jax.ShapeDtypeStruct) else np.asarray(value)


def _text(shape: tuple[Any, ...]) -> str:
    return "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"
