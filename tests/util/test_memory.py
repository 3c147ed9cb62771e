"""Memory that was freed in pieces is given back."""

import ctypes
from pathlib import Path

import pytest

from wbgs_jax._util.compilation import give_back

PIECES, SIZE = 3000, 100_000
"""In all 300 MB, each below the size from which glibc asks the operating system for every array by itself."""


def resident() -> int:
    """Bytes of this process that are in memory."""
    return 1024 * next(int(line.split()[1]) for line in Path("/proc/self/status").read_text().splitlines() if "VmRSS" in line)


def test_what_was_freed_in_pieces_is_given_back():
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "malloc_trim") or not Path("/proc/self/status").exists():
        pytest.skip("the C library is not glibc: there is nothing to give back")
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    libc.free.argtypes = [ctypes.c_void_p]
    pieces = [libc.malloc(SIZE) for _ in range(PIECES)]
    for piece in pieces:
        ctypes.memset(piece, 1, SIZE)
    for piece in pieces[:-1]:
        libc.free(piece)
    held = resident()
    give_back()
    assert resident() < held - 0.8 * PIECES * SIZE
    libc.free(pieces[-1])
    give_back()
