"""Command lines as tests call them: in this process, or in one of their own."""

import contextlib
import io
import os
import subprocess
import sys
from types import SimpleNamespace

from wbgs_jax._util.cli import run_command


def call(main, *arguments) -> SimpleNamespace:
    """Exit code, stdout and stderr of an entry point, in this process."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            run_command(lambda: main([str(argument) for argument in arguments]))
        except SystemExit as stop:
            code = stop.code
    return SimpleNamespace(code=code, out=out.getvalue(), err=err.getvalue())


def in_a_process(module, *arguments, **environment) -> SimpleNamespace:
    """The same of `python -m MODULE ARGUMENTS`, in a process of its own."""
    command = [sys.executable, "-m", module, *map(str, arguments)]
    environment = os.environ | {"JAX_PLATFORMS": "cpu"} | environment
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    return SimpleNamespace(code=done.returncode, out=done.stdout, err=done.stderr)


def assert_error_for_people(result, *words) -> None:
    """Exit code 2 and one line on stderr that holds the words."""
    assert result.code == 2
    assert result.out == ""
    (line,) = result.err.splitlines()
    assert line.startswith("error: ")
    for word in words:
        assert str(word) in line
