"""Checks that values read from a file have the types that a dataclass declares."""

import dataclasses
import math
import types
import typing
from typing import Any


def misfit(value: Any) -> str:
    """Returns the first field of a dataclass whose value does not have the declared type, as "NAME is VALUE"; empty if all do.
    Fields that are dataclasses or of any type are not checked; numbers must be finite."""
    hints = typing.get_type_hints(type(value))
    for field in dataclasses.fields(value):
        content = getattr(value, field.name)
        if not fits(content, hints[field.name]):
            return f"{field.name} is {repr(content)[:60]}"
    return ""


def fits(value: Any, declared: Any) -> bool:
    """Returns whether a value has a declared type: plain types, tuples, literals, and unions of these."""
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
