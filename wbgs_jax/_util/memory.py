"""Memory that is free goes back to the operating system."""

import ctypes


def give_back() -> None:
    """Returns what was freed to the operating system. glibc keeps it, in pieces that large arrays do not fit into: gigabytes
    after a search. Other C libraries do without."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):  # not glibc
        return
    trim(0)
