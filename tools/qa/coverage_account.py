"""Which share of the library's lines and branches the tests reach: `make coverage` ends with this.

Reads the report that pytest-cov wrote, and writes experiments/results/coverage.json, all together and by room.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.results import FOLDER
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.files import read_json, write_json
from wbgs_jax.evaluation.report import environment


@dataclass(frozen=True)
class Command:
    """Write which share of the library's lines and branches tests reach."""

    report: Path = Path("coverage.json")
    """Report of pytest-cov (`--cov-report=json`)."""
    out: Path = FOLDER


def shares(summaries: Iterable[dict[str, Any]]) -> dict[str, float]:
    """Returns the percentages of lines and of branches that some files' tests reach."""
    files = list(summaries)

    def percent(reached: str, all_of: str) -> float:
        whole = sum(file[all_of] for file in files)
        return round(100 * sum(file[reached] for file in files) / whole, 1) if whole else 100.0

    return {
        "lines": percent("covered_lines", "num_statements"),
        "branches": percent("covered_branches", "num_branches"),
        "statements": sum(file["num_statements"] for file in files),
    }


def account(report: dict[str, Any]) -> dict[str, Any]:
    """Returns the shares of everything, and of every room."""
    rooms: dict[str, list[dict[str, Any]]] = {}
    for name, file in report["files"].items():
        folder = Path(name).parts[1:-1]
        rooms.setdefault(folder[0] if folder else "commands", []).append(file["summary"])
    together = [file for files in rooms.values() for file in files]
    return shares(together) | {"rooms": {name: shares(files) for name, files in sorted(rooms.items())}}


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="python -m tools.qa.coverage_account")
    found = account(read_json(command.report))
    write_json(command.out / "coverage.json", found | {"environment": environment()})
    say(f"lines {found['lines']} %, branches {found['branches']} %: {command.out / 'coverage.json'}")


if __name__ == "__main__":
    run_command(main)
