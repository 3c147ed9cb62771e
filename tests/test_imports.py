"""Importing the library, or any of its names and modules, changes nothing in the process."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import wbgs_jax
from wbgs_jax._util.quiet import is_command_line

PROBE = """
import importlib, json, logging, os, pkgutil, signal, sys, warnings

LOGGERS = (None, "absl", "asyncio", "jax", "matplotlib", "orbax")


options = []


def state():
    jax, backend = sys.modules.get("jax"), "not loaded"
    if "matplotlib" in sys.modules:
        backend = repr(dict.__getitem__(sys.modules["matplotlib"].rcParams, "backend"))  # asking for it would choose one
    return {
        "environment": dict(os.environ),
        "levels": {str(name): logging.getLogger(name).level for name in LOGGERS},
        "handlers": [repr(handler) for name in LOGGERS for handler in logging.getLogger(name).handlers],
        "logging": [logging.root.manager.disable, repr(logging.getLoggerClass())],
        "signals": {str(number): repr(signal.getsignal(number)) for number in signal.valid_signals()},
        "hooks": [repr(hook) for hook in (sys.excepthook, sys.displayhook, sys.unraisablehook)],
        "place": [os.getcwd(), list(sys.path)],
        "jax": {name: repr(jax.config.values[name]) for name in options} if jax else {},
        "pyplot": "matplotlib.pyplot" in sys.modules,
        "backend": backend,
    }


def changes(before, after):
    return {key: [before[key], after[key]] for key in before if before[key] != after[key]}


report, before = {}, state()
import wbgs_jax

report["import wbgs_jax"] = changes(before, state())
import wbgs_jax._util.quiet

report["before JAX is loaded"] = changes(before, state())
report["loaded"] = sorted({"jax", "numpy", "matplotlib", "orbax", "tyro"} & set(sys.modules))
import jax, jax.experimental.pallas, matplotlib  # which change a little themselves

options = list(jax.config.values)  # its modules know more of them
before = state()
for name in wbgs_jax.__all__:
    getattr(wbgs_jax, name)
    report[f"wbgs_jax.{name}"] = changes(before, state())
names = [module.name for module in pkgutil.walk_packages(wbgs_jax.__path__, "wbgs_jax.")]
for name in names:
    if not name.endswith("__main__"):
        importlib.import_module(name)
        report[name] = changes(before, state())
print(json.dumps(report))
"""


@pytest.fixture(scope="module")
def report():
    """What every import changed, in a process of its own."""
    environment = {key: value for key, value in os.environ.items() if key != "TF_CPP_MIN_LOG_LEVEL"}
    done = subprocess.run([sys.executable, "-c", PROBE], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return json.loads(done.stdout)


@pytest.mark.heavy
def test_importing_the_package_loads_and_changes_nothing(report):
    assert report["import wbgs_jax"] == report["before JAX is loaded"] == {}
    assert report["loaded"] == []


def test_no_name_and_no_module_changes_anything(report):
    modules = Path(wbgs_jax.__file__).parent.rglob("*.py")
    names = [name for name in wbgs_jax.__all__ if not isinstance(getattr(wbgs_jax, name), ModuleType)]  # groups are modules
    assert len(report) >= 2 + len(names) + len(list(modules)) - 2  # all but __main__ and the package itself
    assert {name: changed for name, changed in report.items() if changed and name != "loaded"} == {}


def test_public_names_are_loaded_when_they_are_asked_for():
    """And are listed before."""
    assert set(wbgs_jax.__all__) <= set(dir(wbgs_jax))
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = wbgs_jax.no_such_name


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["python", "-m", "wbgs_jax", "train"], True),
        (["python", "-m", "wbgs_jax.commands.train"], True),
        (["python", "-X", "dev", "-m", "wbgs_jax.commands.export_folder"], True),
        (["python", "/venv/bin/wbgs-jax", "train"], True),
        (["python", "-c", "import wbgs_jax.commands.train"], False),
        (["python", "program.py", "wbgs_jax.commands.train"], False),
        (["python", "-m", "pytest", "--pyargs", "wbgs_jax.commands.train"], False),
        (["python", "-m", "wbgs_jax_tools"], False),
    ],
)
def test_only_our_own_command_lines_are_made_quiet(monkeypatch, words, expected):
    """XLA's log level is theirs; in any other process it stays what it is."""
    monkeypatch.setattr("sys.orig_argv", words)
    monkeypatch.setattr("sys.argv", words[-2:] if words[1].endswith("wbgs-jax") else ["program.py"])
    assert is_command_line() == expected
