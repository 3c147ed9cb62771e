"""The same values and gradients on the device as on the CPU of the same machine.

Every case of `cases.py` is computed on both. Matrix products of positions and phases state their precision, so that TF32,
a GPU's default, is left to the networks: a case whose program is the same at every default precision is `pinned`. Where there
is no GPU, the program that a GPU would be given (`for_cuda`) is run on the CPU and compared with the CPU's own.
"""

import os
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from importlib.metadata import version
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import export

from experiments.bench.scene import random_scene
from experiments.gpu_check.cases import ROOMS, SMALL_ROOMS, Case
from experiments.gpu_check.record import NEEDED, NEEDED_OF_STAND_IN, Record, rounded
from wbgs_jax.splat import fused_kernels

TOLERANCE = {"values": 5e-3, "gradients": 2e-2}
"""Bound of the norm of a difference relative to the norm: phases at 94 GHz are known to 1e-3 radians in single precision.
Positions in TF32 would be off by millimetres, and everything by its own size."""
IN_TF32 = 0.1
"""The same where the networks multiply as the device likes."""
STANDS_IN = version("jaxlib").startswith("0.10.")
"""Whether a CPU can stand in for a GPU: the compiler of jaxlib 0.12 ends the process at some programs for CUDA
(computation_partitioner.cc: Check failed: operand_maps.size() == 1)."""
ORDER = (*NEEDED, *(name for name in ROOMS if name not in NEEDED))

REPEATS = 5
REPEATED, REPEATED_BY_STAND_IN = (10_000, 8), (20, 2)
"""Gaussians and queries of the gradient that is computed several times."""


class Difference(NamedTuple):
    """The largest over all arrays of a case, each relative to its norm."""

    values: float
    gradients: float

    def within(self, factor: float = 1.0) -> bool:
        """Whether both are small; not a number is not."""
        return all(own <= factor * TOLERANCE[name] for name, own in self._asdict().items())


def measure(record: Record, deadline: float, stand_in: bool) -> bool:
    """Compares all cases that have not been compared, until the deadline (of `time.monotonic`), several at once: most of the
    time goes into compiling. Returns whether all are compared."""
    if "repeat_difference" not in record.figures:
        record.add("repeat_difference", repeat_difference(*(REPEATED_BY_STAND_IN if stand_in else REPEATED)))
    waiting, missing = dict[Future[dict[str, Any]], tuple[str, Case]](), dict[str, int]()
    compared = {name for name, case in record.figures.get("cases", {}).items() if "error" not in case}
    pool = ThreadPoolExecutor(max(len(os.sched_getaffinity(0)) // 2, 1))
    reference, device = jax.devices("cpu")[0], jax.devices()[0]
    for room in NEEDED_OF_STAND_IN if stand_in else ORDER:
        if room in record.figures.get("rooms", {}):
            continue
        with jax.default_device(reference):
            found = SMALL_ROOMS[room]() if stand_in else ROOMS[room]()
            cases = [case for case in found if case.name not in compared]
        missing[room] = len(cases)
        waiting |= {pool.submit(compare, case, reference, device): (room, case) for case in cases}
    try:
        for future in as_completed(waiting, timeout=max(deadline - time.monotonic(), 0.0)):
            room, case = waiting.pop(future)
            record.add("cases", {case.name: found_by(future)})
            missing[room] -= 1
            if not missing[room]:
                record.add("rooms", {room: "compared"})
    except TimeoutError:
        for future, (_, case) in waiting.items():
            future.cancel()
            record.leave_out(case.name, "the time was up")
    return not waiting


def repeat_difference(n: int, b: int) -> float:
    """Returns how far gradients of the renderer, computed several times by one program, are from the first at most."""
    scene = random_scene(n, b, 0)
    gradient = scene.lower_gradient(scene.tiled, b).compile()
    first, *others = (jax.device_get(gradient(*scene.inputs(b))) for _ in range(REPEATS))
    return max(_farthest(first, other) for other in others)


def found_by(future: Future[dict[str, Any]]) -> dict[str, Any]:
    """Returns the result of a comparison; a case that cannot be computed does not hold."""
    try:
        return future.result()
    except Exception as error:  # whatever it is, the other cases are worth knowing
        return {"holds": False, "error": f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"}


def compare(case: Case, reference: Any, device: Any) -> dict[str, Any]:
    """Returns how far the device's values and gradients are from the reference's, and whether that is near enough."""
    begin = time.perf_counter()
    with jax.default_matmul_precision("highest"):
        expected = on(reference, case)
        difference = differ(case, expected, on(device, case) if device != reference else for_cuda(case))
    same = pinned(case)
    found = {"pinned": same} | {name: rounded(value) for name, value in difference._asdict().items()}
    holds = difference.within()
    if not same:
        as_it_likes = differ(case, expected, on(device, case) if device != reference else for_cuda(case))
        found |= {f"{name}_default_precision": rounded(value) for name, value in as_it_likes._asdict().items()}
        holds = holds and as_it_likes.within(IN_TF32 / TOLERANCE["gradients"])
    return found | {"holds": holds, "seconds": round(time.perf_counter() - begin, 1)}


def on(device: Any, case: Case) -> Any:
    """Returns the result of a case on a device."""
    return jax.device_get(jax.jit(case.program())(*jax.device_put(case.arguments, device)))


def for_cuda(case: Case) -> Any:
    """Returns the result of the program that a GPU would compile, run on this CPU.

    Raises:
        NotImplementedError: it calls code that only a GPU has, or this version's compiler cannot.
    """
    if not STANDS_IN:
        raise NotImplementedError(f"jaxlib {version('jaxlib')} compiles no programs for CUDA on a CPU; 0.10 does")
    leaves, structure = jax.tree.flatten(case.arguments)
    shape: list[Any] = []

    def flat(*leaves: Any) -> list[Any]:
        values, tree = jax.tree.flatten(case.program()(*jax.tree.unflatten(structure, leaves)))
        shape.append(tree)
        return values

    anywhere = [export.DisabledSafetyCheck.platform()]
    with fused_kernels.interpreted():
        program = export.export(jax.jit(flat), platforms=["cuda"], disabled_checks=anywhere)(*leaves)
    return jax.device_get(jax.tree.unflatten(shape[0], program.call(*leaves)))


def pinned(case: Case) -> bool:
    """Whether the program is the same for every precision that matrix products may have."""
    programs = set()
    for precision in ("highest", "tensorfloat32"):
        with jax.default_matmul_precision(precision):
            program: Callable[..., Any] = case.program()  # a new function: nothing traced is remembered
            programs.add(jax.jit(program).trace(*case.arguments).lower(lowering_platforms=("cuda",)).as_text())
    return len(programs) == 1


def differ(case: Case, expected: Any, found: Any) -> Difference:
    """Returns how far values, and gradients, are apart; of a case without gradients those are zero."""
    if not case.differentiable:
        return Difference(_farthest(expected, found), 0.0)
    return Difference(*(_farthest(a, b) for a, b in zip(expected, found, strict=True)))


def _farthest(expected: Any, found: Any) -> float:
    pairs = zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True)
    return max((_apart(np.asarray(a), np.asarray(b)) for a, b in pairs), default=0.0)


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    """Returns |a - b| / |a|; of integers the share that differs; infinite where only one side is finite."""
    if not np.issubdtype(a.dtype, np.inexact):
        return float(np.mean(a != b)) if a.size else 0.0
    finite = np.isfinite(a)
    if not (finite == np.isfinite(b)).all():
        return float("inf")
    norm, apart = np.linalg.norm(a[finite]), np.linalg.norm(a[finite] - b[finite])
    return float(apart / norm) if norm > 0 else float(apart)
