"""A whole training step through the trainer itself, and what its parts cost.

Parts are jitted alone, in a loop: as in an epoch, fresh memory is paid for once, not in every turn (it doubles the time of
some). `backward` is the gradient less the forward pass, `rest` what the step takes beyond gradient and optimiser.
"""

import functools
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import optax

from experiments.bench.timing import Effort, Report, interleaved
from experiments.profiles import TINY
from wbgs_jax._util.cli import say
from wbgs_jax.commands.train import default_preset
from wbgs_jax.config import Settings, changed
from wbgs_jax.data import load_dataset
from wbgs_jax.data.dataset import hold_out_validation
from wbgs_jax.fields import get_field, wideband
from wbgs_jax.fields.losses import image_loss
from wbgs_jax.splat import GeometryPlan, geometry_plan, render_splats
from wbgs_jax.training.batches import limited
from wbgs_jax.training.hooks import probe_of
from wbgs_jax.training.loop import Run
from wbgs_jax.training.step import loss_and_gradients

FIELD = "wideband"
STEPS = 10
"""Steps of one timed block."""


def preset(effort: Effort) -> str:
    """The preset that is measured on this device."""
    return "smoke" if effort.quick else default_preset()


def settings(effort: Effort) -> Settings:
    """Returns the settings of that preset, with a tiny field where the figures mean nothing."""
    chosen = get_field(FIELD).presets[preset(effort)]
    return changed(chosen, {"field": TINY, "loop": {"epoch_steps": 2}}) if effort.quick else chosen


def start_run(effort: Effort, folder: Path, epoch_steps: int | None = None) -> Run:
    """A training of scene 1 before its first step."""
    dataset = hold_out_validation(load_dataset(1))
    chosen = limited(settings(effort), dataset, get_field(FIELD))
    if epoch_steps:
        chosen = changed(chosen, {"loop": {"epoch_steps": epoch_steps}})
    return Run(dataset, FIELD, chosen, effort.seed, folder)


def parts(run: Run, turns: int) -> dict[str, Callable[[], Any]]:
    """The parts of a step as separate calls, on a copy of the run's state (the trainer gives its own away)."""
    state, data = jax.tree.map(jnp.copy, run.state), run.data
    field: Any = run.field
    params, receiver, weight = state.params, run.dataset.receiver(), run.settings.field.ssim_weight
    index = jnp.asarray(run.batches(0, 1)[0])

    def plan(params):
        return geometry_plan(params.gaussians, receiver, run.capacity, run.settings.field.projection)

    def networks(params, query, planned):
        return wideband.em_features(params, planned, query)

    def composite(splats, jobs, attenuation, signal):
        return render_splats(GeometryPlan(splats, jobs), attenuation, signal)

    def loss(image, data):
        return image_loss(image, data.pas(index), weight)[0]

    def forward(params, query, data):
        return loss(wideband.render(params, field.plan(params, receiver, None, run.capacity), query), data)

    def gradient(params, data):
        return loss_and_gradients(
            field, params, run.prepared, data, index, run.capacity, run.key, None, probe_of(run.hooks, params)
        )

    def optimiser(gradients, state):
        updates, moments = run.optimizer.update(gradients, state.optimizer, state.params)
        return optax.apply_updates(state.params, updates), moments

    def with_backward(function, argnums):
        """Forward and backward of a part; the sum costs next to nothing."""
        return jax.grad(lambda *args: sum(jnp.sum(leaf) for leaf in jax.tree.leaves(function(*args))), argnums)

    query = jax.tree.map(lambda a: a[index], data.links)
    geometry = plan(params)
    planned = wideband.WidebandPlan(geometry, None, field.frame, receiver, field.config)  # features: in every call
    even = jnp.full((params.gaussians.alive.size, len(index)), 0.3)  # the time does not depend on these values
    splatting = (geometry.splats, geometry.jobs, even, even)
    observed = run.data.pas(index)
    assert observed is not None, "scenes hold snapshots"
    image, gradients = 0.9 * observed, params
    calls: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        "plan": (plan, (params,)),
        "networks": (networks, (params, query, planned)),
        "networks_fwd_bwd": (with_backward(networks, 0), (params, query, planned)),
        "composite": (composite, splatting),
        "composite_fwd_bwd": (with_backward(composite, (0, 2, 3)), splatting),
        "loss": (loss, (image, data)),
        "loss_fwd_bwd": (with_backward(loss, 0), (image, data)),
        "forward": (forward, (params, query, data)),
        "gradient": (gradient, (params, data)),
        "optimiser": (optimiser, (gradients, state)),
    }
    return {name: functools.partial(looped(function, turns), *arguments) for name, (function, arguments) in calls.items()}


def looped(function: Callable[..., Any], turns: int) -> Callable[..., Any]:
    """A function done several times in one call; every turn waits for the one before, so that none can be spared."""

    def loop(*arguments):
        def turn(_, total):
            fresh, total = jax.lax.optimization_barrier((arguments, total))
            return total + sum(jnp.sum(leaf, dtype=jnp.float32) for leaf in jax.tree.leaves(function(*fresh)))

        return jax.lax.fori_loop(0, turns, turn, jnp.zeros(()))

    return jax.jit(loop)


def measure(report: Report, effort: Effort) -> None:
    """Step time and breakdown."""
    name = preset(effort)
    say(f"training step: {name} preset on scene 1")
    steps = 2 if effort.quick else STEPS
    with tempfile.TemporaryDirectory() as folder:
        run = start_run(effort, Path(folder), steps)
        seconds = interleaved(parts(run, steps) | {"epoch": run.epoch}, effort)
    seconds = {part: times / steps for part, times in seconds.items()}
    step = seconds.pop("epoch")
    tag = f"{name}_b{run.settings.optim.batch}"
    report.add_sample(f"train_step_s_{tag}", step, "s")
    forward, gradient = seconds.pop("forward"), seconds.pop("gradient")
    seconds |= {"backward": gradient - forward, "rest": step - gradient - seconds["optimiser"]}
    for part, times in seconds.items():
        report.add_time(f"step_{part}_{tag}", times)
