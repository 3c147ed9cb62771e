"""Public names of a package: loaded when they are first used, listed in the `__init__.pyi` beside its `__init__.py`.

A stub holds the names once, for the runtime, for type checkers and for the documentation (docs/make_api.py). Earlier names
lead to the present ones and warn.
"""

import ast
import importlib
import sys
import warnings
from collections.abc import Callable, Mapping
from importlib.util import resolve_name
from types import MappingProxyType

NONE: Mapping[str, str] = MappingProxyType({})


def read_stub(package: str, file: str) -> dict[str, tuple[str, str]]:
    """Returns the public names of a package: {name: (module, name in that module)}.

    Args:
        package: its full name.
        file: path of its `__init__.py`.
    """
    found: dict[str, tuple[str, str]] = {}
    with open(f"{file}i", encoding="utf-8") as stub:  # noqa: PTH123, importing pathlib takes longer than all of this
        nodes = ast.parse(stub.read()).body
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            module = resolve_name("." * node.level + (node.module or ""), package)
            found |= {alias.asname or alias.name: (module, alias.name) for alias in node.names}
    return found


def attach(
    package: str, file: str, renamed: Mapping[str, str] = NONE
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Returns `__getattr__`, `__dir__` and `__all__` of a package whose names are those of its stub.

    Args:
        package: `__name__` of the package.
        file: its `__file__`.
        renamed: earlier names, each with the present one, such as "radio.cbf"; their use warns.
    """
    names = read_stub(package, file)

    def load(name: str) -> object:
        if name in names:
            module, inside = names[name]
            if module == package:  # a group, which the import makes an attribute
                return importlib.import_module(f"{package}.{inside}")
            found = sys.modules[package].__dict__[name] = getattr(importlib.import_module(module), inside)
            return found
        if name in renamed:
            warn_renamed(f"{package}.{name}", f"{package}.{renamed[name]}")
            value: object = sys.modules[package]
            for part in renamed[name].split("."):
                value = getattr(value, part)
            return value
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return load, lambda: [*names], [*names]


def warn_renamed(old: str, new: str, stacklevel: int = 3) -> None:
    """Warns that an earlier name is used; `stacklevel` counts frames as `warnings.warn` does."""
    warnings.warn(f"{old} is deprecated; use {new}", DeprecationWarning, stacklevel=stacklevel)
