"""Writes docs/api.md, the public names and their docstrings, from `wbgs_jax/__init__.pyi`: `make docs`."""

import ast
import dataclasses
import importlib
import inspect
import re
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).parents[1]
STUB = ROOT / "wbgs_jax" / "__init__.pyi"
HEAD = """# API

All public names, written from the docstrings by `make docs`; do not edit. `import wbgs_jax as wb` and use them as `wb.NAME`.
Arrays are float32 unless stated otherwise; shapes are in brackets, such as `(b, 90, 360)`.
"""
TITLES = {
    "fields": "Fields",
    "splat": "Splatting",
    "radio": "Antenna array",
    "types": "Pytrees",
    "data": "Data",
    "inference": "A trained field",
    "training": "A trained field",
    "applications": "What a trained field is for",
    "power_map": "Measured powers",
    "interchange": "Other programs",
    "_util": "Writing a field",
}
"""Headings, in their order, by the room of a name."""
HIDDEN = {"nerf2", "wave", "wideband", "wrfgs"}
"""Modules, described on their own."""


def public_names() -> list[tuple[str, str]]:
    """Returns (module, name) of everything that the stub exports."""
    found = []
    for node in ast.parse(STUB.read_text()).body:
        if isinstance(node, ast.ImportFrom):
            found += [(f"wbgs_jax.{node.module}", alias.name) for alias in node.names]
    return found


def signature(value: Any) -> str:
    """Returns the signature of a function with its annotations shortened to shapes."""
    try:
        text = str(inspect.signature(value))
    except (TypeError, ValueError):
        return ""
    text = re.sub(r"<function (\w+) at 0x\w+>", r"\1", text)  # a default that is a function
    text = re.sub(r"(?:jaxtyping\.)?(\w+)\[(?:jax\.|jaxlib\._jax\.)?Array, ['\"]([^'\"]*)['\"]\]", r"\1(\2)", text)
    return re.sub(r"\b(?:wbgs_jax|typing|collections|jax|numpy|abc|pathlib)(?:\.\w+)*\.(\w+)", r"\1", text).replace("'", "")


def document(name: str, value: Any) -> str:
    """Returns the entry of a name."""
    value = inspect.unwrap(value) if callable(value) and not inspect.isclass(value) else value
    text = inspect.getdoc(value) or ""
    if not inspect.isclass(value):
        return f"### `{name}`\n\n```text\n{name}{signature(value)}\n```\n\n{text}\n"
    rows = [f"* `{attribute}`{f': {words}' if words else ''}" for attribute, words in attributes(value)]
    methods = [
        f"* `{method}()`: {first_paragraph(getattr(value, method))}"
        for method in vars(value)
        if not method.startswith("_") and inspect.isroutine(getattr(value, method))
    ]
    return f"### `{name}`\n\n{text}\n\n" + "\n".join([*rows, *methods]) + "\n"


def first_paragraph(value: Any) -> str:
    """Returns the first paragraph of a docstring, in one line."""
    return (inspect.getdoc(inspect.unwrap(value)) or "").split("\n\n")[0].replace("\n", " ")


def attributes(value: type) -> list[tuple[str, str]]:
    """Returns the fields of a dataclass, each with the docstring that stands below it."""
    if not dataclasses.is_dataclass(value):
        return []
    body = ast.parse(inspect.cleandoc("\n" + inspect.getsource(value))).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for node, after in zip(body.body, [*body.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            words = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
            found[node.target.id] = " ".join(str(words).split())
    return [(f.name, found.get(f.name, "")) for f in dataclasses.fields(value)]


def module_entry(name: str, module: ModuleType) -> str:
    """Returns the entry of a field's module: its plain functions and its field."""
    lines = [f"### `{name}`", "", (inspect.getdoc(module) or "").strip(), ""]
    for function, value in vars(module).items():
        own = getattr(value, "__module__", "") == module.__name__ or function in getattr(module, "__all__", ())
        if own and not function.startswith("_") and callable(value):
            lines.append(f"* `{name}.{function}`: {first_paragraph(value)}")
    return "\n".join(lines) + "\n"


def page() -> str:
    """Returns the whole page."""
    parts: dict[str, list[str]] = {title: [] for title in TITLES.values()}
    for module, name in public_names():
        room = module.split(".")[1]
        value = getattr(importlib.import_module(module), name, None)
        entry = module_entry(name, value) if isinstance(value, ModuleType) else document(name, value)
        parts[TITLES[room]].append(entry)
    return "\n".join([HEAD, *(f"## {title}\n\n" + "\n".join(entries) for title, entries in parts.items() if entries)])


if __name__ == "__main__":
    (ROOT / "docs" / "api.md").write_text(page())
