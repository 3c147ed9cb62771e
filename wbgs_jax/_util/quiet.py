"""Silences XLA in the processes of our own command lines, and sets their precision; they import this before JAX is loaded.

XLA logs errors about tuning flags of cached programs, which are of no consequence, and reads its log level once, when it is
loaded. Commands compute in single precision, whatever other programs of the user want (JAX_ENABLE_X64). In any other process
nothing is changed.
"""

import itertools
import os
import sys
from pathlib import Path


def is_command_line() -> bool:
    """Returns whether this process runs `wbgs-jax` or `python -m wbgs_jax...`."""
    modules = [word for option, word in itertools.pairwise(sys.orig_argv) if option == "-m"]
    scripts = [Path(word).stem for word in sys.argv[:1]]
    return any(word == "wbgs_jax" or word.startswith("wbgs_jax.") for word in modules) or scripts == ["wbgs-jax"]


if is_command_line():
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ["JAX_ENABLE_X64"] = "0"
