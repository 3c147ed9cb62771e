"""Programs that enable 64 bits (JAX_ENABLE_X64) use the functions as they are: fields stay in single precision."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLE = r"""
import re
from pathlib import Path
import jax, numpy as np
assert jax.config.jax_enable_x64
exec(re.findall(r"```python\n(.*?)```", Path("docs/concepts.md").read_text(), re.S)[0])
pas = render(params, plan, wb.make_query([[1.0, 2.0, 1.5]], [2.4e9]))
assert pas.dtype == np.float32 and all(leaf.dtype != np.float64 for leaf in jax.tree.leaves(params))
assert np.isfinite(d_tx).all() and np.isfinite(d_frequency).all()
print(float(pas.sum()))
"""
RUNS = """
import sys
from pathlib import Path
import jax, numpy as np
assert jax.config.jax_enable_x64
sys.path.insert(0, "tests")
from builders.untrained import make_coherent_run, make_run
import wbgs_jax as wb
for make in (make_run, make_coherent_run):
    predict = wb.make_predictor(wb.load_trained(make(Path(sys.argv[1]) / make.__name__)))
    for tx in ([1.0, 0.5, 1.5], np.array([1.0, 0.5, 1.5]), jax.numpy.array([1.0, 0.5, 1.5])):
        pas = predict(tx, [28e9])
        assert pas.dtype == np.float32 and pas.shape == (1, 90, 360) and 0 < pas.max() <= 1
print(float(pas.sum()))
"""


def run(code, *arguments, double=True):
    environment = os.environ | {"JAX_ENABLE_X64": "1" if double else "0", "TF_CPP_MIN_LOG_LEVEL": "3"}
    done = subprocess.run([sys.executable, "-c", code, *arguments], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return float(done.stdout.splitlines()[-1])


@pytest.mark.heavy
def test_the_example_of_the_readme_runs(monkeypatch, capsys):
    """In single precision in this process, where nothing has to be imported again."""
    monkeypatch.chdir(ROOT)
    exec(re.sub("assert jax.config.jax_enable_x64", "", EXAMPLE), {})
    assert run(EXAMPLE) == pytest.approx(float(capsys.readouterr().out.splitlines()[-1]), rel=1e-4)


@pytest.mark.heavy
def test_runs_answer_in_single_precision(tmp_path):
    single = re.sub("assert jax.config.jax_enable_x64", "", RUNS)
    assert run(RUNS, str(tmp_path / "a")) == pytest.approx(run(single, str(tmp_path / "b"), double=False), rel=1e-3)


@pytest.mark.heavy
def test_commands_compute_in_single_precision():
    code = "import sys; sys.argv = ['wbgs-jax']; import wbgs_jax._util.quiet, jax; print(int(jax.config.jax_enable_x64))"
    assert run(code) == 0
