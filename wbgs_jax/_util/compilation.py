"""XLA's persistent compilation cache for the command lines: what one run compiled, the next one loads.

The library never switches it on by itself; other JAX pipelines have their own.
"""

import hashlib
import os
import platform
from pathlib import Path

import jax

VARIABLE = "WBGS_CACHE"
"""Environment variable: folder of the cache; empty switches it off."""
MIN_SECONDS = 0.5
"""What compiles faster is not kept."""


def use_compilation_cache() -> Path | None:
    """Keeps compiled programs in `WBGS_CACHE`, ~/.cache/wbgs-jax unless set; returns the folder, or None where there is none.

    JAX's own setting (`JAX_COMPILATION_CACHE_DIR`) goes first.
    """
    if own := getattr(jax.config, "jax_compilation_cache_dir", None):
        return Path(own)
    wanted = os.environ.get(VARIABLE, str(Path.home() / ".cache" / "wbgs-jax"))
    if not wanted:
        return None
    folder = Path(wanted) / _machine()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # a home that cannot be written costs compile time, not the run
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_SECONDS)
    return folder


def _machine() -> str:
    """Returns a name for this kind of processor: compiled CPU code must not move to one that lacks its instructions."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    flags = next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
    return f"{platform.machine()}-{hashlib.sha256(flags.encode()).hexdigest()[:8]}"
