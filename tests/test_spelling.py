"""Documents, docstrings and comments hold no misspelt words: `codespell`, with .codespellrc."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def codespell(*arguments: str, folder: Path = ROOT) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "codespell_lib", "--config", str(ROOT / ".codespellrc"), *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


def test_nothing_is_misspelt():
    documents = [str(path.relative_to(ROOT)) for path in sorted(ROOT.glob("*.md"))]
    found = codespell(*documents, "docs", "wbgs_jax", "data_gen", "experiments", "tools", "tests")
    assert found.returncode == 0, found.stdout


def test_a_misspelt_word_is_found(tmp_path):
    wrong = "rec" + "ieved"
    (tmp_path / "page.md").write_text(f"The {wrong} power, the colour and the neighbour.\n")
    found = codespell("page.md", folder=tmp_path)
    assert found.returncode != 0 and wrong in found.stdout and "colour" not in found.stdout
