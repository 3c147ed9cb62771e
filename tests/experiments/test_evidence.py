"""The numbers of the pages are those of the result files."""

import json

import pytest

from experiments import evidence
from experiments.catalogue import SERIES
from experiments.evidence import ROOT, fill_pages, filled, pages
from wbgs_jax._util.errors import UserError

PAGE = "scores <!-- x.json a.b -->{}<!-- / --> or <!-- x.json a.b 1 -->{}<!-- / -->, steps <!-- x.json n 0 -->{}<!-- / -->\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "x.json").write_text(json.dumps({"a": {"b": 0.12345, "name": "text"}, "n": 12000}))
    return tmp_path


@pytest.mark.parametrize("page", pages(), ids=lambda path: path.name)
def test_pages_and_files_agree(page):
    """`make tables` mends a page."""
    assert filled(page.read_text()) == page.read_text()


def test_the_readme_quotes_files():
    assert len(evidence.VALUE.findall((ROOT / "README.md").read_text())) >= 6


def test_what_was_edited_by_hand_is_put_right(folder):
    right = PAGE.format("0.123", "0.1", "12,000")
    assert filled(PAGE.format("0.999", "", "1"), folder) == right == filled(right, folder)


@pytest.mark.parametrize(
    ("mark", "message"),
    [
        ("<!-- y.json a -->1<!-- / -->", "y.json, which is not in"),
        ("<!-- x.json a.c -->1<!-- / -->", "has no 'c'"),
        ("<!-- x.json a.name -->1<!-- / -->", "is no number"),
        ("<!-- series nonsense -->\n<!-- / -->", "nonsense"),
    ],
)
def test_what_there_is_not(folder, mark, message):
    with pytest.raises(UserError, match=message):
        filled(mark, folder)


def test_tables_of_a_series_are_put_in_whole(folder):
    page = "before\n<!-- series schedules -->\nold\n<!-- / -->\nafter\n"
    new = filled(page, folder)
    assert new.startswith("before\n") and new.endswith("\nafter\n") and "old" not in new
    assert SERIES["schedules"].series[0].title in new and filled(new, folder) == new


def test_only_what_changes_is_written(folder):
    (folder / "docs").mkdir()
    for name, text in (("README.md", PAGE.format("1", "1", "1")), ("docs/a.md", "no marks\n")):
        (folder / name).write_text(text)
    assert fill_pages(folder, folder) == [folder / "README.md"]
    assert fill_pages(folder, folder) == []
