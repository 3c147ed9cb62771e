"""What the compilers say without a device: the memory that the renderer's gradient takes, compiled for the CPU, and for a GPU.

JAX's CUDA plugin compiles for a GPU that is not there if it is told which one (`jax.experimental.topologies`): the plugin and
CUDA's compiler have to be installed (extra `cuda`), a driver has not. Kernels are chosen without being tried.
"""

import importlib.util
import time
from typing import Any

import jax
from jax.experimental import topologies
from jax.sharding import NamedSharding, PartitionSpec

from experiments.bench.scene import gradient_of, random_scene
from experiments.gpu_check.cases import ROOMS, Case
from experiments.gpu_check.record import Record, rounded

GAUSSIANS, QUERIES = (2_000, 10_000, 30_000, 70_000), 8
STAND_IN_GAUSSIANS = (2_000, 10_000, 70_000)
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
FOR = "H100"


def gpu_on_paper() -> Any:
    """Returns the sharding of arrays on a GPU that is not there.

    Raises:
        NotImplementedError: the plugin is not installed.
    """
    if importlib.util.find_spec(PLUGIN) is None:
        raise NotImplementedError(f"{PLUGIN} is not installed; it comes with the extra `cuda`")
    jax.devices()  # plugins are found when a device is first asked for
    facts = " ".join(f"{name}: {value}" for name, value in H100.items())
    target = f'gpu_device_info {{ {facts} cuda_compute_capability {{ major: 9 }} }} platform_name: "CUDA"'
    wanted = {"topology": "1x1x1", "target_config": f'{target} device_description_str: "{FOR}"'}
    mesh = topologies.make_mesh(topologies.get_topology_desc(platform="cuda", **wanted), (1,), ("device",))
    return NamedSharding(mesh, PartitionSpec())


def compile_for(place: Any, function: Any, arguments: Any) -> Any:
    """Returns a function, compiled for a GPU on paper."""
    shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=place), arguments)
    return jax.jit(function).trace(*shapes).lower(lowering_platforms=("cuda",)).compile()


def measure(record: Record, deadline: float, quick: bool) -> None:
    """Compiles the renderer's gradient by size, then the fields' losses and gradients, until the deadline."""
    try:
        place = gpu_on_paper()
    except (NotImplementedError, RuntimeError) as error:
        place = None
        record.leave_out(f"compiled for an {FOR}", str(error).splitlines()[0])
    for n in STAND_IN_GAUSSIANS if quick else GAUSSIANS:
        if time.monotonic() > deadline:
            record.leave_out(f"renderer_n{n}_b{QUERIES}", "the time was up")
            continue
        record.add(f"renderer_n{n}_b{QUERIES}", renderer(place, n))
    for room in ("wideband", "wave") if place is not None else ():
        for case in ROOMS[room]():
            if case.name.endswith(":loss") and time.monotonic() < deadline:
                record.add(case.name, of_case(place, case))


def renderer(place: Any, n: int) -> dict[str, float]:
    """Returns the temporaries (GB) of the renderer's gradient step, compiled for this CPU and for the GPU on paper."""
    scene = random_scene(n, QUERIES, 0)
    function, inputs = gradient_of(scene.tiled), scene.inputs(QUERIES)
    here = temporaries(jax.jit(function).lower(*inputs).compile())
    return {"cpu_gb": here} | ({} if place is None else compiled(place, function, inputs))


def of_case(place: Any, case: Case) -> dict[str, float]:
    """Returns what the compiler says of a case."""
    return compiled(place, case.program(), case.arguments)


def compiled(place: Any, function: Any, arguments: Any) -> dict[str, float]:
    """Returns temporaries (GB) on the GPU on paper, and the seconds of the compilation."""
    begin = time.perf_counter()
    program = compile_for(place, function, arguments)
    return {f"{FOR.lower()}_gb": temporaries(program), "compile_s": round(time.perf_counter() - begin, 1)}


def temporaries(program: Any) -> float:
    """Returns the memory (GB) that a compiled function takes beyond its inputs and outputs."""
    return rounded(program.memory_analysis().temp_size_in_bytes / 1e9)
