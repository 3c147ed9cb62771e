"""Storage of a pytree of arrays as one file of a run folder: a compressed .npz, written atomically."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from wbgs_jax._util.files import atomic_write, read_arrays, told

T = TypeVar("T")
SMALL = (np.uint8, np.float16)
"""Types that are kept as stored: images."""


def write_tree(path: Path, tree: Any) -> None:
    """Writes the arrays of a pytree under the names of its fields; None removes the file."""
    if tree is None:
        path.unlink(missing_ok=True)
        return
    arrays: dict[str, Any] = {f.name: np.asarray(getattr(tree, f.name)) for f in dataclasses.fields(tree)}
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **arrays)


def read_tree(path: Path, classes: Sequence[type[T]], without: str, before: Mapping[str, Any] | None = None) -> T | None:
    """Returns the pytree stored in a file, in single precision or in the smaller type it was written in; None if there is no
    file.

    Args:
        path: of the file.
        classes: possible classes; the first one with the file's fields is used.
        without: what removing the file means, for the message.
        before: values of arrays that older files lack.

    Raises:
        UserError: the file is damaged.
    """
    if not path.exists():
        return None
    advice = f"remove it to {without}, or train again"
    arrays = {name: np.asarray(value) for name, value in (before or {}).items()} | read_arrays(path, "", advice)
    fits = (cls for cls in classes if {f.name for f in dataclasses.fields(cls)} == arrays.keys())  # type: ignore[arg-type]
    with told(str(path), advice):
        return next(fits, classes[-1])(**{name: _in_memory(value) for name, value in arrays.items()})


def _in_memory(value: np.ndarray) -> jax.Array:
    return jnp.asarray(value, value.dtype if value.dtype in SMALL else jnp.float32)
