"""Commands where a user has no home, a terminal has only ASCII, or a path is not UTF-8; and a predictor in another process."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from builders.synthetic import tiny_dataset
from builders.untrained import make_run, make_trained

from wbgs_jax._util import compilation
from wbgs_jax.inference.predictor import make_predictor
from wbgs_jax.training.run_folder import load_trained, open_run

ODD = os.fsdecode(b"r\xe9sum\xe9")
"""Latin-1, as older disks have it."""


def run(*arguments, **variables):
    command = [sys.executable, "-m", "wbgs_jax", *map(os.fspath, arguments)]
    return subprocess.run(command, capture_output=True, env=os.environ | variables, cwd=Path(__file__).parents[2], timeout=300)


def test_a_run_whose_path_is_not_utf_8(tmp_path):
    """A training writes its checkpoints there, and every command finds them."""
    folder = tmp_path / ODD / "run"
    try:
        folder.mkdir(parents=True)
    except OSError:
        pytest.skip("the file system takes UTF-8 alone")
    make_run(folder)
    assert load_trained(folder).step == load_trained(make_run(tmp_path / "plain")).step
    out = tmp_path / ODD / "out.npz"
    done = run("predict", "--run", folder, "--tx", "1,0.5,1.5", "--ghz", "28", "--out", out, LC_ALL="C.UTF-8")
    assert done.returncode == 0, done.stderr
    assert out.exists()


def test_a_terminal_that_has_only_ascii():
    ascii_only = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": ""}
    for name in ("train", "predict", "convert"):
        done = run(name, "--help", **ascii_only)
        assert done.returncode == 0 and b"--" in done.stdout, done.stderr


def test_a_user_without_a_home(monkeypatch):
    def nowhere():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv(compilation.VARIABLE, raising=False)
    monkeypatch.setattr(Path, "home", nowhere)
    assert compilation.cache_folder() is None


def test_a_predictor_goes_to_another_process(tmp_path):
    ask = make_predictor(make_trained(tmp_path / "run"), tiny_dataset().receiver())
    again = pickle.loads(pickle.dumps(ask))
    places, hertz = np.array([[1, 0.5, 1.5], [2, 1, 1]], np.float32), np.float32(28e9)
    np.testing.assert_array_equal(again(places, hertz), ask(places, hertz))
    assert jax.jit(again)(places, hertz).shape == (2, 90, 360)


def test_an_open_run_can_be_pickled(tmp_path):
    trained = pickle.loads(pickle.dumps(open_run(make_run(tmp_path / "run"))))
    assert trained.field.name == "wideband"
