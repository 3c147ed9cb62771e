"""The notebooks of the documentation run, and their pages are those of their last run."""

import sys
from pathlib import Path

import nbformat
import pytest

FOLDER = Path(__file__).parents[1] / "docs" / "notebooks"
NOTEBOOKS = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
QUICKEST = "own_data"


@pytest.fixture(scope="module")
def tool():
    sys.path.insert(0, str(FOLDER.parent))
    try:
        import make_notebooks
    finally:
        sys.path.pop(0)
    return make_notebooks


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_outputs_and_pages_belong_to_the_cells(name, tool):
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), "run docs/make_notebooks.py"
    assert (FOLDER / f"{name}.ipynb").stat().st_size < tool.LARGEST
    markdown, pictures = tool.page(notebook, name)
    assert (FOLDER / f"{name}.md").read_text() == markdown, "run docs/make_notebooks.py"
    assert pictures and all((FOLDER / file).read_bytes() == content for file, content in pictures.items())


@pytest.mark.heavy
@pytest.mark.long
def test_a_notebook_runs_with_a_short_training(tool):
    notebook = nbformat.read(FOLDER / f"{QUICKEST}.ipynb", as_version=4)
    preset = '"--preset", "smoke"'
    (training,) = (cell for cell in notebook.cells if preset in cell.source)
    training.source = training.source.replace(preset, f'{preset}, "--optim.steps", "20"')
    assert_pictures(tool.execute(notebook), tool)


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_run(name, tool, monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)  # they train: there it pays to optimise what is compiled
    assert_pictures(tool.execute(nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)), tool)


def assert_pictures(notebook, tool):
    """A cell that fails has raised before."""
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any(tool.PICTURE in output.get("data", {}) for output in outputs)
