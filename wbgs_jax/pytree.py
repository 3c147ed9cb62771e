"""Frozen dataclasses as pytrees."""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax

T = TypeVar("T")


def static() -> Any:
    """A field that is part of the tree's structure, not a leaf; its value must be hashable."""
    return dataclasses.field(metadata={"static": True})


@dataclass_transform(frozen_default=True, field_specifiers=(static, dataclasses.field))
def pytree(cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass and a pytree.

    Unlike `jax.tree_util.register_dataclass`, rebuilding a tree does not call `__init__`: transformations put shapes, masks
    and markers where the annotations promise arrays, and run-time type checks must not trip over them.
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
