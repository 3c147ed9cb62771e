"""Faults that the product withstands: `python -m tools.qa.reliability [--only kills]`.

Runs the tests of faults (tests/reliability, the slow ones too) and counts what was tried and held: kills, disks that refuse
writes, damaged files, careless command lines. Writes experiments/results/reliability.json; docs/reliability.md quotes it. What
fails is not counted, and ends with exit code 2.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.results import FOLDER
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_json, write_json
from wbgs_jax.evaluation.report import environment

ROOT = Path(__file__).parents[2]
FAULTS = ROOT / "tests" / "reliability"
LEDGER, SEED = "WBGS_FAULT_LEDGER", "WBGS_TEST_SEED"
"""Environment variables that the tests know: where they count, and the seed of what they draw."""


@dataclass(frozen=True)
class Command:
    """Run the tests of faults and write what they tried."""

    only: str = ""
    """Tests of one part alone, as in `pytest -k`: kills, full_disks, fuzz_readers, fuzz_commands, guided; other
    counts stay."""
    seed: int | None = None
    """Seed of everything that is drawn; a new one by default."""
    out: Path = FOLDER


def collect(ledger: Path) -> dict[str, dict[str, int]]:
    """Returns how many cases were tried, by part and name."""
    found: dict[str, dict[str, int]] = {}
    for line in ledger.read_text().splitlines() if ledger.exists() else ():
        entry = json.loads(line)
        part = found.setdefault(entry["part"], {})
        part[entry["name"]] = part.get(entry["name"], 0) + entry["number"]
    return found


def account(before: Any, found: dict[str, dict[str, int]], run: dict[str, Any]) -> dict[str, Any]:
    """Returns the account with new counts in the place of those of the same names."""
    known = before.get("tried", {}) if isinstance(before, dict) else {}
    tried = {part: known.get(part, {}) | found.get(part, {}) for part in sorted({*known, *found})}
    totals = {part.replace(" ", "_"): sum(counts.values()) for part, counts in tried.items()}  # as marks of pages name them
    runs = [*(before.get("runs", []) if isinstance(before, dict) else []), run]
    return {"totals": totals, "tried": tried, "runs": runs[-8:]}


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="python -m tools.qa.reliability")
    seed = int.from_bytes(os.urandom(4)) if command.seed is None else command.seed
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        ledger = Path(folder) / "ledger.jsonl"
        words = [sys.executable, "-m", "pytest", str(FAULTS), *(["-k", command.only] if command.only else [])]
        tested = subprocess.run(words, cwd=ROOT, env=os.environ | {LEDGER: str(ledger), SEED: str(seed)}, check=False)
        found = collect(ledger)
    path = command.out / "reliability.json"
    run = {"seed": seed, "only": command.only, "seconds": round(time.perf_counter() - begin), "environment": environment()}
    write_json(path, account(read_json(path) if path.exists() else {}, found, run | {"passed": tested.returncode == 0}))
    say(f"tried: {sum(sum(counts.values()) for counts in found.values()):,} cases; {path}")
    if tested.returncode:
        raise UserError(f"some tests of faults failed (seed {seed}); they are above, and are not counted")


if __name__ == "__main__":
    run_command(main)
