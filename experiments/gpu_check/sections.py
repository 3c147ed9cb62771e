"""The sections of a check, each run in a process of its own: what crashes, hangs or runs out of memory spoils no other."""

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from experiments.bench import queries
from experiments.bench.timing import Effort, Report
from experiments.gpu_check import compiled, parity, renderer, training
from experiments.gpu_check.record import Record
from wbgs_jax._util.command import run_command
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax.evaluation.report import device_name, environment


def measure_queries(record: Record, deadline: float, quick: bool) -> None:
    """Measures answers of a field of the device's preset, as `make bench ARGS="--only queries"` does."""
    report = Report()
    queries.measure(report, Effort(repeats=3, quick=quick, budget_s=10.0))
    for name, metric in report.metrics.items():
        record.add(name, {key: metric[key] for key in ("value", "unit", "spread")})


MEASURES: dict[str, Callable[[Record, float, bool], None]] = {
    "parity": parity.measure,
    "renderer": renderer.measure,
    "coherent": training.measure_coherent,
    "queries": measure_queries,
    "compiled": compiled.measure,
    "paper": training.measure_paper,
}
"""Of (record, deadline of `time.monotonic`, stand-in)."""


def device() -> dict[str, Any]:
    """Returns what JAX runs on here, and what a result file says of it."""
    found = jax.devices()[0]
    statistics = found.memory_stats() or {}
    memory = {"memory_gb": round(statistics["bytes_limit"] / 1e9, 1)} if "bytes_limit" in statistics else {}
    host = {"cores": len(os.sched_getaffinity(0)), "load": round(os.getloadavg()[0], 1)}
    return {"name": device_name(), "platform": found.platform, "environment": environment()} | memory | host


def main() -> None:
    """Runs one section: NAME SECONDS FILE STAND_IN; or says what device there is: device."""
    if sys.argv[1:] == ["device"]:
        print(json.dumps(device()))
        return
    name, seconds, path, stand_in = sys.argv[1:]
    deadline = time.monotonic() + float(seconds)
    use_compilation_cache()
    MEASURES[name](Record(Path(path), name), deadline, stand_in == "yes")
    sys.stderr.flush()
    os._exit(0)  # threads that still compile are not waited for


if __name__ == "__main__":
    run_command(main)
