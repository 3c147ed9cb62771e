"""One training a folder: two would write over each other's curves and checkpoints."""

import contextlib
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

from wbgs_jax._util.errors import UserError

try:
    import fcntl
except ImportError:  # not on Windows, where nobody is kept out
    fcntl = None  # type: ignore[assignment]

FILE = "training.lock"


class Taken(UserError):
    """Another process has the folder."""


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keeps a run folder for this process while the block runs; the lock goes with the process, however that ends.

    Raises:
        Taken: another process has it; the message says which.
    """
    with (folder / FILE).open("a+") as stream:
        if fcntl is not None:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                stream.seek(0)
                holder = stream.read(200).strip() or "another process"
                raise Taken(f"{folder} is being trained by {holder}; wait for it, or choose another OUT") from None
            except OSError:  # some clusters' file systems know no locks
                warnings.warn(f"{folder} cannot be locked on its file system; train one run there at a time", stacklevel=3)
        stream.truncate(0)
        stream.write(f"process {os.getpid()}")
        stream.flush()
        yield
    (folder / FILE).unlink(missing_ok=True)
