"""Settings of the processes of the library's command lines: silence of XLA, precision, threads; must be imported before JAX.

XLA logs harmless errors about tuning flags of cached programs, and reads its log level only once, when it is loaded. Commands
compute in single precision, whatever the user has set for other programs (JAX_ENABLE_X64). The host factorises small matrices
only; on a shared machine the threads of OpenBLAS mostly wait for each other, and one thread is up to a hundred times faster. In
all other processes nothing is changed.
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
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
