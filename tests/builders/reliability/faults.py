"""Faults for a process of its own: killed, or told that the disk is full or read-only, at the n-th write below a folder.

Python tells an audit hook of every file that is opened, renamed, made or removed, before it happens; so the product runs as it
is. Orbax writes arrays in C++, of which the hook hears nothing: kills at random times and a small disk reach that.
"""

import errno
import mmap
import os
import signal
import struct
import sys
from dataclasses import dataclass
from typing import Any

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGES = ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod", "os.link", "os.symlink")
GROWING = ("open", "os.mkdir", "os.link", "os.symlink")
"""What wants space: a full disk refuses these, and lets files be renamed and removed."""
ERRORS = {"full": errno.ENOSPC, "read-only": errno.EROFS, "denied": errno.EACCES, "broken": errno.EIO}


@dataclass(frozen=True)
class Fault:
    """What happens at a write."""

    kind: str = "none"
    """"kill", one of `ERRORS`, or "none": writes are counted."""
    at: int = 0
    """At which write, counted from 1; of errors, at all that follow too."""
    after_s: float = 0.0
    """Kill after this time instead."""
    signal: int = signal.SIGKILL
    """What kills."""


class Counter:
    """A number that a child counts and its parent reads, however the child ends."""

    def __init__(self) -> None:
        self.memory = mmap.mmap(-1, 8)

    @property
    def value(self) -> int:
        return int(struct.unpack("q", self.memory[:8])[0])

    def add(self) -> int:
        self.memory[:8] = struct.pack("q", self.value + 1)
        return self.value


def install(fault: Fault, folder: str, counter: Counter) -> None:
    """Lets the fault happen in this process; there is no way back."""

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if not _writes(event, arguments, folder):
            return
        number = counter.add()
        if fault.kind == "kill" and number == fault.at:
            os.kill(os.getpid(), fault.signal)
        refused = event in GROWING or fault.kind not in ("full", "none")
        if fault.kind in ERRORS and number >= fault.at and refused:
            code = ERRORS[fault.kind]
            raise OSError(code, os.strerror(code), str(arguments[0]))

    sys.addaudithook(hook)


def _writes(event: str, arguments: tuple[Any, ...], folder: str) -> bool:
    if event == "open":
        path, mode, flags = arguments
        writing = bool(flags & WRITING) if isinstance(flags, int) and mode is None else bool(set(mode or "") & set("wax+"))
    elif event in CHANGES:
        path, writing = arguments[0], True
    else:
        return False
    return writing and isinstance(path, str | bytes | os.PathLike) and os.fsdecode(path).startswith(folder)
