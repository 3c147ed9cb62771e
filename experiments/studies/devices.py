"""One device, four devices and two processes train the same fields: `python -m experiments.studies.devices`.

All are simulated on the processors of this machine. Every kind of run is a process of its own (or two) that trains on some of
scene 1 for forty steps. Their curves, what their compiled programs exchange, and what the parts of a step take are written
to experiments/results/devices.json, with what follows on paper for more devices; docs/scaling.md quotes them.
"""

import os
import socket
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments.results import FOLDER
from experiments.studies.devices_paper import on_paper
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.devices import COORDINATOR, COUNT, NUMBER
from wbgs_jax._util.files import read_json, write_json
from wbgs_jax.evaluation.report import environment
from wbgs_jax.training import curves

KINDS = ("one", "reversed", "four", "two")
"""One device; one that takes the links of every batch in reverse, so that sums are rounded otherwise; four; two processes."""
DONE = "done"
"""File in the folder of a finished kind."""
FIGURES = ("loss", "batch_ssim", "held_out_ssim")


@dataclass(frozen=True)
class Command:
    """Compare trainings on several devices with one device's."""

    fields: tuple[str, ...] = ("wideband", "nerf2", "wave")
    out: Path = FOLDER
    work: Path | None = None
    """Folder of the trainings, which is kept: those that are finished there are not repeated."""


def start(kind: str, folder: Path, fields: tuple[str, ...], **variables: str) -> subprocess.Popen:
    """Starts a process that trains the fields."""
    flags = f"--xla_force_host_platform_device_count={4 if kind == 'four' else 1}"
    # More devices than cores, and other work on the machine: XLA's own patience is too short.
    flags += " --xla_cpu_collective_call_terminate_timeout_seconds=1200 --xla_cpu_collective_timeout_seconds=1200"
    environ = os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags} | variables
    return subprocess.Popen([sys.executable, "-m", "experiments.studies.devices_part", kind, str(folder), *fields], env=environ)


def run(kind: str, folder: Path, fields: tuple[str, ...]) -> None:
    """Trains the fields in a process, or in two."""
    started = [start(kind, folder, fields)] if kind != "two" else []
    if kind == "two":
        with socket.socket() as free:
            free.bind(("localhost", 0))
            variables = {COORDINATOR: f"localhost:{free.getsockname()[1]}", COUNT: "2"}
        started = [start(kind, folder, fields, **variables, **{NUMBER: str(number)}) for number in range(2)]
    for process in started:
        if process.wait():
            raise SystemExit(f"the run of kind {kind} failed")


def curve(folder: Path) -> dict[str, list[float]]:
    """Returns the curves of a run: mean figures of every five steps, and sizes."""
    entries = [entry for entry in curves.read(folder / "metrics.jsonl") if "loss" in entry]
    names = [name for name in (*FIGURES, "gaussians") if any(entry.get(name) is not None for entry in entries)]
    found = {name: [entry[name] for entry in entries if entry.get(name) is not None] for name in names}
    return found | {"step": [entry["step"] for entry in entries]}


def furthest(curve: dict[str, list[float]], other: dict[str, list[float]]) -> dict[str, float]:
    """Returns the largest relative difference of two runs by figure, percent."""
    names = [name for name in curve if name != "step"]
    return {name: 100 * float(np.max(np.abs(np.array(curve[name]) / np.array(other[name]) - 1))) for name in names}


def in_units(parts: dict[str, Any]) -> dict[str, Any]:
    """Returns the measured parts of a field's step in the units of the page too: milliseconds and kilobytes."""
    times = {
        f"{name.removesuffix('_s')}_ms": 1e3 * value
        for name, value in parts.items()
        if name.endswith("_s") and name != "step_s"
    }
    return parts | times | {f"{name}_kb": parts[f"{name}_bytes"] / 1e3 for name in ("gradient", "state", "data")}


def report_of(runs: dict[str, Any], exchanged: dict[str, Any], parts: dict[str, Any]) -> dict[str, Any]:
    """Returns everything that is written, from the curves by field and kind of run, and what two of the kinds looked at."""
    last = {
        field: {kind: {name: values[-1] for name, values in one.items()} for kind, one in of.items()}
        for field, of in runs.items()
    }
    differ = {field: {kind: furthest(of[kind], of["one"]) for kind in KINDS[1:]} for field, of in runs.items()}
    report = {"curves": runs, "last": last, "furthest_percent": differ, "exchanged": exchanged}
    report |= {"parts": {field: in_units(own) for field, own in parts.items()}, "paper": on_paper(parts)}
    return report | {"provenance": environment() | {"command": "python -m experiments.studies.devices"}}


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.studies.devices")
    with tempfile.TemporaryDirectory() as name:
        work = command.work or Path(name)
        for kind in KINDS:
            if not (work / kind / DONE).exists():
                say(f"training: {kind}")
                run(kind, work / kind, command.fields)
                (work / kind / DONE).touch()
        runs = {field: {kind: curve(work / kind / field) for kind in KINDS} for field in command.fields}
        looked = read_json(work / "four" / "exchanged.json"), read_json(work / "one" / "parts.json")
    write_json(command.out / "devices.json", report_of(runs, *looked))


if __name__ == "__main__":
    run_command(main)
