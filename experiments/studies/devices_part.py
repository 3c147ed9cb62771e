"""A training of `experiments.studies.devices`: `python -m experiments.studies.devices_part KIND FOLDER FIELD ...`.

One device also measures the parts of a step, and four look at what their compiled programs exchange.
"""

import re
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Int

from wbgs_jax._util.devices import AXIS, connect
from wbgs_jax._util.files import write_json
from wbgs_jax.config import Settings, changed
from wbgs_jax.data.dataset import Dataset, fewer_transmitters, hold_out_validation
from wbgs_jax.data.load import load_dataset
from wbgs_jax.fields import get_field
from wbgs_jax.training import loop
from wbgs_jax.training.hooks import Context, probe_of
from wbgs_jax.training.step import loss_and_gradients

STEPS, EVERY, BATCH, TRANSMITTERS = 40, 5, 8, 24
BATCHES = (1, 2, 4, 8, 16)
"""Links a step, whose times are measured ..."""
REPEATS = 5
"""... so often."""
MEASURED, LOOKED_AT = ("wideband", "nerf2"), ("wideband", "nerf2")
COLLECTIVES = ("all-reduce", "all-gather", "all-to-all", "collective-permute", "reduce-scatter")


def settings_of(field: str, batch: int = BATCH) -> Settings:
    """Returns those of the `cpu` preset, with few steps, one density control and no search, whose time is not the devices'."""
    density = {"density": {"every": 20, "start": 20}} if any("density" in name for name in get_field(field).hooks) else {}
    preset = changed(get_field(field).presets["cpu"], density | {"optim": {"steps": STEPS, "batch": batch, "min_steps": STEPS}})
    return changed(preset, {"loop": {"epoch_steps": EVERY, "evaluate_every": STEPS, "checkpoint_every": STEPS}})


def without_search(settings: Settings) -> Settings:
    """Returns settings under which materials start alike."""
    if settings.calibration is None:
        return settings
    return changed(settings, {"calibration": {"rounds": 0, "antenna_rounds": 0, "geometry": False}})


def data() -> Dataset:
    """Returns some transmitters of scene 1: paths of few are found quickly."""
    return hold_out_validation(fewer_transmitters(load_dataset("1"), TRANSMITTERS, 0), 0.25)


def make_run(field: str, folder: Path, batch: int = BATCH) -> loop.Run:
    """Returns a run before its first step."""
    return loop.Run(data(), field, without_search(settings_of(field, batch)), 0, folder)


def arguments_of(run: loop.Run) -> tuple[Any, ...]:
    """Returns what a step's gradients are made of."""
    index = jnp.asarray(run.batches(0, 1)[0])
    return run.devices.replicated((run.field, run.state.params, run.prepared, run.data, index, run.key))


def exchanged(run: loop.Run) -> dict[str, Any]:
    """Returns the collectives of a step's compiled gradients and its operations a device: with links divided by `shard_map`, as
    the library does, with `jit` left to divide them, and on one device."""
    assert run.devices.mesh is not None
    probe = probe_of(run.hooks, run.state.params)
    by_links = NamedSharding(run.devices.mesh, PartitionSpec(AXIS))

    def step(mesh: Any, divide: Callable[[Any], Any]) -> Callable[..., Any]:
        def gradients(field, params, prepared, data, index, key):
            return loss_and_gradients(field, params, prepared, data, divide(index), run.capacity, key, mesh, probe)

        return gradients

    def left_to_jit(index: Any) -> Any:
        return jax.lax.with_sharding_constraint(index, by_links)

    arguments = arguments_of(run)
    kinds = {
        "shard_map": (step(run.devices.mesh, lambda index: index), arguments),
        "jit": (step(None, left_to_jit), arguments),
        "one": (step(None, lambda index: index), run.devices.own(arguments)),
    }
    return {name: _compiled(function, given) for name, (function, given) in kinds.items()}


def _compiled(function: Callable[..., Any], arguments: tuple[Any, ...]) -> dict[str, Any]:
    compiled: Any = jax.jit(function).lower(*arguments).compile()
    text, cost = compiled.as_text(), compiled.cost_analysis()
    found = {name: re.findall(rf"= (.*?) {name}(?:-start)?\(", text) for name in COLLECTIVES}
    counts = {name: len(shapes) for name, shapes in found.items()}
    return counts | {"total": sum(counts.values()), "mega_operations": cost["flops"] / 1e6, "reduced_kb": _kilobytes(found)}


def _kilobytes(found: dict[str, list[str]]) -> float:
    """Returns what all-reduces hold, kB: sizes stand in the program's text, such as f32[64,3]."""
    shapes = re.findall(r"\w+\[([\d,]*)\]", " ".join(found["all-reduce"]))
    return sum(4 * int(np.prod([int(n) for n in shape.split(",") if n])) for shape in shapes) / 1e3


def seconds(function: Callable[[], Any]) -> float:
    """Returns the processor time of a call after the first one, the median of some: other work on the machine counts little."""
    function()
    times = []
    for _ in range(REPEATS):
        begin = time.process_time()
        function()
        times.append(time.process_time() - begin)
    return statistics.median(times)


def parts(field: str, folder: Path) -> dict[str, Any]:
    """Returns what a step takes by its number of links, the bytes of its gradients, and what the host does between epochs."""
    step, run = {}, make_run(field, folder)
    for batch in BATCHES:
        run = make_run(field, folder, batch)
        step[str(batch)] = seconds(_gradients(run))
    slope, shared = np.polyfit(BATCHES, list(step.values()), 1)
    trained = [*jax.tree.leaves(run.state.params), *jax.tree.leaves(probe_of(run.hooks, run.state.params))]
    state = sum(leaf.nbytes for leaf in jax.tree.leaves(run.state))
    return {
        "step_s": step,
        "spectrum_s": float(slope),
        "shared_s": max(float(shared), 0.0),
        "gradient_bytes": sum(leaf.nbytes for leaf in trained),
        "state_bytes": int(state),
        "data_bytes": sum(leaf.nbytes for leaf in jax.tree.leaves((run.prepared, run.data.links, run.data.snapshots))),
        "checkpoint_s": seconds(run.save),
        "evaluation_s": seconds(run.evaluate),
        "control_s": seconds(lambda: _control(run)),
    }


def _gradients(run: loop.Run) -> Callable[[], Any]:
    """Returns a call that computes the gradients of a batch."""
    given, capacity, probe = arguments_of(run), run.capacity, probe_of(run.hooks, run.state.params)

    @jax.jit
    def gradients(field, params, prepared, data, index, key):
        return loss_and_gradients(field, params, prepared, data, index, capacity, key, None, probe)

    return lambda: jax.block_until_ready(gradients(*given))


def _control(run: loop.Run) -> None:
    for number, hook in enumerate(run.hooks):
        context = Context(run.data, run.prepared, run.dataset.train)
        hook.apply(run.field, run.state.params, run.state.statistics[number], context, 20, np.random.default_rng(0))


def reverse_batches() -> None:
    """Lets every run of this process take the links of a batch in reverse: the same sums, rounded otherwise."""
    original = loop.Run.batches

    def batches(self: loop.Run, epoch: int, steps: int) -> Int[np.ndarray, "k b"]:
        return original(self, epoch, steps)[:, ::-1]

    loop.Run.batches = batches  # type: ignore[method-assign]


def main(kind: str, folder: Path, *fields: str) -> None:
    """Trains the fields, and looks at what there is to see."""
    if kind == "two":
        connect()
    if kind == "reversed":
        reverse_batches()
    for field in fields:
        loop.train(data(), field, without_search(settings_of(field)), 0, folder / field)
    if kind == "four":
        looked = {field: exchanged(make_run(field, folder / "looked")) for field in fields if field in LOOKED_AT}
        write_json(folder / "exchanged.json", looked)
    if kind == "one":
        write_json(folder / "parts.json", {field: parts(field, folder / "parts") for field in fields if field in MEASURED})


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
