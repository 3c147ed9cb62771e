"""Chooses the backend of Sionna RT before sionna or mitsuba is imported: an NVIDIA GPU, or the CPU through libLLVM.

On the CPU, Dr.Jit needs LLVM 17 or newer (14 is rejected; 15 and 16 abort inside the solver). An abort kills the process, so
each candidate is first tried in a child process, and only one that succeeded there is used here.
"""

import functools
import importlib.metadata
import os
import re
import subprocess
import sys
from pathlib import Path

from wbgs_jax._util.errors import UserError

VARIABLE = "DRJIT_LIBLLVM_PATH"
"""Environment variable with the path of the library; no other library is tried if it is set."""
MINIMUM_VERSION = 17
NOT_INSTALLED = "sionna-rt is not installed; install it with: pip install 'wbgs-jax[data]'"
ADVICE = f"install one (Debian, Ubuntu: apt-get install libllvm19) or set {VARIABLE} to the library file"
CUDA, LLVM = "cuda", "llvm"

_FOLDERS = ("usr/lib/*-linux-gnu", "usr/lib64", "usr/lib", "usr/lib/llvm-*/lib", "usr/local/lib", "opt/homebrew/opt/llvm*/lib")
_PATTERNS = ("libLLVM.so*", "libLLVM-*.so*", "libLLVM*.dylib")

# Reflection and diffraction in a box: the smallest solve that reaches the instructions LLVM 15 and 16 abort on.
_PROBE = """
import mitsuba
mitsuba.set_variant("{variant}_ad_mono_polarized")
import sionna.rt as rt
scene = rt.load_scene(rt.scene.box)
scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
scene.add(rt.Transmitter("tx", position=[0.5, 0, 1]))
scene.add(rt.Receiver("rx", position=[-0.5, 0, 1]))
paths = rt.PathSolver(deterministic=True)(scene, max_depth=1, samples_per_src=100, max_num_paths_per_src=100, diffraction=True)
assert paths.tau.shape[-1] > 0
"""
_PROBE_SECONDS = 300


def ensure_backend() -> str:
    """Makes `import sionna.rt` safe in this process: probes the available backends (a few seconds, once per process) and
    chooses.

    Returns:
        "cuda", or "llvm" with DRJIT_LIBLLVM_PATH set.

    Raises:
        UserError: sionna-rt is not installed, or neither a GPU nor a usable libLLVM was found.
    """
    backend = find_backend()
    use_backend(backend)
    return backend[0]


def use_backend(backend: tuple[str, str]) -> None:
    """Selects a backend, a result of `find_backend`, without probing again."""
    kind, library = backend
    if kind == LLVM:
        os.environ[VARIABLE] = library
    import mitsuba

    # Otherwise Sionna chooses by itself, wrongly if a GPU exists but does not work.
    mitsuba.set_variant(f"{kind}_ad_mono_polarized")


def find_backend() -> tuple[str, str]:
    """Returns the backend to use: ("cuda", "") or ("llvm", library file).

    If DRJIT_LIBLLVM_PATH is set, no other library is tried.
    """
    try:
        importlib.metadata.version("sionna-rt")
    except importlib.metadata.PackageNotFoundError:
        raise UserError(NOT_INSTALLED) from None
    # nvidia-smi first: without a driver the CUDA probe would only cost time.
    if _succeeds(["nvidia-smi", "-L"]) and probe(CUDA):
        return CUDA, ""
    wanted = os.environ.get(VARIABLE)
    candidates = [wanted] if wanted else [str(path) for path in find_libraries()]
    for library in candidates:
        if probe(LLVM, library):
            return LLVM, library
    tried = f"{', '.join(candidates)} does not work" if candidates else "none was found"
    raise UserError(f"Sionna RT needs libLLVM {MINIMUM_VERSION} or newer and {tried}; {ADVICE}")


def find_libraries() -> list[Path]:
    """Returns libLLVM files of a sufficient version in the usual folders, newest first, unknown versions last."""
    found: dict[Path, int] = {}
    for folder in _FOLDERS:
        for pattern in _PATTERNS:
            for path in Path("/").glob(f"{folder}/{pattern}"):
                version = library_version(path)
                if version is None or version >= MINIMUM_VERSION:
                    found[path.resolve()] = version or 0
    return sorted(found, key=lambda path: (-found[path], str(path)))


def library_version(path: Path) -> int | None:
    """Returns the major version in the name of a libLLVM file (libLLVM.so.19.1, libLLVM-17.so.1) after resolving links; or
    None."""
    match = re.search(r"libLLVM(?:-|\.so\.|\.)(\d+)", path.resolve().name)
    return int(match.group(1)) if match else None


@functools.cache
def probe(kind: str, library: str = "") -> bool:
    """Returns whether a small solve in a child process succeeds (seconds; up to a minute the first time, for compilation)."""
    environment = {VARIABLE: library} if library else {}
    return _succeeds([sys.executable, "-c", _PROBE.format(variant=kind)], environment)


def _succeeds(command: list[str], environment: dict[str, str] | None = None) -> bool:
    everything = os.environ | (environment or {})
    try:
        done = subprocess.run(command, env=everything, capture_output=True, timeout=_PROBE_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0
