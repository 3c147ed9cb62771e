"""Time of the renderer, forward and with its gradient, by fused kernels and by XLA, and of its plan alone."""

import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from experiments.bench.scene import Scene, random_scene, temporary_gb
from experiments.bench.timing import Effort, interleaved
from experiments.gpu_check.record import Record, rounded
from wbgs_jax.splat import geometry_plan, render_splats
from wbgs_jax.splat.composite import GeometryPlan, assembled, blend_by_tiles, blend_by_tiles_backward

SIZES = ((2_000, 1), (10_000, 8), (20_000, 1), (35_000, 1), (70_000, 1), (70_000, 8))
"""Gaussians and queries."""
STAND_IN_SIZES = ((20, 2),)
EFFORT = Effort(repeats=9, budget_s=15.0)
STAND_IN_EFFORT = Effort(repeats=1, budget_s=0.0)


def measure(record: Record, deadline: float, stand_in: bool) -> bool:
    """Measures the sizes that are not known yet, until the deadline (of `time.monotonic`); returns whether all are known."""
    for n, b in STAND_IN_SIZES if stand_in else SIZES:
        name = f"n{n}_b{b}"
        if name in record.figures:
            continue
        if time.monotonic() > deadline:
            record.leave_out(name, "the time was up")
            continue
        record.add(name, row(random_scene(n, b, 0), b, STAND_IN_EFFORT if stand_in else EFFORT))
    return not record.read()["left_out"]


@jax.custom_vjp
def _blend_by_xla(own: Any, jobs: Any) -> Any:
    geometry, attenuation, signal = own
    return blend_by_tiles(geometry, attenuation, signal, jobs)


def _blend_by_xla_forward(own: Any, jobs: Any) -> Any:
    geometry, attenuation, signal = own
    image = blend_by_tiles(geometry, attenuation, signal, jobs)
    return image, (own, jobs, image)


def _blend_by_xla_backward(kept: Any, cotangent: Any) -> Any:
    (geometry, attenuation, signal), jobs, image = kept
    return blend_by_tiles_backward(geometry, attenuation, signal, jobs, image, cotangent), None


_blend_by_xla.defvjp(_blend_by_xla_forward, _blend_by_xla_backward)


def render_by_xla(plan: GeometryPlan, attenuation: Any, signal: Any) -> Any:
    """Returns what `render_splats` does, on every device by the form that CPUs have."""
    own = jnp.concatenate([plan.splats.means2d, plan.splats.conics], -1), attenuation, signal
    return assembled(_blend_by_xla(own, plan.jobs), plan.jobs.tiling)


RENDERERS = {"fused": render_splats, "xla": render_by_xla}
"""By kernels and by XLA alone. On a CPU the first has no kernels either."""


def row(scene: Scene, b: int, effort: Effort) -> dict[str, Any]:
    """Returns milliseconds of the plan, of plan and composite together (`whole`), and of the composite for a given plan.

    Gradients are those of a renderer's float inputs, their forward pass included. All calls take turns."""
    (gaussians, *features, cotangent), limits = scene.inputs(b), scene.limits
    plan = geometry_plan(gaussians, scene.receiver, limits)

    def plan_of(gaussians: Any) -> GeometryPlan:
        return geometry_plan(gaussians, scene.receiver, limits)

    calls: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {"plan": (plan_of, (gaussians,))}
    for form, render in RENDERERS.items():

        def whole(own: Any, render: Any = render) -> Any:
            return render(plan_of(own[0]), *own[1:])

        def alone(own: Any, jobs: Any, render: Any = render) -> Any:
            return render(GeometryPlan(own[0], jobs), *own[1:])

        both, given = (gaussians, *features), (plan.splats, *features)
        calls |= {
            f"whole_forward_{form}": (whole, (both,)),
            f"whole_gradient_{form}": (gradient_of(whole), (cotangent, both)),
            f"composite_forward_{form}": (alone, (given, plan.jobs)),
            f"composite_gradient_{form}": (gradient_of(alone), (cotangent, given, plan.jobs)),
        }
    compiled, temporaries, compile_s = dict[str, Callable[[], Any]](), dict[str, float](), dict[str, float]()
    for name, (function, own) in calls.items():
        begin = time.perf_counter()
        program = jax.jit(function).lower(*own).compile()
        compile_s[name] = round(time.perf_counter() - begin, 2)
        compiled[name], temporaries[name] = functools.partial(program, *own), rounded(temporary_gb(program))
    seconds = interleaved(compiled, effort)
    times = {name: spread(1e3 * sample) for name, sample in seconds.items()}
    sizes = {"jobs": int(plan.jobs.required_jobs), "capacity": scene.limits.jobs}
    return {"ms": times, "compile_s": compile_s, "temporaries_gb": temporaries} | sizes | most_memory()


def gradient_of(render: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the gradients of a renderer's first argument, given a cotangent of the image and the arguments."""

    def objective(own: Any, cotangent: Any, *others: Any) -> Any:
        return jnp.sum(render(own, *others) * cotangent)

    return lambda cotangent, own, *others: jax.grad(objective)(own, cotangent, *others)


def spread(sample: Any) -> dict[str, float]:
    """Returns median, minimum and maximum of a sample."""
    ordered = sorted(map(float, sample))
    return {"median": rounded(ordered[len(ordered) // 2]), "min": rounded(ordered[0]), "max": rounded(ordered[-1])}


def most_memory() -> dict[str, Any]:
    """Returns the most memory that the device has held since the process began (GB), where it counts that."""
    statistics = jax.devices()[0].memory_stats() or {}
    peak = statistics.get("peak_bytes_in_use")
    return {} if peak is None else {"peak_gb": rounded(peak / 1e9)}
