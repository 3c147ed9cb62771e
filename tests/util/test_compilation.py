"""The compilation cache: a second process loads what the first one compiled; it never stops a run."""

import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from wbgs_jax._util import compilation
from wbgs_jax._util.compilation import VARIABLE, load_program, trace_program, use_compilation_cache

PROGRAM = """
import logging, jax, jax.numpy as jnp
from wbgs_jax._util import compilation
compilation.MIN_SECONDS = 0.0
print(compilation.use_compilation_cache())
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name) if name.endswith("cache_hits") else None)
jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((64, 64))).block_until_ready()
print(len(hits))
"""


def run(folder, **more):
    environment = os.environ | {VARIABLE: str(folder), "JAX_PLATFORMS": "cpu"} | more
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    environment |= more
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    where, hits = done.stdout.split()
    return where, int(hits)


@pytest.mark.heavy
def test_a_second_process_loads_what_the_first_compiled(tmp_path):
    where, hits = run(tmp_path)
    assert where.startswith(str(tmp_path)) and hits == 0
    assert run(tmp_path)[1] > 0


def test_it_can_be_switched_off_and_jax_has_its_own_say(tmp_path):
    assert run("")[0] == "None"
    assert run(tmp_path, JAX_COMPILATION_CACHE_DIR=str(tmp_path / "own"))[0] == str(tmp_path / "own")


def test_a_folder_that_cannot_be_made_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    nothing_set = SimpleNamespace(config=SimpleNamespace(jax_compilation_cache_dir=None))
    monkeypatch.setitem(sys.modules, "jax", nothing_set)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "file" / "cache"))
    own = jax.config.jax_compilation_cache_dir  # that of the tests
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        assert use_compilation_cache() is None
    finally:
        jax.config.update("jax_compilation_cache_dir", own)


def test_a_program_is_traced_once(tmp_path):
    """For arguments of equal shapes and the same settings."""

    def function(x, y):
        return {"sum": x + y, "parts": [x, y]}

    shapes = [jax.ShapeDtypeStruct((n,), np.float32) for n in (3, 1)]
    names = [trace_program(tmp_path, function, shapes, structure) for structure in ("a", "a", "b")]
    assert names[0] == names[1] != names[2] and len(list(tmp_path.rglob("*.bin"))) == 2
    found = load_program(tmp_path, names[0])(np.arange(3, dtype=np.float32), np.ones(1, np.float32))
    np.testing.assert_array_equal(found["sum"], [1, 2, 3])
    np.testing.assert_array_equal(found["parts"][1], [1])


def test_a_cache_has_a_limit(tmp_path):
    for age, name in enumerate(("new", "old", "older")):
        (tmp_path / name).write_bytes(b"x" * 100)
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    compilation.limit_size(tmp_path, 250)
    assert {path.name for path in tmp_path.iterdir()} == {"new", "old"}
