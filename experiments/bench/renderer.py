"""The tiled renderer beside its dense reference and PyTorch: forward and backward, memory, compilation.

A tiled call includes all of its geometry (projection, sorting, tile lists) and the gradients of all parameters. PyTorch is
given the splats, which spares it the projection, and the better number of threads. `ratio_torch` is against its
straightforward form, `ratio_torch_tuned` against the fastest (torch_tiles.py).
"""

import functools
import importlib.util
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.bench.scene import Scene, random_scene, temporary_gb
from experiments.bench.timing import Effort, Report, Seconds, interleaved
from wbgs_jax._util.cli import say
from wbgs_jax.splat import project

HAS_TORCH = importlib.util.find_spec("torch") is not None
OTHERS_LARGEST = 8
"""Queries that the others are given at most: they keep every (Gaussian, pixel, query), or take minutes."""
SHARED = 8
"""Queries that share a plan in the `sharing` figure."""


@dataclass(frozen=True)
class Size:
    """Size of a rendering, and the renderers that are timed besides the tiled one."""

    n: int
    batches: tuple[int, ...] = (1, 8, 32)
    dense: bool = False
    torch: bool = False

    def tag(self, b: int) -> str:
        """n2k_b8."""
        return f"n{self.n // 1000}k_b{b}" if self.n % 1000 == 0 else f"n{self.n}_b{b}"


SIZES = (Size(2000, dense=True, torch=True), Size(10_000, torch=True), Size(70_000))
QUICK_SIZE = Size(64, (2,), dense=True, torch=True)
MEMORY_SIZE = Size(70_000, (8,))
GPU_SIZE = Size(10_000, (64,))


class Competitor(NamedTuple):
    """Who is timed."""

    figure: str
    """Name of the figure, without its size."""
    b: int
    threads: int = 0
    """0: as many as it likes."""


RATIOS = {
    "ratio_dense": ("dense_fwd_bwd",),
    "ratio_torch": ("torch_tiles_fwd_bwd",),
    "ratio_torch_tuned": ("torch_groups_fwd_bwd", "torch_slots_fwd_bwd"),
}
"""Against whom; of several, the fastest."""


def without_torch() -> str:
    """Why PyTorch does not take part; empty if it does."""
    if jax.default_backend() != "cpu":
        return "PyTorch is compared with on the CPU only"
    return "" if HAS_TORCH else "PyTorch is not installed; its CPU build is enough (extra `bench`)"


def torch_calls(effort: Effort, scene: Scene, b: int) -> dict[Competitor, Callable[[], Any]]:
    """Every form of the PyTorch renderer with every number of threads."""
    import torch

    from experiments.bench import torch_tiles

    splats = torch_tiles.to_torch(project(scene.gaussians, scene.receiver))
    arrays = [torch.from_numpy(np.array(a)) for a in scene.inputs(b)[1:]]

    def call(form: str, threads: int) -> Any:
        torch.set_num_threads(threads)
        return torch_tiles.gradients(form, splats, *arrays)

    return {
        Competitor(f"torch_{form}_fwd_bwd", b, threads): functools.partial(call, form, threads)
        for form in torch_tiles.FORMS
        for threads in ([1] if effort.quick else sorted({1, 2, len(os.sched_getaffinity(0))}))
    }


def jax_calls(report: Report, effort: Effort, size: Size, scene: Scene, b: int) -> dict[Competitor, Callable[[], Any]]:
    """The tiled renderer, and the dense one where it fits."""
    inputs = scene.inputs(b)
    compiled = {
        "render_fwd": scene.lower_forward(scene.tiled, b).compile(),
        "render_fwd_bwd": scene.lower_gradient(scene.tiled, b).compile(),
    }
    if size.dense and b <= OTHERS_LARGEST:
        dense = scene.lower_gradient_one_by_one(scene.dense, b).compile()  # as fast as all at once
        if (needed := temporary_gb(dense)) > effort.memory_limit_gb:
            report.skip(f"dense_fwd_bwd_{size.tag(b)}", f"it needs {needed:.0f} GB")
        else:
            compiled["dense_fwd_bwd"] = dense
    return {Competitor(name, b): functools.partial(function, *inputs) for name, function in compiled.items()}


def fastest(seconds: dict[Competitor, Seconds], figures: tuple[str, ...], b: int) -> Seconds | None:
    """The times with the smallest median, of all numbers of threads."""
    found = [times for key, times in seconds.items() if key.figure in figures and key.b == b]
    return min(found, key=lambda times: float(np.median(times)), default=None)


def measure_size(report: Report, effort: Effort, size: Size) -> None:
    """All competitors and batches of a size, interleaved."""
    scene = random_scene(size.n, max(size.batches), effort.seed)
    calls: dict[Competitor, Callable[[], Any]] = {}
    for b in size.batches:
        calls |= jax_calls(report, effort, size, scene, b)
        if size.torch and b <= OTHERS_LARGEST and not without_torch():
            calls |= torch_calls(effort, scene, b)
    seconds = interleaved(calls, effort)
    for figure, b in dict.fromkeys((key.figure, key.b) for key in calls):
        if (times := fastest(seconds, (figure,), b)) is not None:
            report.add_time(f"{figure}_{size.tag(b)}", times)
        else:
            report.skip(f"{figure}_{size.tag(b)}", f"a call takes more than {effort.call_limit_s:.0f} s")
    add_ratios(report, size, seconds)


def add_ratios(report: Report, size: Size, seconds: dict[Competitor, Seconds]) -> None:
    """Adds the speed-up of the tiled renderer over the others, round by round, and the gain from sharing a plan."""
    for b in size.batches:
        own = fastest(seconds, ("render_fwd_bwd",), b)
        for ratio, figures in RATIOS.items():
            other = fastest(seconds, figures, b)
            if own is not None and other is not None:
                report.add_sample(f"{ratio}_{size.tag(b)}", other / own, "x", "higher")
    alone, shared = (fastest(seconds, ("render_fwd_bwd",), b) for b in (1, SHARED))
    if alone is not None and shared is not None:
        report.add_sample(f"sharing_{size.tag(SHARED)}", SHARED * alone / shared, "x", "higher")


def measure(report: Report, effort: Effort) -> None:
    """Times and ratios of all sizes."""
    if reason := without_torch():
        report.skip("ratio_torch", reason)
    for size in [QUICK_SIZE] if effort.quick else SIZES:
        say(f"renderer: {size.n} Gaussians, batches of {', '.join(map(str, size.batches))}")
        measure_size(report, effort, size)
    if jax.default_backend() == "gpu" and not effort.quick:
        measure_throughput(report, effort, GPU_SIZE)


def measure_throughput(report: Report, effort: Effort, size: Size) -> None:
    """Spectra a second of a large batch, forward."""
    (b,) = size.batches
    scene = random_scene(size.n, b, effort.seed)
    forward = functools.partial(scene.lower_forward(scene.tiled, b).compile(), *scene.inputs(b))
    seconds = interleaved({"forward": forward}, effort)["forward"]
    report.add_sample(f"pas_per_s_{size.tag(b)}", b / seconds, "1/s", "higher")


def measure_memory(report: Report, effort: Effort) -> None:
    """Temporaries and compilation of forward and backward at the largest size."""
    size = QUICK_SIZE if effort.quick else MEMORY_SIZE
    b = max(size.batches)
    say(f"memory: {size.n} Gaussians, batches of {b}")
    scene = random_scene(size.n, b, effort.seed)
    begin = time.perf_counter()
    compiled = scene.lower_gradient(scene.tiled, b).compile()
    report.add(f"compile_s_{size.tag(b)}", time.perf_counter() - begin, "s", "lower")
    report.add(f"temp_gb_{size.tag(b)}", temporary_gb(compiled), "GB", "lower")
