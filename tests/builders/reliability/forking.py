"""A process that has imported everything and computed nothing: it forks a fresh process for every piece of work.

Importing takes seconds and JAX must not be forked once it runs; so this one imports, and only its children compute. It reads a
line of JSON for every piece of work, and answers with one.
"""

import json
import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from dataclasses import asdict, dataclass
from pathlib import Path

from builders import PYTHONPATH
from builders.reliability.faults import Counter, Fault, install

MOST_CPU_S, LONGEST_S = 300, 3600.0
"""Of a piece of work: processor time, and time on a busy machine."""


@dataclass(frozen=True)
class Ended:
    """How a piece of work ended."""

    code: int
    """Exit code, or minus the signal that ended it."""
    writes: int
    """Writes that were counted."""
    seconds: float
    out: str
    err: str

    @property
    def killed(self) -> bool:
        return self.code == -signal.SIGKILL


class Forks:
    """The other end: asks the process for work."""

    def __init__(self) -> None:
        environment = os.environ | {
            "JAX_PLATFORMS": "cpu",
            "PYTHONPATH": PYTHONPATH,
            "WBGS_CACHE": "",
            "TF_CPP_MIN_LOG_LEVEL": "3",
        }
        command = [sys.executable, __file__]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)

    def run(self, work: str, folder: Path, fault: Fault | None = None) -> Ended:
        """Runs a piece of work, one of `works.WORKS`, in a folder, which is where its faults happen."""
        assert self.process.stdin is not None and self.process.stdout is not None
        asked = {"work": work, "folder": str(folder), "fault": asdict(fault or Fault())}
        self.process.stdin.write(json.dumps(asked) + "\n")
        self.process.stdin.flush()
        return Ended(**json.loads(self.process.stdout.readline()))

    def close(self) -> None:
        """Ends the process; of work that somebody stopped too."""
        self.process.kill()
        self.process.wait()


def _child(work: str, folder: Path, fault: Fault, counter: Counter) -> None:
    from builders.reliability.works import WORKS
    from wbgs_jax._util.cli import run_command

    os.setsid()
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU_S, MOST_CPU_S))
    for number in (1, 2):
        os.dup2(os.open(f"{folder}.{('out', 'err')[number - 1]}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    os.chdir(folder)
    code = 0
    try:
        install(fault, str(folder), counter)
        run_command(lambda: WORKS[work](folder))
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _wait(child: int, fault: Fault, begin: float) -> int:
    sent = False
    while True:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        passed = time.monotonic() - begin
        if (fault.after_s and passed >= fault.after_s and not sent) or passed > LONGEST_S:
            os.kill(child, signal.SIGKILL if passed > LONGEST_S else fault.signal)
            sent = True
        time.sleep(0.002)


def serve() -> None:
    """Answers until its input ends."""
    from builders.reliability import works

    works.warm()
    for line in sys.stdin:
        asked = json.loads(line)
        fault, folder, counter = Fault(**asked["fault"]), Path(asked["folder"]), Counter()
        begin = time.monotonic()
        child = os.fork()
        if child == 0:
            _child(asked["work"], folder, fault, counter)
        code = _wait(child, fault, begin)
        words = {name: Path(f"{folder}.{name}").read_text(errors="replace")[-20_000:] for name in ("out", "err")}
        print(json.dumps(asdict(Ended(code, counter.value, time.monotonic() - begin, **words))), flush=True)


if __name__ == "__main__":
    serve()
