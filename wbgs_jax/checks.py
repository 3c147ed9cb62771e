"""Checks at the public door: wrong shapes, dtypes and units raise an error that says what was expected.

Shapes and dtypes are checked also under jit, vmap and grad (they are static there); values only where they are concrete.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from wbgs_jax.types import Query, Receiver, Surface

LOWEST_FREQUENCY_HZ = 1e6
"""Smaller numbers are gigahertz or megahertz by mistake."""
LARGEST_COORDINATE_M = 1e5
"""Larger numbers are millimetres by mistake, or no indoor scene."""


def check_array(name: str, value: Any, shape: tuple[Any, ...]) -> None:
    """Raise unless `value` is a real floating-point array of a shape; strings in `shape` name free axes."""
    if not hasattr(value, "shape") or not hasattr(value, "dtype"):
        raise TypeError(f"{name} is a {type(value).__name__}; give an array of shape {_text(shape)}")
    if not jnp.issubdtype(value.dtype, jnp.floating):
        raise TypeError(f"{name} has dtype {value.dtype}; give a real floating-point array, such as float32")
    fits = len(value.shape) == len(shape) and all(isinstance(s, str) or s == n for s, n in zip(shape, value.shape, strict=True))
    if not fits:
        raise ValueError(f"{name} has shape {tuple(value.shape)}; expected {_text(shape)}")


def check_query(query: Query) -> None:
    """A batch of queries: positions (b, 3) in metres, frequencies (b,) in hertz."""
    check_array("tx_position", query.tx_position, ("b", 3))
    check_array("frequency_hz", query.frequency_hz, (query.tx_position.shape[0],))
    frequency, position = concrete(query.frequency_hz), concrete(query.tx_position)
    if frequency is not None and frequency.size and not frequency.min() >= LOWEST_FREQUENCY_HZ:
        raise ValueError(f"frequency_hz holds {frequency.min():g}; frequencies are in hertz (2.4e9 for 2.4 GHz) and positive")
    if position is not None and position.size and not np.abs(position).max() <= LARGEST_COORDINATE_M:
        raise ValueError(f"tx_position holds {np.abs(position).max():g}; positions are in metres and finite")


def check_receiver(receiver: Receiver) -> None:
    """Position (3,), orientation quaternion (4,) wxyz of non-zero length, element positions (elements, 3) in wavelengths."""
    check_array("receiver.position", receiver.position, (3,))
    check_array("receiver.orientation", receiver.orientation, (4,))
    check_array("receiver.element_positions", receiver.element_positions, ("elements", 3))
    orientation = concrete(receiver.orientation)
    if orientation is not None and not np.linalg.norm(orientation) > 1e-6:
        raise ValueError("receiver.orientation has zero length; give a quaternion (w, x, y, z), (1, 0, 0, 0) for no rotation")


def check_surface(surface: Surface) -> None:
    """Points (n, 3) and their spacing (n,), metres."""
    check_array("surface.points", surface.points, ("n", 3))
    check_array("surface.spacing", surface.spacing, (surface.points.shape[0],))


def concrete(value: Any) -> np.ndarray | None:
    """The value of an array, or None while it is traced."""
    return None if isinstance(value, jax.core.Tracer | jax.ShapeDtypeStruct) else np.asarray(value)


def _text(shape: tuple[Any, ...]) -> str:
    return "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"
