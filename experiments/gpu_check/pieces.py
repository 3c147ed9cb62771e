"""The pieces of a check, each run in a process of its own: what crashes, hangs or runs out of memory spoils no other."""

import json
import os
import platform
import signal
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from experiments.bench.quality import compilations
from experiments.gpu_check import parity, renderer, training
from experiments.gpu_check.record import PART, TRAININGS, Record
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax.evaluation.report import device_name, environment
from wbgs_jax.training.progress import Interrupted

MEASURES: dict[str, Callable[[Record, float, bool], bool]] = {"parity": parity.measure, "renderer": renderer.measure}
"""(record, deadline of `time.monotonic`, stand-in) -> whether all of it is done."""


def device() -> dict[str, Any]:
    """Returns what JAX runs on here, and the provenance of a result file."""
    found = jax.devices()[0]
    statistics = found.memory_stats() or {}
    memory = {"memory_gb": round(statistics["bytes_limit"] / 1e9, 1)} if "bytes_limit" in statistics else {}
    host = {"cores": len(os.sched_getaffinity(0)), "load": round(os.getloadavg()[0], 1)}
    versions = {"jaxlib": version("jaxlib"), "python": platform.python_version()}
    return {"name": device_name(), "platform": found.platform, "environment": environment() | versions} | memory | host


def run(name: str, record: Record, deadline: float, stand_in: bool, folder: Path) -> bool:
    """Runs a piece until it is done or its time is up, and returns whether it is done."""
    compiled: list[tuple[str, float]] = []
    try:
        with compilations(compiled):
            if name in TRAININGS:
                return training.train_and_score(name, record, stand_in, folder)
            return MEASURES[name](record, deadline, stand_in)
    except (Interrupted, KeyboardInterrupt):
        return False
    finally:
        taken = {"programs": len(compiled), "seconds": round(sum(seconds for _, seconds in compiled), 1)}
        record.describe_call(compilations=taken, **renderer.most_memory())


def main() -> None:
    """Runs one piece: NAME SECONDS FILE STAND_IN FOLDER; or prints which device there is: device."""
    if sys.argv[1:] == ["device"]:
        print(json.dumps(device()))
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it otherwise
    name, seconds, path, stand_in, folder = sys.argv[1:]
    deadline = time.monotonic() + float(seconds)
    if name != "renderer":  # which measures compilation
        use_compilation_cache()
    done = run(name, Record(Path(path)), deadline, stand_in == "yes", Path(folder))
    sys.stderr.flush()
    os._exit(0 if done else PART)  # threads that still compile are not waited for


if __name__ == "__main__":
    run_command(main)
