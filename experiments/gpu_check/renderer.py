"""What the renderer takes: time and memory, forward and backward, by the numbers of Gaussians and queries."""

import functools
import time
from typing import Any

import jax

from experiments.bench.renderer import GPU_SIZE
from experiments.bench.scene import random_scene, temporary_gb
from experiments.bench.timing import Effort, interleaved
from experiments.gpu_check.record import Record, rounded

GAUSSIANS, QUERIES = (2_000, 10_000, 30_000, 70_000), (1, 8, 32)
STAND_IN_GAUSSIANS, STAND_IN_QUERIES = (500, 2_000), (1, 8)
REPEATS = 5


def measure(record: Record, deadline: float, quick: bool) -> None:
    """Measures all sizes, small ones first, until the deadline (of `time.monotonic`); then spectra a second."""
    for n in STAND_IN_GAUSSIANS if quick else GAUSSIANS:
        for b in STAND_IN_QUERIES if quick else QUERIES:
            if time.monotonic() > deadline:
                record.leave_out(f"n{n}_b{b}", "the time was up")
                continue
            record.add(f"n{n}_b{b}", row(n, b))
    if not quick and time.monotonic() < deadline:
        record.add("spectra_per_s", throughput(GPU_SIZE.n, max(GPU_SIZE.batches)))


def row(n: int, b: int) -> dict[str, float]:
    """Returns what N Gaussians and B queries take, geometry included."""
    scene = random_scene(n, b, 0)
    begin = time.perf_counter()
    forward = scene.lower_forward(scene.tiled, b).compile()
    both = scene.lower_gradient(scene.tiled, b).compile()
    compiled = time.perf_counter() - begin
    calls = {name: functools.partial(call, *scene.inputs(b)) for name, call in {"forward": forward, "both": both}.items()}
    seconds = interleaved(calls, Effort(repeats=REPEATS, budget_s=10.0))
    times = {f"{name}_ms": rounded(1e3 * float(sorted(own)[len(own) // 2])) for name, own in seconds.items()}
    memory = {"temporaries_gb": rounded(temporary_gb(both)), "jobs": scene.limits.jobs}
    return times | memory | {"compile_s": round(compiled, 1)} | most_memory()


def throughput(n: int, b: int) -> dict[str, float]:
    """Returns spectra a second of a large batch, forward."""
    scene = random_scene(n, b, 0)
    call = functools.partial(scene.lower_forward(scene.tiled, b).compile(), *scene.inputs(b))
    seconds = interleaved({"forward": call}, Effort(repeats=REPEATS, budget_s=10.0))["forward"]
    return {"gaussians": n, "batch": b, "spectra_per_s": rounded(b / float(sorted(seconds)[len(seconds) // 2]))}


def most_memory() -> dict[str, Any]:
    """Returns the most memory that the device has held since the process began (GB), where it counts that."""
    statistics = jax.devices()[0].memory_stats() or {}
    peak = statistics.get("peak_bytes_in_use")
    return {} if peak is None else {"peak_gb": rounded(peak / 1e9)}
