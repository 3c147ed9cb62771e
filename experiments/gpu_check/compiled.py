"""Compile for GPUs that are not there: `python -m experiments.gpu_check.compiled`, experiments/results/gpu/compiled.json.

JAX's CUDA plugin compiles for any GPU that is described to it (`jax.experimental.topologies`): the plugin and CUDA's compiler
have to be installed (extra `cuda`), a driver has not. Kernels are chosen without being tried, and the device's own sort is
replaced by another, which takes some seconds to compile.
"""

import dataclasses
import importlib.util
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import topologies
from jax.sharding import NamedSharding, PartitionSpec

from experiments.bench.scene import gradient_of, random_scene
from experiments.gpu_check.record import rounded
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.files import write_json
from wbgs_jax.config import changed
from wbgs_jax.data import load_dataset
from wbgs_jax.evaluation.report import environment
from wbgs_jax.fields import get_field
from wbgs_jax.splat.tiles import GPU_TILING, TileLimits
from wbgs_jax.training.loop import Run
from wbgs_jax.training.step import init_state, run_epoch

RESULT = Path(__file__).parents[1] / "results" / "gpu" / "compiled.json"
GAUSSIANS, QUERIES = (2_000, 10_000, 70_000), 8
SLOTS = 32_768
"""Slots for Gaussians in the epoch."""
PLUGIN = "jax_cuda12_plugin"
H100 = {
    "threads_per_warp": 32,
    "threads_per_block_limit": 1024,
    "threads_per_core_limit": 2048,
    "registers_per_block_limit": 65_536,
    "registers_per_core_limit": 65_536,
    "shared_memory_per_block": 48 * 1024,
    "shared_memory_per_block_optin": 227 * 1024,
    "shared_memory_per_core": 228 * 1024,
    "block_dim_limit_x": 2**31 - 1,
    "block_dim_limit_y": 65_535,
    "block_dim_limit_z": 65_535,
    "core_count": 132,
    "fpus_per_core": 128,
    "clock_rate_ghz": 1.98,
    "l2_cache_size": 50 * 2**20,
    "memory_bandwidth": 3_350_000_000_000,
    "device_memory_size": 80 * 10**9,
}
"""An H100 SXM, by NVIDIA's data sheet and CUDA's table of compute capabilities, in XLA's words."""
A100 = H100 | {
    "shared_memory_per_block_optin": 163 * 1024,
    "shared_memory_per_core": 164 * 1024,
    "core_count": 108,
    "fpus_per_core": 64,
    "clock_rate_ghz": 1.41,
    "l2_cache_size": 40 * 2**20,
    "memory_bandwidth": 2_039_000_000_000,
}
"""An A100 SXM, which an A800 is but for its links to others."""
GPUS = {"H100": (9, H100), "A100": (8, A100)}
"""Major compute capability and facts."""


def gpu_on_paper(name: str = "H100") -> Any:
    """Returns the sharding of arrays on a GPU that is not there.

    Raises:
        NotImplementedError: the plugin is not installed.
    """
    if importlib.util.find_spec(PLUGIN) is None:
        raise NotImplementedError(f"{PLUGIN} is not installed; it comes with the extra `cuda`")
    jax.devices()  # plugins are found when devices are first requested
    major, facts = GPUS[name]
    described = " ".join(f"{fact}: {value}" for fact, value in facts.items())
    target = f'gpu_device_info {{ {described} cuda_compute_capability {{ major: {major} }} }} platform_name: "CUDA"'
    wanted = {"topology": "1x1x1", "target_config": f'{target} device_description_str: "{name}"'}
    mesh = topologies.make_mesh(topologies.get_topology_desc(platform="cuda", **wanted), (1,), ("device",))
    return NamedSharding(mesh, PartitionSpec())


def shapes_on(place: Any, tree: Any) -> Any:
    """Returns the shapes of arrays that lie on a GPU on paper."""
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=place), tree)


def renderer(place: Any, n: int) -> dict[str, float]:
    """Returns what compiling the renderer's gradient, geometry included, takes, and its temporaries (GB)."""
    scene = random_scene(n, QUERIES, 0, GPU_TILING)
    return compiled(jax.jit(gradient_of(scene.tiled)).trace(*shapes_on(place, scene.inputs(QUERIES))))


def epoch(place: Any, slots: int, changes: dict[str, Any]) -> dict[str, float]:
    """Returns the same of an epoch of the preset `paper` in scene 1 with so many slots, with some of its settings changed."""
    settings = changed(get_field("wideband").presets["paper"], changes)
    with tempfile.TemporaryDirectory() as folder:
        run = Run(load_dataset("1"), "wideband", settings, 0, Path(folder))
    params = run.state.params
    gaussians = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((slots, *leaf.shape[1:]), leaf.dtype), params.gaussians)
    params = dataclasses.replace(jax.eval_shape(lambda tree: tree, params), gaussians=gaussians)
    state = jax.eval_shape(lambda params: init_state(params, run.optimizer, run.hooks), params)
    capacity = TileLimits(8192, 1024, GPU_TILING.height, GPU_TILING.width).scaled(slots / 1024)
    batches = jnp.asarray(run.batches(0, settings.loop.epoch_steps))
    given = state, run.field, run.prepared, run.data, batches, jnp.zeros((), jnp.int32), run.key
    static = {"optimizer": run.optimizer, "hooks": run.hooks, "capacity": capacity, "branches": False}
    stopped = shapes_on(place, jnp.zeros((), bool))
    return compiled(run_epoch.trace(*shapes_on(place, given), **static, stopped=stopped))


def compiled(traced: Any) -> dict[str, float]:
    """Returns the seconds of lowering and compilation for the device of the arguments, and temporaries (GB)."""
    begin = time.perf_counter()
    lowered = traced.lower(lowering_platforms=("cuda",))
    between = time.perf_counter()
    program = lowered.compile()
    seconds = {"lower_s": round(between - begin, 1), "compile_s": round(time.perf_counter() - between, 1)}
    return seconds | {"temporaries_gb": rounded(program.memory_analysis().temp_size_in_bytes / 1e9)}


def main() -> None:
    """Compiles the renderer by size, and an epoch, for every GPU; the file has all that is known."""
    host = environment() | {"cores": len(os.sched_getaffinity(0))}
    result: dict[str, Any] = {"command": "python -m experiments.gpu_check.compiled", "provenance": host}
    jax.config.update("jax_default_device", jax.devices("cpu")[0])
    for name in GPUS:
        place = gpu_on_paper(name)
        found = {f"renderer_n{n}_b{QUERIES}": renderer(place, n) for n in GAUSSIANS}
        found[f"paper_epoch_{SLOTS}_slots"] = epoch(place, SLOTS, {"field": {"gaussians": 500}})
        result[name] = found
        write_json(RESULT, result)
        say(f"{name}: {found}")


if __name__ == "__main__":
    run_command(main)
