"""Check a GPU: is everything right there, and how fast is it? One command, at most nine minutes, one JSON.

    python -m experiments.gpu_check [--minutes 9] [--only parity renderer] [--out folder]

Parity of values and gradients with the CPU, a table of the renderer's times and memory, the coherent field, queries a second,
and the training of the preset `paper` with what time is left. Everything is in experiments/results/gpu_check_<device>.json as
soon as it is known; what was cut or failed is listed there and at the end. The exit code is 0 when parity holds. Without a GPU
a stand-in runs: small sizes, the program that a GPU would compile run on the CPU, and memory by the compilers.
"""

# Nothing here may touch JAX: the sections, one process after the other, need all of the device's memory.
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from experiments.gpu_check.record import Record, not_done, parity_holds
from wbgs_jax._util.command import run_command, say
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_json, write_json

RESULTS = Path(__file__).parents[1] / "results"
Name = Literal["parity", "renderer", "coherent", "queries", "compiled", "paper"]
SHARES: dict[Name, float] = {"parity": 0.35, "renderer": 0.15, "coherent": 0.15, "queries": 0.1, "compiled": 0.15, "paper": 1.0}
"""Sections as they run, and the share of the whole time that each may take, if it is left: the training takes the rest."""
STAND_IN_ONLY = ("compiled",)
SMALL = ("parity", "coherent", "queries", "paper")
"""Sections whose stand-ins compute next to nothing: ..."""
CHEAP = {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"}
"""... half of the time that compiling them takes is for their speed."""
MODULE = "experiments.gpu_check.sections"
ROOT = Path(__file__).parents[2]
START_S = 60.0
"""What finding the device may take."""
GRACE_S = 8.0
"""A section is asked to end this long before its process is ended."""
LEAST_S = 15.0
"""With less time a section does not begin."""


@dataclass(frozen=True)
class Command:
    """Check the GPU of this machine, or what can be checked without one."""

    minutes: float = 9.0
    """The most that all of it takes."""
    only: tuple[Name, ...] = ()
    """Sections; all by default. The file keeps the others, of an earlier run on the same device."""
    out: Path = RESULTS
    """Folder of the result file."""

    @property
    def sections(self) -> list[Name]:
        """Those that are wanted, in their order."""
        return [name for name in SHARES if not self.only or name in self.only]


def start(*arguments: str, **options: Any) -> subprocess.Popen[str]:
    """Starts the module of the sections in a process group of its own."""
    command = [sys.executable, "-m", MODULE, *arguments]
    return subprocess.Popen(command, cwd=ROOT, text=True, start_new_session=True, **options)


def end(process: subprocess.Popen[str]) -> None:
    """Ends a process and all that it started; files are whole or absent, so nothing is lost."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def find_device() -> dict[str, Any]:
    """Returns what `sections.device` says.

    Raises:
        UserError: JAX does not start here.
    """
    process = start("device", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        said, complaints = process.communicate(timeout=START_S)
    except subprocess.TimeoutExpired:
        end(process)
        raise UserError(f"JAX found no device within {START_S:.0f} s; look at `nvidia-smi` and JAX_PLATFORMS") from None
    if process.returncode:
        last = (complaints.strip().splitlines() or ["no reason given"])[-1]
        raise UserError(f"JAX does not start here: {last}")
    return json.loads(said.strip().splitlines()[-1])


def run_section(name: str, seconds: float, path: Path, stand_in: bool) -> None:
    """Runs a section within so many seconds, and keeps how it ended."""
    record, begin = Record(path, name), time.monotonic()
    record.begin(read_json(path)["provenance"]["commit"])
    wanted = (name, str(seconds - GRACE_S), str(path), "yes" if stand_in else "no")
    process = start(*wanted, stderr=subprocess.PIPE, env=os.environ | (CHEAP if stand_in and name in SMALL else {}))
    try:
        _, complaints = process.communicate(timeout=seconds)
        state, reason = ("done", "") if process.returncode == 0 else ("failed", last_line(complaints, process.returncode))
    except subprocess.TimeoutExpired:
        state, reason = "cut", f"it took more than its {seconds:.0f} s"
    except BaseException:
        record.set_state("cut", reason="interrupted")
        raise
    finally:
        end(process)
    more: dict[str, Any] = {"reason": reason} if reason else {}
    record.set_state(state, seconds=round(time.monotonic() - begin, 1), **more)  # type: ignore[arg-type]


def last_line(complaints: str, code: int) -> str:
    """Returns the last line that a process said of its failure."""
    lines = [line for line in complaints.strip().splitlines() if not line.startswith((" ", "For simplicity", "---"))]
    return lines[-1] if lines else f"exit code {code}"


def whole(device: dict[str, Any], command: Command, path: Path) -> dict[str, Any]:
    """Returns a result file without the results of the sections that are about to run."""
    known = read_json(path)["sections"] if command.only and path.exists() else {}
    about = {"command": "python -m experiments.gpu_check", "minutes": command.minutes, "stand_in": device["platform"] == "cpu"}
    kept = {name: section for name, section in known.items() if name not in command.only}
    return about | {"device": device, "provenance": device.pop("environment"), "sections": kept}


def check(command: Command) -> None:
    """Runs all sections.

    Raises:
        UserError: parity does not hold.
    """
    deadline = time.monotonic() + 60 * command.minutes
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so that the section is ended too
    device = find_device()
    stand_in, path = device["platform"] == "cpu", command.out / f"gpu_check_{device['name']}.json"
    write_json(path, whole(device, command, path))
    if stand_in:
        there = ", although nvidia-smi is here: is the extra `cuda` installed?" if shutil.which("nvidia-smi") else ""
        say(f"JAX sees no GPU{there}: a stand-in on the CPU, with small sizes")
    for name in command.sections:
        if name in STAND_IN_ONLY and not stand_in:
            continue
        seconds = min(60 * command.minutes * SHARES[name], deadline - time.monotonic())
        if seconds < LEAST_S:
            Record(path, name).set_state("left out", reason="the time was up", figures={})
            continue
        say(f"{name}: at most {seconds:.0f} s")
        run_section(name, seconds, path, stand_in)
    close(path, command)


def close(path: Path, command: Command) -> None:
    """Says what there is and what there is not, in the file too."""
    result = read_json(path)
    missing, right = not_done(result["sections"]), parity_holds(result["sections"])
    write_json(path, result | {"parity_holds": right, "not_done": missing})
    for line in missing:
        say(f"not done: {line}")
    say(f"results: {path}")
    if "parity" in command.sections and not right:
        off = [name for name, case in result["sections"]["parity"]["figures"].items() if not case["holds"]]
        raise UserError(f"parity does not hold: {', '.join(off) or 'not everything was compared'}; see {path}")


def main() -> None:
    """Entry point."""
    check(tyro.cli(Command, prog="python -m experiments.gpu_check"))


if __name__ == "__main__":
    run_command(main)
