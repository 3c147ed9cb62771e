"""Writes docs/api.md, the public names and their docstrings, from the stubs of the package and its groups: `make docs`."""

import ast
import dataclasses
import importlib
import inspect
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import wbgs_jax
from wbgs_jax._util.public_names import read_stub

ROOT = Path(__file__).parents[1]
HEAD = """# API

All public names, written from the docstrings by `make docs`; do not edit. After `import wbgs_jax as wb`, the first ones are
`wb.NAME`, and those of groups `wb.GROUP.NAME`, such as `wb.radio.steering_vector`. Arrays are float32 unless stated otherwise;
shapes are in brackets, such as `(b, 90, 360)`.
"""
TITLES = {
    "data": "Data",
    "commands": "Training",
    "evaluation": "Training",
    "fields": "Fields",
    "_util": "Fields",
    "inference": "A trained field",
    "training": "A trained field",
    "types": "What functions take and return",
    "radio": "What functions take and return",
}
"""Headings of names at the top, in their order, by the package that defines them."""
GROUPS = {
    "radio": "antenna arrays and channels",
    "splat": "rendering of Gaussians",
    "wideband": "the frequency-embedded splatting field",
    "coherent": "the field with phases",
    "applications": "what a trained field is for",
    "interchange": "files of other programs",
    "power_map": "measured powers",
    "fields": "all models, and what a new one needs",
}


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
    if not callable(value):
        return f"### `{name}`\n\n`{value!r}`\n"
    text = inspect.getdoc(value) or ""
    if not inspect.isclass(value):
        return f"### `{name}`\n\n```text\n{name}{signature(value)}\n```\n\n{as_markdown(text)}\n"
    rows = [f"* `{attribute}`{f': {words}' if words else ''}" for attribute, words in attributes(value)]
    methods = [
        f"* `{method}()`: {first_paragraph(getattr(value, method))}"
        for method in vars(value)
        if not method.startswith("_") and inspect.isroutine(getattr(value, method))
    ]
    return f"### `{name}`\n\n{as_markdown(text)}\n\n" + "\n".join([*rows, *methods]) + "\n"


def as_markdown(text: str) -> str:
    """Returns a docstring with its arguments and errors as lists, and its example as code."""
    parts = re.split(r"^(Args|Returns|Yields|Raises|Example):\n", text, flags=re.MULTILINE)
    written = [parts[0].strip()]
    for heading, content in zip(parts[1::2], parts[2::2], strict=True):
        body = inspect.cleandoc(content)
        if heading == "Example":
            written.append(f"```pycon\n{body}\n```")
        elif heading in ("Args", "Raises"):
            entries = re.sub(r"\n +", " ", body).splitlines()
            bullets = [re.sub(r"^([\w, ]+):", r"* `\1`:", entry) for entry in entries]
            written.append(f"{heading}:\n\n" + "\n".join(bullets))
        else:
            written.append(f"{heading}: {' '.join(body.split())}")
    return "\n\n".join(written)


def first_paragraph(value: Any) -> str:
    """Returns the first paragraph of a docstring, in one line."""
    return (inspect.getdoc(inspect.unwrap(value)) or "").split("\n\n")[0].replace("\n", " ")


def attributes(value: type) -> list[tuple[str, str]]:
    """Returns the fields of a dataclass or a named tuple, each with the docstring that stands below it."""
    names = [f.name for f in dataclasses.fields(value)] if dataclasses.is_dataclass(value) else getattr(value, "_fields", ())
    if not names:
        return []
    body = ast.parse(inspect.cleandoc("\n" + inspect.getsource(value))).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for node, after in zip(body.body, [*body.body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            words = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
            found[node.target.id] = " ".join(str(words).split())
    return [(name, found.get(name, "")) for name in names]


def module_entry(name: str, module: ModuleType) -> str:
    """Returns the entry of a field's module: its plain functions and its field."""
    lines = [f"### `{name}`", "", (inspect.getdoc(module) or "").strip(), ""]
    for function, value in vars(module).items():
        own = getattr(value, "__module__", "") == module.__name__ or function in getattr(module, "__all__", ())
        if own and not function.startswith("_") and callable(value):
            lines.append(f"* `{name}.{function}`: {first_paragraph(value)}")
    return "\n".join(lines) + "\n"


def top() -> str:
    """Returns the entries of the names at the top, under their headings."""
    parts: dict[str, list[str]] = {title: [] for title in TITLES.values()}
    for name, (module, inside) in read_stub("wbgs_jax", wbgs_jax.__file__).items():
        if name not in GROUPS:
            value = getattr(importlib.import_module(module), inside)
            parts[TITLES[module.split(".")[1]]].append(document(name, value))
    return "\n".join(f"## {title}\n\n" + "\n".join(entries) for title, entries in parts.items())


def group(name: str) -> str:
    """Returns the entries of a group; of a module, its plain functions and its field."""
    module = getattr(wbgs_jax, name)
    heading = f"## `wb.{name}`: {GROUPS[name]}\n"
    if name in ("coherent", "wideband"):
        return f"{heading}\n{module_entry(name, module)}"
    known = {id(getattr(wbgs_jax, one)) for one in wbgs_jax.__all__}
    entries = [
        module_entry(f"{name}.{one}", value) if isinstance(value, ModuleType) else document(f"{name}.{one}", value)
        for one, value in ((one, getattr(module, one)) for one in module.__all__)
        if id(value) not in known
    ]
    return f"{heading}\n" + "\n".join(entries)


def page() -> str:
    """Returns the whole page."""
    return "\n".join([HEAD, top(), *map(group, GROUPS)])


if __name__ == "__main__":
    (ROOT / "docs" / "api.md").write_text(page())
