"""Help comes at once: nothing that takes seconds to load is loaded for it."""

import json
import subprocess
import sys

import pytest

PROBE = """
import contextlib, io, json, sys
from wbgs_jax.commands import main as cli
sys.argv = ["wbgs-jax", *sys.argv[1:]]
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    cli.dispatch()
print(json.dumps(sorted({"jax", "flax", "matplotlib", "orbax", "scipy", "trimesh"} & set(sys.modules))))
"""


@pytest.mark.parametrize(
    "words", [["--help"], ["predict", "--help"], ["map", "--help"], ["convert", "--help"], ["view", "--help"]]
)
def test_help_loads_nothing_large(words):
    done = subprocess.run([sys.executable, "-c", PROBE, *words], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []
