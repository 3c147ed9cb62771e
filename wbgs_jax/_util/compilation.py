"""Persistent cache of compiled programs: what one command has traced and compiled, the next one loads.

The library never enables it by itself, since other JAX programs have their own caches.
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
"""Environment variable with the folder of the cache; an empty value disables it."""
MIN_SECONDS = 0.5
"""Compile time in seconds below which programs are not kept."""
PROGRAMS = "programs"
"""Subfolder of the cache for traced programs."""


def cache_folder() -> Path | None:
    """Returns the folder in which commands keep programs, `WBGS_CACHE` (default ~/.cache/wbgs-jax); None if there is none."""
    try:
        wanted = os.environ.get(VARIABLE) if VARIABLE in os.environ else str(Path.home() / ".cache" / "wbgs-jax")
    except RuntimeError:  # no home directory
        wanted = None
    if not wanted:
        return None
    folder = Path(wanted) / _machine()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # without a writable home, programs are compiled again
        return None
    return folder


def use_compilation_cache() -> Path | None:
    """Makes XLA keep compiled programs in `cache_folder`; returns the folder in use, or None.

    JAX's own setting (`JAX_COMPILATION_CACHE_DIR`) takes precedence.
    """
    import jax  # imported here because `cache_folder` is used by code that does not need JAX

    if own := getattr(jax.config, "jax_compilation_cache_dir", None):
        return Path(own)
    if (folder := cache_folder()) is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_SECONDS)
        limit_size(folder)
    return folder


def has_compiled(function: str) -> bool:
    """Returns whether the cache in use contains a program of a compiled function, by its name: if one has been compiled before,
    so have most others of the same command."""
    import jax

    folder = getattr(jax.config, "jax_compilation_cache_dir", None)
    return folder is not None and any(Path(folder).glob(f"jit_{function}-*"))


def limit_size(folder: Path, most: float | int = 2e9) -> None:
    """Removes the least recently used files of a cache until the others have at most `most` bytes."""
    entries = []
    for path in folder.rglob("*"):
        with contextlib.suppress(OSError):  # another process may be removing files too
            if path.is_file():
                there = path.stat()
                entries.append((max(there.st_atime, there.st_mtime), there.st_size, path))
    total = 0
    for _, size, path in sorted(entries, reverse=True):
        total += size
        if total > most:
            with contextlib.suppress(OSError):
                path.unlink()


def trace_program(folder: Path, function: Callable[..., Any], shapes: Sequence[Any], structure: str) -> str:
    """Traces a function of positional arrays, stores the program and returns its name.

    Args:
        folder: the cache.
        function: from arrays to arrays in lists and dictionaries.
        shapes: of the arguments, `jax.ShapeDtypeStruct`.
        structure: everything else that determines the program, besides the source of this package: settings and the structure
            of trees.
    """
    import jax
    import jax.export

    from wbgs_jax._util.files import atomic_write

    words = [source_digest(), jax.__version__, jax.default_backend(), structure, *(f"{s.dtype} {s.shape}" for s in shapes)]
    name = hashlib.sha256("\n".join(words).encode()).hexdigest()[:32]
    path = folder / PROGRAMS / f"{name}.bin"
    if not path.exists():
        # JAX does not guarantee the stability of the renderer's GPU kernels; the file is used by one version of JAX only.
        kernels = jax.export.DisabledSafetyCheck.custom_call("__gpu$xla.gpu.triton")
        exported = jax.export.export(jax.jit(function), disabled_checks=[kernels])(*shapes)
        with atomic_write(path) as stream:
            stream.write(exported.serialize())
    return name


def load_program(folder: Path, name: str) -> Callable[..., Any]:
    """Returns a program stored by `trace_program`."""
    import jax
    import jax.export

    return jax.jit(jax.export.deserialize(bytearray((folder / PROGRAMS / f"{name}.bin").read_bytes())).call)


@cache
def source_digest() -> str:
    """Returns a checksum of this package's source."""
    found = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        found.update(path.read_bytes())
    return found.hexdigest()


def _machine() -> str:
    """Returns a key for this kind of processor: compiled CPU code must not run on one that lacks its instructions."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    flags = next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
    return f"{platform.machine()}-{hashlib.sha256(flags.encode()).hexdigest()[:8]}"


def give_back() -> None:
    """Returns freed memory to the operating system. glibc keeps it in fragments too small for large arrays: gigabytes after a
    calibration. With other C libraries this does nothing."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):  # not glibc
        return
    trim(0)
