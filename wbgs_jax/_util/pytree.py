"""Frozen dataclasses as pytrees, and functions of trees that are evaluated in blocks of rows."""

import dataclasses
import typing
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

T = TypeVar("T")
AnyArray = jax.Array | np.ndarray
"""Geometry is computed in NumPy in double precision and used in JAX."""


def static(**options: Any) -> Any:
    """Returns a field that is part of the tree's structure, not a leaf; its value must be hashable.

    Args:
        options: those of `dataclasses.field`, such as `default=`.

    Returns:
        The field, for the body of a class decorated with `pytree`.
    """
    return dataclasses.field(metadata={"static": True}, **options)


@dataclass_transform(frozen_default=True, field_specifiers=(static, dataclasses.field))
def pytree(cls: type[T]) -> type[T]:
    """Makes a class a frozen dataclass and a pytree.

    Unlike `jax.tree_util.register_dataclass`, rebuilding a tree does not call `__init__`: transformations put shapes, masks
    and markers into fields annotated as arrays, which run-time type checks must not reject.

    Args:
        cls: with annotated fields; arrays are leaves, fields made by `static` are not.

    Returns:
        The class, a frozen dataclass that JAX transforms.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> @pytree
        ... class Point:
        ...     x: jax.Array
        ...     unit: str = static(default="m")
        >>> jax.tree.map(lambda leaf: 2 * leaf, Point(jnp.array(1.0)))
        Point(x=Array(2., dtype=float32, weak_type=True), unit='m')
    """
    cls = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    children = [f.name for f in fields if not f.metadata.get("static")]
    constants = [f.name for f in fields if f.metadata.get("static")]

    def flatten_with_keys(value: Any) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
        leaves = [(jax.tree_util.GetAttrKey(name), getattr(value, name)) for name in children]
        return leaves, tuple(getattr(value, name) for name in constants)

    def flatten(value: Any) -> tuple[list[Any], tuple[Any, ...]]:
        return [getattr(value, name) for name in children], tuple(getattr(value, name) for name in constants)

    def unflatten(aux: tuple[Any, ...], leaves: Any) -> T:
        value = object.__new__(cls)
        for name, item in zip(children + constants, (*leaves, *aux), strict=True):
            object.__setattr__(value, name, item)
        return value

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def from_leaves(cls: type[T], leaves: Mapping[str, Any], constants: Mapping[str, Any] | None = None, prefix: str = "") -> T:
    """Returns a `pytree` built from its leaves by `jax.tree_util.keystr`, such as {".frame.centre": array}.

    Fields are arrays, other `pytree` classes, or None. Static fields come from `constants`, or else from their defaults. Fields
    without a leaf are None.
    """
    hints, values = typing.get_type_hints(cls), {}
    for f in dataclasses.fields(cls):  # type: ignore[arg-type]
        path = f"{prefix}.{f.name}"
        if f.metadata.get("static"):
            values[f.name] = (constants or {}).get(f.name, f.default)
        elif (inner := _class_in(hints[f.name])) and any(key.startswith(f"{path}.") for key in leaves):
            values[f.name] = from_leaves(inner, leaves, None, path)
        else:
            values[f.name] = leaves.get(path)
    return cls(**values)


def _class_in(hint: Any) -> Any:
    """Returns the `pytree` class in a type hint, as in `Grid | None`; None if there is none."""
    return next((one for one in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(one)), None)


def with_leaves(tree: T, *leaves: Any) -> T:
    """Returns a tree of the same structure with other leaves, of any kind, in order."""
    return jax.tree.unflatten(jax.tree.structure(tree), leaves)


def replaced(tree: T, **values: Any) -> T:
    """Returns a `pytree` with some fields replaced, like `dataclasses.replace`, but by values of any kind (names, markers)."""
    new = object.__new__(type(tree))
    for f in dataclasses.fields(tree):  # type: ignore[arg-type]
        object.__setattr__(new, f.name, values.get(f.name, getattr(tree, f.name)))
    return new


def same(a: Any, b: Any) -> bool:
    """Returns whether two trees have the same structure, and leaves of the same shapes and values."""
    if jax.tree.structure(a) != jax.tree.structure(b):  # type: ignore[operator]
        return False
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.shape(x) == np.shape(y) and np.array_equal(x, y) for x, y in leaves)


def to_device(tree: Any) -> Any:
    """Returns a tree of host arrays on the device: floating-point numbers as float32, integers and booleans as int32.

    Conversion happens on the host, where it does not require compilation.
    """

    def leaf(a: Any) -> jax.Array:
        return jnp.asarray(np.asarray(a, np.float32 if np.issubdtype(np.asarray(a).dtype, np.floating) else np.int32))

    return jax.tree.map(leaf, tree)


def map_blocks(function: Callable[[Any], Any], rows: Any, size: int, full: bool = False) -> Any:
    """Returns `function(rows)`, computed for at most `size` rows at a time, which needs one compilation and little memory.

    Args:
        function: maps a tree like `rows` to a tree of arrays with the same leading axis.
        rows: a tree of arrays with a common leading axis, which must not be empty.
        size: number of rows of a block. The last block is filled up with copies of its last row.
        full: a single block is filled up as well, so that calls with fewer rows share the compilation.

    Returns:
        A tree of NumPy arrays.
    """
    count, parts = len(jax.tree.leaves(rows)[0]), []
    size = size if full else min(size, count)
    for start in range(0, count, size):
        index = np.minimum(np.arange(start, start + size), count - 1)
        block = jax.tree.map(lambda leaf, index=index: leaf[index], rows)
        parts.append(jax.tree.map(np.asarray, function(block)))
    return jax.tree.map(lambda *blocks: np.concatenate(blocks)[:count], *parts)
