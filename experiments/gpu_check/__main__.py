"""Check a GPU in pieces of at most eight minutes each, every one of which continues where an earlier call of it ended.

    python -m experiments.gpu_check [--minutes 8] [--next | --only paper_scene1] [--list] [--out folder] [--runs folder]

`parity` compares values and gradients with the CPU; `renderer` is a table of times; the others train the paper's form, WRF-GS
and the default field to the last step, and score them on all test transmitters (training.py). By default all pieces that are
not done run, one after another; `--next` runs the first that is missing or part. Each has a result file with its provenance,
experiments/results/gpu/<piece>_<device>.json, which is whole after every figure, and a training has its checkpoints in
runs/gpu/<piece>: take both along to continue on another machine. The exit code is 2 where parity does not hold.

Without a GPU a stand-in runs: tiny sizes, the kernels interpreted, and results beside the checkpoints.
"""

# Nothing here may touch JAX: the pieces, one process after the other, need all of the device's memory.
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
from typing import Any

import tyro

from experiments.gpu_check import progress
from experiments.gpu_check.record import PART, PIECES, TRAININGS, Name, State, begin, parity_holds
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_json

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "experiments" / "results" / "gpu"
RUNS = ROOT / "runs" / "gpu"
CHEAP = {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"}
"""Environment of the stand-in, which computes next to nothing: optimisation takes half of the compile time."""
MODULE = "experiments.gpu_check.pieces"
START_S = 60.0
"""Seconds that finding the device may take."""
GRACE_S = 45.0
"""A piece is interrupted so long before its process is ended: a program may have to be compiled until an epoch is over."""
INTERRUPTED = 130
"""Exit code of a piece that another call continues, beside `PART`."""


@dataclass(frozen=True)
class Command:
    """Check the GPU of this machine, piece by piece, or what can be checked without one."""

    minutes: float = 8.0
    """The most that a piece takes in this call."""
    only: tuple[Name, ...] = ()
    """These pieces, done or not: what is done is measured anew, and what is trained scored anew."""
    next: bool = False
    """The first piece that is missing or part, and no other."""
    list: bool = False
    """Print the pieces and how they stand, and run none."""
    out: Path | None = None
    """Folder of the result files; by default experiments/results/gpu, without a GPU RUNS/stand_in/results."""
    runs: Path = RUNS
    """Folder of checkpoints and logs."""


@dataclass(frozen=True)
class Check:
    """A device, and the folders of results and of checkpoints."""

    device: dict[str, Any]
    out: Path
    runs: Path

    @property
    def stand_in(self) -> bool:
        """Whether there is no GPU."""
        return self.device["platform"] == "cpu"

    def path(self, name: str) -> Path:
        """Returns the result file of a piece."""
        return self.out / f"{name}_{self.device['name']}.json"

    def found(self, name: str) -> Path | None:
        """Returns the result file that there is: a training counts wherever it ran, since its checkpoints are carried along."""
        own = self.path(name)
        others = sorted(self.out.glob(f"{name}_*.json")) if name in TRAININGS else []
        same = [path for path in others if read_json(path)["stand_in"] == self.stand_in]
        return own if own.exists() else next(iter(same), None)

    def state(self, name: str) -> State | None:
        """Returns how a piece stands; None if it is missing."""
        path = self.found(name)
        state = read_json(path)["state"] if path else None
        return "part" if state == "running" else state

    def earlier(self, name: str) -> dict[str, Any] | None:
        """Returns the result that a call of a piece continues: a measurement only if the same code made it; of a training that
        was done or has failed, its calls."""
        path, state = self.found(name), self.state(name)
        if path is None:
            return None
        result = read_json(path)
        if name in TRAININGS:
            return result if state == "part" else result | {"figures": {}}
        return result if state == "part" and result["provenance"] == self.device["environment"] else None

    def line(self, name: str) -> str:
        """Returns a line that shows how a piece stands."""
        path = self.found(name)
        if path is None:
            return f"{name}: missing"
        result = read_json(path)
        training = result["figures"].get("training", {})
        steps = f", step {training.get('steps', 0)} of {training['of']}" if "of" in training else ""
        reason = f", {result['reason']}" if result["reason"] else ""
        return f"{name}: {self.state(name)}{steps}, {result['seconds']:.0f} s in {len(result['calls'])} calls{reason}"


def start(*arguments: str, **options: Any) -> subprocess.Popen[str]:
    """Starts the module of the pieces in a process group of its own."""
    command = [sys.executable, "-m", MODULE, *arguments]
    return subprocess.Popen(command, cwd=ROOT, text=True, start_new_session=True, **options)


def end(process: subprocess.Popen[str]) -> None:
    """Ends a process and all that it started; files are whole or absent, so nothing is lost."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def find_device() -> dict[str, Any]:
    """Returns the device of `pieces.device`.

    Raises:
        UserError: JAX does not start here.
    """
    process = start("device", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        printed, complaints = process.communicate(timeout=START_S)
    except subprocess.TimeoutExpired:
        end(process)
        raise UserError(f"JAX found no device within {START_S:.0f} s; look at `nvidia-smi` and JAX_PLATFORMS") from None
    if process.returncode:
        last = (complaints.strip().splitlines() or ["no reason given"])[-1]
        raise UserError(f"JAX does not start here: {last}")
    return json.loads(printed.strip().splitlines()[-1])


def run_piece(check: Check, name: str, seconds: float) -> None:
    """Runs a piece for so many seconds at most, and keeps how it ended."""
    earlier, inherited = check.earlier(name), check.found(name)
    record, folder, started = begin(check.path(name), name, check.device, earlier), check.runs / name, time.monotonic()
    if inherited not in (None, record.path):
        inherited.unlink()  # begun on another device: it continues under the name of this one
    log = check.runs / f"{name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    grace = min(GRACE_S, seconds / 2)
    arguments = (name, str(seconds - grace), str(record.path), "yes" if check.stand_in else "no", str(folder))
    state: State = "part"
    reason = "interrupted"
    with log.open("w") as stream:
        process = start(*arguments, stderr=stream, env=os.environ | (CHEAP if check.stand_in else {}))
        try:
            code = wait(process, seconds - grace, grace)
            state, reason = ending(code, log.read_text(errors="replace"))
        except BaseException:
            interrupt(process, grace)
            raise
        finally:
            end(process)
            if name in TRAININGS:
                record.add("training", progress.figures_of(folder))
            record.finish(state, time.monotonic() - started, reason)


def wait(process: subprocess.Popen[str], seconds: float, grace: float) -> int | None:
    """Returns the exit code of a process that is interrupted after so many seconds; None if it goes on after the grace."""
    try:
        return process.wait(seconds)
    except subprocess.TimeoutExpired:
        return interrupt(process, grace)


def interrupt(process: subprocess.Popen[str], grace: float) -> int | None:
    """Interrupts a process as Ctrl-C does, and returns its exit code; None if it goes on after the grace."""
    with contextlib.suppress(ProcessLookupError):
        process.send_signal(signal.SIGINT)
    with contextlib.suppress(subprocess.TimeoutExpired):
        return process.wait(grace)
    return None


def ending(code: int | None, log: str) -> tuple[State, str]:
    """Returns the state of a piece by the exit code of its process, and the reason of a state that is not `done`."""
    if code == 0:
        return "done", ""
    if code in (PART, INTERRUPTED, -signal.SIGINT, None):
        return "part", "the time was up"
    lines = [line for line in log.strip().splitlines() if not line.startswith((" ", "For simplicity", "---"))]
    return "failed", lines[-1] if lines else f"exit code {code}"


def chosen(check: Check, command: Command) -> list[str]:
    """Returns the pieces to run, in their order."""
    if command.only:
        return [name for name in PIECES if name in command.only]
    if command.next:
        return [name for name in PIECES if check.state(name) in (None, "part")][:1]
    return [name for name in PIECES if check.state(name) != "done"]


def make_check(device: dict[str, Any], command: Command) -> Check:
    """Returns the folders for a device: a stand-in has its own, so that nothing of it is taken for a GPU's."""
    if device["platform"] != "cpu":
        return Check(device, (command.out or RESULTS).resolve(), command.runs.resolve())
    runs = command.runs.resolve() / "stand_in"
    return Check(device, (command.out or runs / "results").resolve(), runs)


def run(command: Command) -> None:
    """Runs the pieces that are wanted.

    Raises:
        UserError: parity does not hold.
    """
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so that the piece is ended too
    device = find_device()
    check = make_check(device, command)
    if check.stand_in:
        there = ", although nvidia-smi is here: is the extra `cuda` installed?" if shutil.which("nvidia-smi") else ""
        say(f"JAX sees no GPU{there}: a stand-in on the CPU, with small sizes")
    names = [] if command.list else chosen(check, command)
    for name in names:
        say(f"{name}: at most {60 * command.minutes:.0f} s; its progress is in {check.runs / name}.log")
        run_piece(check, name, 60 * command.minutes)
        say(check.line(name))
    if not names:
        print("\n".join(check.line(name) for name in PIECES))
    if "parity" in names:
        demand_parity(check.path("parity"))


def demand_parity(path: Path) -> None:
    """Raises a `UserError` unless parity holds."""
    result = read_json(path)
    if not parity_holds(result):
        cases = result["figures"].get("cases", {})
        off = [name for name, case in cases.items() if not case["holds"]]
        raise UserError(f"parity does not hold: {', '.join(off) or 'not everything was compared'}; see {path}")


def main() -> None:
    """Entry point."""
    run(tyro.cli(Command, prog="python -m experiments.gpu_check"))


if __name__ == "__main__":
    run_command(main)
