"""Compiled programs that outlive a process: what one command has traced and compiled, the next one loads.

The library never switches this on by itself; other JAX pipelines have their own caches.
"""

import contextlib
import ctypes
import hashlib
import os
import platform
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

VARIABLE = "WBGS_CACHE"
"""Environment variable: folder of the cache; empty switches it off."""
MIN_SECONDS = 0.5
"""What compiles faster is not kept."""
MOST_BYTES = 2e9
"""Of the cache; beyond it the oldest files go."""
SOURCES = Path(__file__).parents[1]
KERNEL_CALL = "__gpu$xla.gpu.triton"
"""What calls the renderer's kernels on a GPU: nothing that JAX promises to keep."""
PROGRAMS = "programs"
"""Folder of traced programs in the cache."""


def cache_folder() -> Path | None:
    """Returns the folder that commands keep programs in, `WBGS_CACHE` (~/.cache/wbgs-jax unless set); None where there is
    none."""
    try:
        wanted = os.environ.get(VARIABLE) if VARIABLE in os.environ else str(Path.home() / ".cache" / "wbgs-jax")
    except RuntimeError:  # a user without a home
        wanted = None
    if not wanted:
        return None
    folder = Path(wanted) / _machine()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # a home that cannot be written costs compile time, not the run
        return None
    return folder


def use_compilation_cache() -> Path | None:
    """Lets XLA keep compiled programs in `cache_folder`; returns the folder, or None where there is none.

    JAX's own setting (`JAX_COMPILATION_CACHE_DIR`) goes first.
    """
    import jax  # here: `cache_folder` is asked by what has no need of JAX

    if own := getattr(jax.config, "jax_compilation_cache_dir", None):
        return Path(own)
    if (folder := cache_folder()) is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_SECONDS)
        limit_size(folder)
    return folder


def limit_size(folder: Path, most: float | int = MOST_BYTES) -> None:
    """Removes the files of a cache that nobody has asked for longest, until the others are small enough."""
    known = []
    for path in folder.rglob("*"):
        with contextlib.suppress(OSError):  # another process may be as tidy
            if path.is_file():
                there = path.stat()
                known.append((max(there.st_atime, there.st_mtime), there.st_size, path))
    total = 0
    for _, size, path in sorted(known, reverse=True):
        total += size
        if total > most:
            with contextlib.suppress(OSError):
                path.unlink()


def trace_program(folder: Path, function: Callable[..., Any], shapes: Sequence[Any], structure: str) -> str:
    """Traces a function of arrays (positional) for arguments of some shapes, keeps the program and returns its name.

    Args:
        folder: the cache.
        function: of arrays, to arrays in lists and dictionaries.
        shapes: of the arguments, `jax.ShapeDtypeStruct`.
        structure: what else the program follows from, beside the source of this package: settings, the structure of trees.
    """
    import jax
    import jax.export

    from wbgs_jax._util.files import atomic_write

    words = [source_digest(), jax.__version__, jax.default_backend(), structure, *(f"{s.dtype} {s.shape}" for s in shapes)]
    name = hashlib.sha256("\n".join(words).encode()).hexdigest()[:32]
    path = folder / PROGRAMS / f"{name}.bin"
    if not path.exists():
        kernels = jax.export.DisabledSafetyCheck.custom_call(KERNEL_CALL)  # this file is of one version of JAX
        exported = jax.export.export(jax.jit(function), disabled_checks=[kernels])(*shapes)
        with atomic_write(path) as stream:
            stream.write(exported.serialize())
    return name


def load_program(folder: Path, name: str) -> Callable[..., Any]:
    """Returns a program that `trace_program` kept."""
    import jax
    import jax.export

    return jax.jit(jax.export.deserialize(bytearray((folder / PROGRAMS / f"{name}.bin").read_bytes())).call)


@cache
def source_digest() -> str:
    """Returns a checksum of this package's source."""
    found = hashlib.sha256()
    for path in sorted(SOURCES.rglob("*.py")):
        found.update(path.read_bytes())
    return found.hexdigest()


def _machine() -> str:
    """Returns a name for this kind of processor: compiled CPU code must not move to one that lacks its instructions."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    flags = next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
    return f"{platform.machine()}-{hashlib.sha256(flags.encode()).hexdigest()[:8]}"


def give_back() -> None:
    """Returns what was freed to the operating system. glibc keeps it, in pieces that large arrays do not fit into: gigabytes
    after a search. Other C libraries do without."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):  # not glibc
        return
    trim(0)
