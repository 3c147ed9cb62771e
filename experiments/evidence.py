"""Numbers of the pages, from result files: `make tables` fills marked places, and a test fails where page and file disagree.

<!-- quality_example1_wave_cpu_cpu.json median_ssim -->0.528<!-- / -->       a value; its place in the file by dots
<!-- quality_x.json baselines.nearest_tx.median_ssim 2 -->0.79<!-- / -->     ... with two decimals instead of three
<!-- quick/scene1_wave_seed0.json median_ssim -->0.9<!-- / -->               ... of the row of that name in quick.jsonl
<!-- series schedules -->                                                    all tables of a series, up to its
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
TABLES = re.compile(r"<!-- series (?P<name>\w+) -->\n.*?<!-- / -->", re.DOTALL)


def pages(root: Path = ROOT) -> list[Path]:
    """Returns the pages whose numbers come from files."""
    return [root / "README.md", *sorted((root / "docs").glob("*.md"))]


def filled(text: str, folder: Path = FOLDER) -> str:
    """Returns a page with all marked places as the result files have them.

    Raises:
        UserError: a place names a file, a value or a series that there is not.
    """

    def value(found: re.Match[str]) -> str:
        number = look_up(folder, found["file"], found["place"])
        decimals = int(found["decimals"] or 3)
        mark = found[0].split("-->", 1)[0] + "-->"
        return f"{mark}{number:,.{decimals}f}<!-- / -->"

    def tables(found: re.Match[str]) -> str:
        name = found["name"]
        if name not in SERIES:
            raise UserError(f"a page wants the tables of the series {name!r}; choose among: {', '.join(SERIES)}")
        return f"<!-- series {name} -->\n{SERIES[name].render(Results('quick', folder))}\n<!-- / -->"

    return TABLES.sub(tables, VALUE.sub(value, text))


def look_up(folder: Path, file: str, place: str) -> float:
    """Returns a number of a result file."""
    profile, _, row = file.removesuffix(".json").rpartition("/")
    rows = folder / f"{profile}.jsonl"
    if (folder / file).exists():
        found: Any = read_json(folder / file)
    elif (found := read_row(rows, row)) is None:
        raise UserError(f"a page quotes {file}, which is not in {folder}; run what writes it, or mend the page")
    for name in place.split("."):
        if not isinstance(found, dict) or name not in found:
            raise UserError(f"a page quotes {place} of {file}, which has no {name!r}; mend the page")
        found = found[name]
    if not isinstance(found, int | float):
        raise UserError(f"a page quotes {place} of {file}, which is no number; mend the page")
    return found


def fill_pages(root: Path = ROOT, folder: Path = FOLDER) -> list[Path]:
    """Fills all pages, and returns those that have changed."""
    changed = []
    for page in pages(root):
        text = page.read_text()
        if (new := filled(text, folder)) != text:
            with atomic_write(page) as stream:
                stream.write(new.encode())
            changed.append(page)
    return changed
