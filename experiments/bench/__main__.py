"""Measure this machine: renderer, training, queries, memory, time to quality.

    python -m experiments.bench [--only renderer training queries rays facets memory quality]
        [--quick] [--gate] [--update]

Competitors run interleaved in one process; the figures that compare machines are ratios, absolute times belong to the device
named in the file. A whole run writes experiments/results/bench_<device>.json, the baseline of the next one. A run of some
parts, a quick one and a gated one change it only with --update.
"""

import dataclasses
import importlib.metadata
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import tyro
from rich.console import Console

from experiments.bench import gate, quality, queries, rays, renderer, training
from experiments.bench.timing import Effort, Report
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_json, write_json
from wbgs_jax.evaluation.report import device_name, environment

RESULTS = Path(__file__).parents[1] / "results"
OF_A_PART = ("commit", "version", "jax", "cores", "load", "torch", "repeats")
"""Conditions of a part's figures besides the device: other parts may have been measured on another day."""
Part = Literal["renderer", "training", "queries", "rays", "facets", "memory", "quality"]
PARTS: dict[Part, Callable[[Report, Effort], None]] = {
    "renderer": renderer.measure,
    "training": training.measure,
    "queries": queries.measure,
    "rays": rays.measure,
    "facets": rays.measure_facets,
    "memory": renderer.measure_memory,
    "quality": quality.measure,
}


@dataclasses.dataclass(frozen=True)
class Command:
    """Measure this machine and compare with the last committed figures of the same device."""

    only: tuple[Part, ...] = ()
    """Parts to measure; all by default."""
    quick: bool = False
    """Tiny sizes: does the suite work? The figures mean nothing."""
    gate: bool = False
    """Fail (exit code 2) if a ratio is worse than the baseline's by more than its tolerance; leaves the baseline alone."""
    update: bool = False
    """Write the result file in any case; figures of parts that were not measured stay."""
    repeats: int = 9
    """Rounds of timed calls of every competitor, after compilation."""
    seed: int = 0
    out: Path = RESULTS
    """Folder of the result file."""

    @property
    def writes(self) -> bool:
        """Whether the result becomes the baseline."""
        return self.update or not (self.gate or self.quick or self.only)


def measure(command: Command) -> dict[str, Any]:
    """Returns {metrics, environment} of the requested parts."""
    effort = Effort(repeats=2 if command.quick else command.repeats, seed=command.seed, quick=command.quick)
    here = environment() | machine() | {"preset": training.preset(effort)} | dataclasses.asdict(effort)
    metrics: gate.Metrics = {}
    parts: dict[str, Any] = {}
    for name in command.only or PARTS:
        report, begin = Report(), time.perf_counter()
        PARTS[name](report, effort)
        metrics |= report.metrics
        spent = {"seconds": round(time.perf_counter() - begin), "skipped": report.skipped}
        parts[name] = {key: here[key] for key in OF_A_PART} | spent
    return {"metrics": metrics, "environment": here | {"parts": parts}}


def machine() -> dict[str, Any]:
    """Returns further conditions on which times depend."""
    torch = importlib.metadata.version("torch") if renderer.HAS_TORCH else None
    return {"cores": len(os.sched_getaffinity(0)), "load": round(os.getloadavg()[0], 2), "torch": torch}


def bench(command: Command) -> None:
    """Measure, compare, write, and close the gate."""
    path = command.out / f"bench_{device_name()}.json"
    baseline = read_json(path) if path.exists() else None
    if command.gate and baseline is None:
        raise UserError(f"there is no baseline {path} to compare with; make one with `make bench`")
    jax.config.update("jax_enable_compilation_cache", False)  # compilation is part of what is measured
    result = measure(command)
    known = baseline["metrics"] if baseline else {}
    Console(width=None if sys.stdout.isatty() else 140).print(gate.table(result["metrics"], known))
    if command.writes:
        write_json(path, gate.merge(result, baseline) if command.only and baseline else result)
        say(f"results: {path}")
    if command.gate:
        gate.check(result["metrics"], known)


def main() -> None:
    """Entry point."""
    bench(tyro.cli(Command, prog="python -m experiments.bench"))


if __name__ == "__main__":
    run_command(main)
