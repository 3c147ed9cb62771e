"""The documentation builds without a warning, holds every page, and asks no other host for anything."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytest.importorskip("mkdocs")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return folder


def test_every_page_is_in_the_site(site):
    pages = [path.relative_to(ROOT / "docs").with_suffix(".html") for path in (ROOT / "docs").rglob("*.md")]
    missing = [str(page) for page in pages if not (site / page).exists()]
    assert len(pages) > 20 and not missing


def test_no_page_loads_anything_from_elsewhere(site):
    loaded = re.compile(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=[\"']?(https?:[^\"' >]+)")
    found = {url for page in site.rglob("*.html") for url in loaded.findall(page.read_text())}
    assert not {url for url in found if "w3.org" not in url}


def test_every_picture_is_described():
    for page in (ROOT / "docs").rglob("*.md"):
        for words in re.findall(r"!\[([^\]]*)\]\(", page.read_text()):
            assert len(words) > 10, f"{page.name}: ![{words}]"


@pytest.mark.parametrize("word", ["frequency response", "impulse response", "sinr", "rssi", "link simulation", "csv"])
def test_the_search_finds_usual_names_in_headings(site, word):
    entries = json.loads((site / "search" / "search_index.json").read_text())["docs"]
    assert [entry["location"] for entry in entries if word in entry["title"].lower()]
