"""Executes the notebooks in docs/notebooks/ and writes each as a page, too: python docs/make_notebooks.py [NAME ...].

The .ipynb file is the source: change its cells, in Jupyter for instance, and run this. Notebooks run on the CPU, in an empty
folder.
"""

import base64
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parent / "notebooks"
SECONDS = 900
"""A cell may take, on a busy machine."""
LARGEST = 600_000
"""Bytes of a notebook."""
KEPT = ("stdout",)
"""Streams that are kept: progress bars go to the other one."""
PICTURE = "image/png"
CONTROL = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
"""Colours of terminals."""


def execute(notebook: Any) -> Any:
    """Returns a notebook after running all of its cells in an empty folder."""
    os.environ |= {"JAX_PLATFORMS": "cpu", "TF_CPP_MIN_LOG_LEVEL": "3"}
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, timeout=SECONDS, kernel_name="python3", resources={"metadata": {"path": folder}}).execute()
    return notebook


def clean(notebook: Any) -> Any:
    """Returns a notebook without what differs from run to run or is for terminals alone."""
    notebook.metadata = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    for number, cell in enumerate(notebook.cells):
        cell.metadata, cell.id = {}, f"cell-{number}"
        if cell.cell_type == "code":
            cell.outputs = list(merged(cell.outputs))
    return notebook


def merged(outputs: list[Any]) -> Iterator[Any]:
    """Gives the pictures of a cell, and what is printed between two of them as one text without colours."""
    text = ""
    for output in [*outputs, None]:
        if output is not None and PICTURE not in output.get("data", {}):
            kept = output.output_type != "stream" or output.name in KEPT
            text += CONTROL.sub("", output.get("text") or output.get("data", {}).get("text/plain", "")) if kept else ""
            continue
        if text.strip():
            yield nbformat.v4.new_output("stream", name="stdout", text="\n".join(map(str.rstrip, text.splitlines())) + "\n")
        text = ""
        if output is not None:
            yield nbformat.v4.new_output("display_data", data={PICTURE: output.data[PICTURE]})


def page(notebook: Any, name: str) -> tuple[str, dict[str, bytes]]:
    """Returns a notebook as Markdown, and the pictures that belong to it by their file names."""
    parts = [f"<!-- Written by docs/make_notebooks.py from {name}.ipynb; do not edit. -->"]
    pictures: dict[str, bytes] = {}
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            about = " ".join(cell.source.split("\n\n")[-1].split())  # the last paragraph is what a picture shows
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.outputs:
            data = output.get("data", {})
            if PICTURE in data:
                file = f"{name}_{len(pictures) + 1}.png"
                pictures[file] = base64.b64decode(data[PICTURE])
                parts.append(f"![{about}]({file})")
            else:
                parts.append(f"```text\n{output.text.rstrip()}\n```")
    return "\n\n".join([*parts, f"The notebook itself: [{name}.ipynb]({name}.ipynb)."]) + "\n", pictures


def write(name: str) -> None:
    """Executes a notebook and writes it, its page and its pictures.

    Raises:
        SystemExit: the notebook has become too large to keep in a repository.
    """
    file = FOLDER / f"{name}.ipynb"
    notebook = clean(execute(nbformat.read(file, as_version=4)))
    text = nbformat.writes(notebook)
    if len(text) > LARGEST:
        raise SystemExit(f"error: {file.name} has {len(text)} bytes with its outputs; draw smaller pictures")
    file.write_text(text + "\n")
    markdown, pictures = page(notebook, name)
    for old in FOLDER.glob(f"{name}_*.png"):
        old.unlink()
    (FOLDER / f"{name}.md").write_text(markdown)
    for picture, content in pictures.items():
        (FOLDER / picture).write_bytes(content)


if __name__ == "__main__":
    for chosen in sys.argv[1:] or sorted(path.stem for path in FOLDER.glob("*.ipynb")):
        write(chosen)
        print(f"docs/notebooks/{chosen}.ipynb, {chosen}.md")
