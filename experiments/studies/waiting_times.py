"""Waiting times of users: `python -m experiments.studies.waiting_times`, experiments/results/waiting_times.json.

Every case trains and evaluates as the two commands of the README do, first with an empty cache of compiled programs and then
with the one that this has filled: wall times, the duration that was announced, the longest time without a line, and the scores.
Run it on an idle machine; a case that another program disturbs is run again by `--only`.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.results import FOLDER, SHARED
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.compilation import VARIABLE
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_json, write_json
from wbgs_jax.evaluation.report import environment

CASES: Mapping[str, tuple[str, ...]] = {
    "scene1 smoke": ("--scene", "1", "--preset", "smoke"),
    "scene1": ("--scene", "1", "--preset", "cpu"),
    "scene2": ("--scene", "2", "--preset", "cpu"),
    "scene4": ("--scene", "4", "--preset", "cpu"),
    "example1": ("--data", str(SHARED / "wideband3dgs_example1"), "--preset", "cpu"),
}
"""Options of the training of every case."""
UNITS = {"second": 1, "minute": 60, "hour": 3600}


def watched(arguments: list[str], variables: Mapping[str, str]) -> tuple[str, dict[str, Any]]:
    """Runs a command of the library and returns what it prints on stdout, its wall time, the longest time without a line on
    stderr, and the duration that it announces (seconds)."""
    begin = time.monotonic()
    quiet, last, announced = 0.0, begin, None
    with tempfile.TemporaryFile("w+") as output:
        command = [sys.executable, "-m", "wbgs_jax", *arguments]
        with subprocess.Popen(command, env=os.environ | variables, stdout=output, stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr is not None
            for line in process.stderr:
                now = time.monotonic()
                quiet, last = max(quiet, now - last), now
                announced = announced or announced_seconds(line)
        end = time.monotonic()
        if process.returncode:
            raise UserError(f"{' '.join(arguments)} ended with exit code {process.returncode}")
        output.seek(0)
        figures = {"seconds": round(end - begin, 1), "longest_silence_s": round(max(quiet, end - last), 1)}
        return output.read(), figures | ({} if announced is None else {"announced_s": announced})


def announced_seconds(line: str) -> float | None:
    """Returns the duration in words of a line such as "1400 steps, about 4 minutes on this machine", seconds; None without."""
    found = re.search(r"about ([\d.]+) (second|minute|hour)s? on this machine", line)
    return None if found is None else float(found[1]) * UNITS[found[2]]


def measure(name: str, folder: Path) -> dict[str, Any]:
    """Returns the times of a case, with an empty and with a filled cache."""
    found: dict[str, Any] = {}
    for state in ("empty", "filled"):
        run, variables = folder / f"{name} {state}", {VARIABLE: str(folder / name), "TF_CPP_MIN_LOG_LEVEL": "3"}
        _, train = watched(["train", *CASES[name], "--out", str(run)], variables)
        printed, score = watched(["eval", "--run", str(run), "--json"], variables)
        report = json.loads(printed)
        own = {"median_ssim": report["median_ssim"], "mean_ssim": report["mean_ssim"], "spectra": report["n"]}
        found[state] = {"train": train, "eval": score} | own
        say(f"{name}, cache {state}: training {train['seconds']:.0f} s, evaluation {score['seconds']:.0f} s")
    return found


@dataclass(frozen=True)
class Command:
    """Measure how long training and evaluation take, and what was announced."""

    only: tuple[str, ...] = ()
    """Cases; by default all."""
    out: Path = FOLDER / "waiting_times.json"


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.studies.waiting_times")
    wanted = command.only or tuple(CASES)
    if unknown := set(wanted) - set(CASES):
        raise UserError(f"there is no case {min(unknown)!r}; choose from {', '.join(CASES)}")
    for name in wanted:
        with tempfile.TemporaryDirectory() as folder:
            row = measure(name, Path(folder)) | environment()
        known = read_json(command.out) if command.out.exists() else {}
        write_json(command.out, known | {name: row})


if __name__ == "__main__":
    run_command(main)
