"""The numbers of the pages are those of the result files."""

import json

import pytest

from experiments.catalogue import SERIES
from experiments.evidence import ROOT, fill_pages, filled, pages, parse_pieces, pieces_of
from wbgs_jax._util.errors import UserError

PAGE = "scores <!-- x.json a.b -->{}<!-- / --> or <!-- x.json a.b 1 -->{}<!-- / -->, steps <!-- x.json n 0 -->{}<!-- / -->\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "x.json").write_text(json.dumps({"a": {"b": 0.12345, "name": "text"}, "n": 12000}))
    return tmp_path


@pytest.mark.parametrize("page", pages(), ids=lambda path: path.name)
def test_pages_and_files_agree(page):
    """`make tables` mends a page."""
    assert filled(page.read_text(), pieces=pieces_of(page)) == page.read_text()


def test_the_readme_quotes_files():
    assert sum(len(sources) for _, sources in parse_pieces(pieces_of(ROOT / "README.md"))) >= 6


def test_every_file_of_pieces_has_a_page():
    assert {path.stem for path in (ROOT / "docs" / "evidence").glob("*")} <= {page.stem for page in pages()}


PIECES = "{} or\n    x.json a.b\n\n| row | {} | {} |\n    x.json a.b 1\n    x.json n 0\n"


def test_blanks_of_a_page_are_filled(folder):
    page = "scores {}\nor more\n| row | {} | {} |\n| row | 1 | 1 | 1 |\n"
    right = page.format("0.123", "0.1", "12,000")
    assert filled(page.format("0.9", "3.1", "-1,000.5"), folder, PIECES) == right == filled(right, folder, PIECES)


@pytest.mark.parametrize(
    ("page", "pieces", "message"),
    [
        ("a 1 b 1", "a {}\n", "1 blanks and 0 sources"),
        ("a 1, a 2", "a {}\n    x.json a.b\n", "2 times"),
        ("a one", "a {}\n    x.json a.b\n", "0 times"),
        ("a 1", "a {}\n    y.json a.b\n", "not in"),
    ],
)
def test_pieces_that_do_not_fit(folder, page, pieces, message):
    with pytest.raises(UserError, match=message):
        filled(page, folder, pieces)


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
