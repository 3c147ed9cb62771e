"""What a GPU would be given, without one: every public function lowers for CUDA, and says what the CPU's program says."""

import functools
import importlib.util
import inspect
import re

import jax
import numpy as np
import pytest

import wbgs_jax as wb
from experiments.gpu_check import cases as cases_module
from experiments.gpu_check import compiled, parity
from experiments.gpu_check.cases import AIMS, ON_THE_HOST, ROOMS, splatting
from experiments.profiles import TINY

FREE = {"wbgs_jax/fields/networks.py"}
"""Files whose matrix products may leave their precision to the device."""
OF_A_CPU = ("lapack", "blas", "cpu", "ducc", "callback")
"""Parts of the names of code that only a CPU calls."""
RUN = {"splatting": functools.partial(splatting, 40), "statistics": ROOMS["statistics"], "powers": ROOMS["powers"]}
"""Rooms whose programs for CUDA are also run, on this CPU, the kernels interpreted for few Gaussians ..."""
RUN_SLOWLY = [pytest.param(name, make, marks=pytest.mark.slow) for name, make in ROOMS.items() if make not in RUN.values()]
"""... and by `make test-slow`, with those that have many."""


def products_without_precision(jaxpr):
    """Files of the library whose matrix products leave their precision to the device."""
    found = set()
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general" and equation.params["precision"] is None:
            frames = [frame.file_name for frame in equation.source_info.traceback.frames if "/wbgs_jax/" in frame.file_name]
            found.add("wbgs_jax/" + frames[0].split("/wbgs_jax/")[-1] if frames else "unknown")
        for value in jax.tree.leaves(equation.params, is_leaf=lambda leaf: hasattr(leaf, "eqns") or hasattr(leaf, "jaxpr")):
            inner = getattr(value, "jaxpr", value)
            found |= products_without_precision(inner) if hasattr(inner, "eqns") else set()
    return found


@pytest.mark.heavy
@pytest.mark.parametrize("costly", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("room", [pytest.param(name, marks=[pytest.mark.slow] * (name == "hybrid")) for name in ROOMS])
def test_every_public_function_lowers_for_cuda(room, costly):
    for case in [case for case in ROOMS[room]() if case.costly == costly]:
        traced = jax.jit(case.program()).trace(*case.arguments)
        program = traced.lower(lowering_platforms=("cuda",)).as_text()
        called = re.findall(r"custom_call @(\w+)", program)
        assert not [name for name in called if any(word in name.lower() for word in OF_A_CPU)], (case.name, called)
        # TF32 would move positions by millimetres, and phases with them: the networks alone do not mind.
        assert products_without_precision(traced.jaxpr.jaxpr) <= FREE, case.name


def test_every_public_function_is_a_case_or_belongs_to_the_host():
    groups = (wb, wb.applications, wb.interchange, wb.power_map, wb.radio, wb.splat, wb.fields)
    public = {name: getattr(group, name) for group in groups for name in group.__all__}
    functions = {name for name, value in public.items() if callable(value) and not isinstance(value, type)}
    source = inspect.getsource(cases_module)
    cases = {
        name for name in functions if re.search(rf'(Case|of_paths)\(\s*"{name}\b', source) or f'f"{name}:' in source
    } | set(AIMS)
    assert functions <= cases | ON_THE_HOST, "a new public function is a case of experiments/gpu_check/cases.py"


@pytest.mark.heavy
@pytest.mark.long
@pytest.mark.skipif(not parity.STANDS_IN, reason="the compiler of this jaxlib ends the process at programs for CUDA on a CPU")
@pytest.mark.parametrize(("room", "make"), [*RUN.items(), *RUN_SLOWLY])
def test_the_program_for_cuda_says_on_this_cpu_what_its_own_says(room, make):
    """The renderer's fused kernels, interpreted, among them."""
    cpu = jax.devices("cpu")[0]
    for case in make():
        found = parity.compare(case, cpu, cpu)
        assert found["holds"] and (room != "splatting" or found["pinned"]), (case.name, found)
        assert found["values"] < 1e-4 and found["gradients"] < 1e-3, (case.name, found)


def test_differences_are_seen(rng):
    case = ROOMS["arrays"]()[0]
    right = parity.on(jax.devices("cpu")[0], case)
    wrong = jax.tree.map(lambda leaf: leaf * (1 + 0.1 * rng.normal(size=np.shape(leaf))), right)
    assert parity.differ(case, right, right).within() and not parity.differ(case, right, wrong).within()
    broken = jax.tree.map(lambda leaf: np.full_like(leaf, np.nan), right)
    assert not parity.differ(case, right, broken).within()


@pytest.mark.skipif(importlib.util.find_spec(compiled.PLUGIN) is None, reason="the CUDA plugin (extra `cuda`) is not installed")
@pytest.mark.parametrize("name", compiled.GPUS)
def test_renderer_and_epoch_compile_for_gpus_that_are_not_there(name):
    place = compiled.gpu_on_paper(name)
    assert 0 < compiled.renderer(place, 500)["temporaries_gb"] < 0.1
    tiny = {"field": TINY, "loop": {"epoch_steps": 2}}
    assert 0 < compiled.epoch(place, 64, tiny)["temporaries_gb"] < 0.1


def test_without_the_plugin_the_check_says_so(monkeypatch):
    monkeypatch.setattr(compiled.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(NotImplementedError, match="extra `cuda`"):
        compiled.gpu_on_paper()
