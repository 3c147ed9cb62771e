"""Numbers of the pages, from result files: `make tables` fills them in, and a test fails where page and file disagree.

docs/evidence/<page>.txt holds pieces of a page with blanks for its numbers, and below each piece, indented, what fills the
blanks: a result file, a place in it by dots, and the decimals where they are not three. A piece stands in the page exactly
once; a line break counts as a space; the first and the last bar of a piece are those of a table's row.

    the default field scores {} there, and {} with its mesh
        quality_example1_wideband_cpu_cpu.json median_ssim
        quality_example1_hybrid_cpu_cpu.json median_ssim 2

Marks within a page do the same, for rows that a command prints, and for all tables of a series:

<!-- quality_example1_wave_cpu_cpu.json median_ssim -->0.528<!-- / -->
<!-- series schedules -->
<!-- / -->
"""

import re
from pathlib import Path
from typing import Any

from experiments.catalogue import SERIES
from experiments.results import FOLDER, Results, read_row
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, read_json

ROOT = Path(__file__).parents[1]
VALUE = re.compile(r"<!-- (?P<file>\S+\.json) (?P<place>\S+)(?: (?P<decimals>\d))? -->[^<\n]*<!-- / -->")
NUMBER = r"(-?\d[\d,]*(?:\.\d+)?)"
TABLES = re.compile(r"<!-- series (?P<name>\w+) -->\n.*?<!-- / -->", re.DOTALL)


def pages(root: Path = ROOT) -> list[Path]:
    """Returns the pages whose numbers come from files."""
    return [root / "README.md", *sorted((root / "docs").glob("*.md"))]


def pieces_of(page: Path) -> str:
    """Returns the text of docs/evidence for a page; empty where there is none."""
    docs = page.parent / "docs" if page.name == "README.md" else page.parent
    path = docs / "evidence" / f"{page.stem}.txt"
    return path.read_text() if path.exists() else ""


def parse_pieces(text: str) -> list[tuple[str, list[str]]]:
    """Returns the pieces of a page, each with the sources of its blanks.

    Raises:
        UserError: a piece has more or fewer blanks than sources.
    """
    pieces: list[tuple[str, list[str]]] = []
    for line in text.splitlines():
        if line[:1].isspace() and line.strip() and pieces:
            pieces[-1][1].append(line.strip())
        elif line.strip():
            pieces.append((line.strip(), []))
    for piece, sources in pieces:
        if piece.count("{}") != len(sources):
            raise UserError(f"docs/evidence: {piece!r} has {piece.count('{}')} blanks and {len(sources)} sources")
    return pieces


def filled(text: str, folder: Path = FOLDER, pieces: str = "") -> str:
    """Returns a page with all its quoted numbers as the result files have them; `pieces`: see `pieces_of`.

    Raises:
        UserError: a file, a value, a series or a piece of the page is missing.
    """
    for piece, sources in parse_pieces(pieces):
        text = fill_piece(text, piece, [formatted(folder, *source.split()) for source in sources])

    def value(found: re.Match[str]) -> str:
        mark = found[0].split("-->", 1)[0] + "-->"
        return f"{mark}{formatted(folder, found['file'], found['place'], found['decimals'] or '3')}<!-- / -->"

    def tables(found: re.Match[str]) -> str:
        name = found["name"]
        if name not in SERIES:
            raise UserError(f"a page wants the tables of the series {name!r}; choose among: {', '.join(SERIES)}")
        return f"<!-- series {name} -->\n{SERIES[name].render(Results('quick', folder))}\n<!-- / -->"

    return TABLES.sub(tables, VALUE.sub(value, text))


def fill_piece(text: str, piece: str, numbers: list[str]) -> str:
    """Returns the page with numbers in the blanks of a piece.

    Raises:
        UserError: the piece does not stand in the page exactly once.
    """
    literal = [r"\s+".join(map(re.escape, re.split(r"\s+", part))) for part in piece.split("{}")]
    row = ("^" * piece.startswith("|"), "$" * piece.endswith("|"))
    found = list(re.finditer(NUMBER.join(literal).join(row), text, re.MULTILINE))
    if len(found) != 1:
        raise UserError(f"docs/evidence: {piece!r} stands {len(found)} times in its page; correct one of the two")
    match = found[0]
    for group in reversed(range(len(numbers))):
        start, end = match.span(group + 1)
        text = text[:start] + numbers[group] + text[end:]
    return text


def formatted(folder: Path, file: str, place: str, decimals: str = "3") -> str:
    """Returns a number of a result file as pages write it."""
    return f"{look_up(folder, file, place):,.{int(decimals)}f}"


def look_up(folder: Path, file: str, place: str) -> float:
    """Returns a number of a result file."""
    profile, _, row = file.removesuffix(".json").rpartition("/")
    rows = folder / f"{profile}.jsonl"
    if (folder / file).exists():
        found: Any = read_json(folder / file)
    elif (found := read_row(rows, row)) is None:
        raise UserError(f"a page quotes {file}, which is not in {folder}; run the command that writes it, or correct the page")
    for name in place.split("."):
        if not isinstance(found, dict) or name not in found:
            raise UserError(f"a page quotes {place} of {file}, which has no {name!r}; correct the page")
        found = found[name]
    if not isinstance(found, int | float):
        raise UserError(f"a page quotes {place} of {file}, where there is no number; correct the page")
    return found


def fill_pages(root: Path = ROOT, folder: Path = FOLDER) -> list[Path]:
    """Fills all pages, and returns those that have changed."""
    changed = []
    for page in pages(root):
        text = page.read_text()
        if (new := filled(text, folder, pieces_of(page))) != text:
            with atomic_write(page) as stream:
                stream.write(new.encode())
            changed.append(page)
    return changed
