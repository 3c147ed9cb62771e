"""What stands around the package fits it: workflows call targets that there are, guides exist, the citation can be read."""

import re
from pathlib import Path

import pytest
import yaml

import wbgs_jax

ROOT = Path(__file__).parents[1]
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda path: path.name)
def test_workflows_and_templates_can_be_read_and_call_targets_that_there_are(path):
    assert isinstance(yaml.safe_load(path.read_text()), dict)
    called = set(re.findall(r"run: make ([a-z-]+)", path.read_text()))
    assert called <= TARGETS


def test_the_guides_name_targets_that_there_are():
    for page in ("CONTRIBUTING.md", "README.md"):
        called = re.findall(r"(?:^|`)make ([a-z-]+)", (ROOT / page).read_text(), re.MULTILINE)
        assert set(called) <= TARGETS, page


def test_the_citation_has_what_the_format_asks_for():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert all({"name"} <= set(author) or {"family-names", "given-names"} <= set(author) for author in citation["authors"])
    for reference in citation["references"]:
        assert {"type", "title", "authors"} <= set(reference)


def test_the_changelog_knows_this_version():
    text = (ROOT / "CHANGELOG.md").read_text()
    assert text.startswith("# Changelog\n") and re.search(rf"^## .*{re.escape(wbgs_jax.__version__)}", text, re.MULTILINE)
    assert set(re.findall(r"^### (.*)", text, re.MULTILINE)) <= {
        "Added",
        "Changed",
        "Deprecated",
        "Removed",
        "Fixed",
        "Security",
    }
