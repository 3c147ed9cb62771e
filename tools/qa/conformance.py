"""Treatment of files that other programs write: `make conformance`, or `python -m tools.qa.conformance [--only Blender]`.

Runs the conformance suite (tests/conformance), in which the programs make their files and this library reads them, and writes
experiments/results/conformance.json: a row for each file, and counts by kind; docs/formats.md quotes it. A file that is neither
right nor refused in one line ends the command with exit code 2.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.markdown import markdown
from experiments.results import FOLDER
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import write_json
from wbgs_jax.evaluation.report import environment

ROOT = Path(__file__).parents[2]
SUITE = ROOT / "tests" / "conformance"
LEDGER = "WBGS_CONFORMANCE_LEDGER"
"""Environment variable that the suite knows: where it writes its rows."""
OURS = "wbgs-jax"
"""Begins the names of writers that are no other program."""
OUTCOMES = ("right", "refused", "different")
MODELS = {"glb": "gltf", "gltf": "gltf", "obj": "obj", "ply": "ply", "xml": "mitsuba"}
"""Kinds of rooms that are read, by format."""
KINDS = {"powers": "readings", "directions": "spectra", "gaussians": "gaussians"}
"""Kinds of all else, by what is compared."""

Row = dict[str, Any]


@dataclass(frozen=True)
class Command:
    """Make the files of all writers that are installed, and read them."""

    only: str = ""
    """Tests of one part alone, as in `pytest -k`; nothing is written then."""
    out: Path = FOLDER


def collect(ledger: Path) -> tuple[list[Row], list[str]]:
    """Returns the rows of files that were read, and the writers that are not installed."""
    entries = [json.loads(line) for line in ledger.read_text().splitlines()] if ledger.exists() else []
    rows = [finite(entry) for entry in entries if "outcome" in entry]
    missing = {entry["writer"] for entry in entries if "outcome" not in entry}
    return rows, sorted(missing)


def finite(row: Row) -> Row:
    """Returns a row without infinity, which JSON does not have: something is not there at all."""
    difference = row["difference"]
    return row if difference is None or math.isfinite(difference) else {**row, "difference": None}


def kind_of(row: Row) -> str:
    """Returns the line of the table in docs/formats.md that a row belongs to."""
    if row["measure"] == "geometry":
        return MODELS.get(row["form"], "others")
    if row["measure"] == "channels":
        return "sionna" if row["writer"] == "Sionna RT" else "deepmimo"
    return KINDS.get(row["measure"], "others")


def account(rows: list[Row]) -> dict[str, Any]:
    """Returns how many files there are and what became of them, and the largest difference of those that are right."""
    found: dict[str, Any] = {"files": len(rows)} | {name: sum(row["outcome"] == name for row in rows) for name in OUTCOMES}
    found["writers"] = len({row["writer"] for row in rows if not row["writer"].startswith(OURS)})
    right = [row["difference"] for row in rows if row["outcome"] == "right" and not row["approximate"]]
    return found | ({"largest_difference": max(right)} if right else {})


def summary(rows: list[Row]) -> dict[str, Any]:
    """Returns the accounts of all files, by kind and by what is compared; and the versions of the writers."""
    kinds, measures = {kind_of(row) for row in rows}, {row["measure"] for row in rows}
    return {
        "total": {name: value for name, value in account(rows).items() if name != "largest_difference"},  # of unlike things
        "kinds": {kind: account([row for row in rows if kind_of(row) == kind]) for kind in sorted(kinds)},
        "measures": {name: account([row for row in rows if row["measure"] == name]) for name in sorted(measures)},
        "versions": dict(sorted({row["writer"]: row["version"] for row in rows}.items())),
    }


def table(rows: list[Row]) -> str:
    """Returns the accounts by writer and format."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((f"{row['writer']} {row['version']}", row["form"]), []).append(row)
    lines = []
    for (writer, form), own in groups.items():
        found = account(own)
        largest = f"{found['largest_difference']:.1e}" if "largest_difference" in found else ""
        lines.append([f"{writer}, {form}", *(str(found[name]) for name in ("files", *OUTCOMES)), largest])
    return markdown(["writer, format", "files", *OUTCOMES, "largest difference"], lines)


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="python -m tools.qa.conformance")
    with tempfile.TemporaryDirectory() as folder:
        ledger = Path(folder) / "ledger.jsonl"
        words = [
            sys.executable,
            "-m",
            "pytest",
            "-p",
            "no:cacheprovider",
            str(SUITE),
            *(["-k", command.only] if command.only else []),
        ]
        tested = subprocess.run(words, cwd=ROOT, env=os.environ | {LEDGER: str(ledger)}, check=False)
        rows, missing = collect(ledger)
    say(table(rows))
    if missing:
        say(f"not installed: {', '.join(missing)}")
    if not command.only:
        path = command.out / "conformance.json"
        write_json(path, summary(rows) | {"missing": missing, "rows": rows, "environment": environment()})
        say(f"{path}: {account(rows)}")
    if tested.returncode:
        raise UserError("some files are neither right nor refused as they have to be; they are above")


if __name__ == "__main__":
    run_command(main)
