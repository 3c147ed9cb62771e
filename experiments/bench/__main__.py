"""Measure rendering, gradients, a training step and queries on this machine.

Competitors run interleaved in one process and the figures that matter are ratios; absolute times belong to the device named
in the file. Writes experiments/results/bench_<device>.json.
"""

import dataclasses
import functools
import os
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from wbgs_jax import (
    Gaussians,
    WidebandConfig,
    geometry_plan,
    image_loss,
    make_query,
    make_receiver,
    measure_capacity,
    project,
    render_dense,
    render_splats,
    surface_from_points,
    wideband,
)
from wbgs_jax.errors import run_command
from wbgs_jax.eval import device_name, environment
from wbgs_jax.files import write_json

RESULTS = Path(__file__).parents[1] / "results"


@dataclasses.dataclass(frozen=True)
class Command:
    """Measure this machine."""

    repeats: int = 9
    """Timed calls of every competitor, after compilation."""
    out: Path = RESULTS
    """Folder of the result file."""
    seed: int = 0


def interleaved(competitors: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, list[float]]:
    """Seconds of every call; the competitors take turns so that a busy moment hits all of them."""
    for call in competitors.values():
        jax.block_until_ready(call())
    seconds: dict[str, list[float]] = {name: [] for name in competitors}
    for _ in range(repeats):
        for name, call in competitors.items():
            jax.block_until_ready(call())  # untimed: pays for the memory that the competitor before it gives back
            begin = time.perf_counter()
            jax.block_until_ready(call())
            seconds[name].append(time.perf_counter() - begin)
    return seconds


def metric(value: float, unit: str, direction: str, spread: float = 0.0) -> dict[str, Any]:
    """One figure; `direction` says whether "lower" or "higher" is better, `spread` is the interquartile range."""
    return {"value": float(f"{value:.4g}"), "unit": unit, "direction": direction, "spread": float(f"{spread:.3g}")}


def timing(seconds: list[float], scale: float, unit: str) -> dict[str, Any]:
    """Median and interquartile range of timings."""
    low, _, high = statistics.quantiles(seconds, n=4)
    return metric(statistics.median(seconds) * scale, unit, "lower", (high - low) * scale)


def random_gaussians(rng: np.random.Generator, n: int) -> Gaussians:
    """Directions even over the hemisphere, footprints of 2-10 degrees (3 sigma), distances of 1-6 m."""
    cosine, azimuth, distance = rng.uniform(0, 1, n), rng.uniform(-np.pi, np.pi, n), rng.uniform(1, 6, n)
    sine = np.sqrt(1 - cosine**2)
    means = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], -1) * distance[:, None]
    sigma = np.deg2rad(rng.uniform(2, 10, n)) / 3 * distance
    log_scales = np.log(sigma[:, None] * rng.uniform(0.6, 1.4, (n, 3)))
    arrays = (means, log_scales, rng.normal(size=(n, 4)), np.zeros(n), np.ones(n))
    return Gaussians(*(jnp.asarray(a, jnp.float32) for a in arrays))


def bench_renderer(rng: np.random.Generator, n: int, b: int, repeats: int, dense: bool) -> dict[str, Any]:
    """Forward + backward of the tiled renderer, and of its dense reference where that is bearable."""
    gaussians, receiver = random_gaussians(rng, n), make_receiver([0.0, 0.0, 0.0])
    attenuation, signal = (jnp.asarray(rng.uniform(0, 0.6, (n, b)), jnp.float32) for _ in range(2))
    cotangent = jnp.asarray(rng.normal(size=(b, 90, 360)), jnp.float32)
    capacity = measure_capacity(project(gaussians, receiver), 1.05)

    def tiled(g, a, s):
        return jnp.sum(render_splats(geometry_plan(g, receiver, capacity), a, s) * cotangent)

    def reference(g, a, s):
        return jnp.sum(render_dense(project(g, receiver), a, s) * cotangent)

    gradients = {"tiled": jax.jit(jax.grad(tiled, argnums=(0, 1, 2)))}
    if dense:
        gradients["dense"] = jax.jit(jax.grad(reference, argnums=(0, 1, 2)))
    calls = {name: functools.partial(f, gaussians, attenuation, signal) for name, f in gradients.items()}
    seconds = interleaved(calls, repeats)
    tag = f"n{n // 1000}k_b{b}"
    result = {f"render_fwd_bwd_{tag}": timing(seconds["tiled"], 1e3, "ms")}
    if dense:
        ratio = [d / t for d, t in zip(seconds["dense"], seconds["tiled"], strict=True)]
        low, middle, high = statistics.quantiles(ratio, n=4)
        result[f"ratio_dense_{tag}"] = metric(middle, "x", "higher", high - low)
    return result


def bench_field(rng: np.random.Generator, repeats: int, b: int = 8) -> dict[str, Any]:
    """The `cpu` preset's field: gradient of the training loss, and queries answered a second with the geometry folded in."""
    points = rng.uniform(-4, 4, (2000, 3)) * np.array([1, 1, 0.4])
    surface = surface_from_points(points)
    params = wideband.init(jax.random.key(0), surface, WidebandConfig())
    receiver = make_receiver([0.0, 0.0, 0.0])
    capacity = measure_capacity(project(params.gaussians, receiver))
    truth = jnp.asarray(rng.random((b, 90, 360)), jnp.float32)

    def query(size: int):
        return make_query(rng.uniform(-3, 3, (size, 3)), rng.uniform(1e9, 1e11, size))

    def objective(params, query):
        return image_loss(wideband.render(params, wideband.plan(params, receiver, capacity), query), truth)[0]

    plan, render, gradient = wideband.plan(params, receiver), jax.jit(wideband.render), jax.jit(jax.grad(objective))
    batch, block, single = query(b), query(64), query(1)
    seconds = interleaved(
        {
            "step": lambda: gradient(params, batch),
            "block": lambda: render(params, plan, block),
            "single": lambda: render(params, plan, single),
        },
        repeats,
    )
    return {
        f"loss_gradient_cpu_preset_b{b}": timing(seconds["step"], 1e3, "ms"),
        "queries_per_s": metric(64 / statistics.median(seconds["block"]), "1/s", "higher"),
        "single_query": timing(seconds["single"], 1e3, "ms"),
    }


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.bench")
    rng = np.random.default_rng(command.seed)
    metrics: dict[str, Any] = {}
    for n, b, dense in ((2000, 1, True), (2000, 8, True), (10_000, 8, False)):
        print(f"renderer, {n} Gaussians, {b} queries ...", file=sys.stderr, flush=True)
        metrics |= bench_renderer(rng, n, b, command.repeats, dense)
    print("field of the cpu preset ...", file=sys.stderr, flush=True)
    metrics |= bench_field(rng, command.repeats)
    environment_ = environment() | {"cores": len(os.sched_getaffinity(0)), "repeats": command.repeats, "seed": command.seed}
    path = command.out / f"bench_{device_name()}.json"
    write_json(path, {"metrics": metrics, "environment": environment_})
    for name, m in metrics.items():
        print(f"{name:32} {m['value']:>10} {m['unit']:4} +- {m['spread']}")
    print(path)


if __name__ == "__main__":
    run_command(main)
