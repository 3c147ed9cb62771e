"""Values of dataclasses and their declared types: plain types, tuples, literals, and unions of these."""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from typing import Any


def plain(value: Any) -> Any:
    """Returns a value as it is read from a file: tuples for lists and arrays, and Python numbers for NumPy scalars."""
    value = value.tolist() if hasattr(value, "tolist") else value
    return tuple(map(plain, value)) if isinstance(value, list | tuple) else value


def misfits(cls: type, values: Mapping[str, Any]) -> dict[str, str]:
    """Returns the names of values that do not have the types that a dataclass declares for them, with what is expected, in
    words. Names that are not declared, dataclasses, and fields of any type are not checked; numbers must be finite."""
    hints = typing.get_type_hints(cls)
    return {name: in_words(hints[name]) for name, value in values.items() if name in hints and not fits(value, hints[name])}


def fits(value: Any, declared: Any) -> bool:
    """Returns whether a value has a declared type."""
    origin, arguments = typing.get_origin(declared), typing.get_args(declared)
    if declared is Any or dataclasses.is_dataclass(declared):
        return True
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, one) for one in arguments)
    if origin is typing.Literal:
        return value in arguments
    if origin is tuple:
        inner = arguments[:1] * len(value) if isinstance(value, tuple) and arguments[-1] is Ellipsis else arguments
        return isinstance(value, tuple) and len(value) == len(inner) and all(map(fits, value, inner))
    if declared is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300 and math.isfinite(value)
    if declared is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63
    if declared is type(None):
        return value is None
    return isinstance(value, declared) if isinstance(declared, type) else True


def in_words(declared: Any) -> str:
    """Returns a declared type in words, such as "a whole number"."""
    origin, arguments = typing.get_origin(declared), typing.get_args(declared)
    if origin is typing.Literal:
        return " or ".join(map(repr, arguments))
    if origin in (typing.Union, types.UnionType):
        return " or ".join(map(in_words, arguments))
    if origin is tuple:
        return f"a sequence, each {in_words(arguments[0])}"
    known = {int: "a whole number", float: "a finite number", bool: "True or False", str: "a text", type(None): "None"}
    return known.get(declared, str(getattr(declared, "__name__", declared)))
