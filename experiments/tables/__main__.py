"""Write the page of results and the table of all results: `python -m experiments.tables [--profile quick]`.

docs/results.md, docs/results_tables.md and their pictures in docs/images (all with _<profile> appended for other profiles than
quick), the curves that
docs/wave.md shows, experiments/results/results.csv and headline.json, and the marked numbers of README.md and all pages
(`evidence.py`).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from experiments import evidence, result_table
from experiments.results import FOLDER, Results
from experiments.tables import faults, summary
from experiments.tables.page import long_page, page
from experiments.tables.plots import save
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.files import atomic_write

DOCS = Path(__file__).parents[2] / "docs"


@dataclass(frozen=True)
class Command:
    """Write the page of results, and all results as one table."""

    profile: Literal["quick", "paper", "smoke"] = "quick"
    results: Path = FOLDER
    docs: Path = DOCS


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.tables", args=arguments)
    suffix = "" if command.profile == "quick" else f"_{command.profile}"
    results = Results(command.profile, command.results)
    for name, text in (("results", page), ("results_tables", long_page)):
        path = command.docs / f"{name}{suffix}.md"
        with atomic_write(path) as stream:
            stream.write(text(results, command.docs / f"images{suffix}").encode())
        print(path)
    print(result_table.write(command.results))
    if not suffix:
        print(summary.write(results))
        save(faults.draw(results), command.docs / "images", "faults", "")
    if command.docs == DOCS:
        for changed in evidence.fill_pages(folder=command.results):
            print(changed)


if __name__ == "__main__":
    run_command(main)
