"""Files that are either whole or absent: written under a temporary name beside the target, then renamed."""

import contextlib
import csv
import errno
import glob
import io
import json
import os
import re
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

from wbgs_jax._util.errors import UserError

try:
    import fcntl
except ImportError:  # not on Windows, where nothing is removed
    fcntl = None  # type: ignore[assignment]

STALE_S = 5.0
"""Age of temporary files that may be nobody's."""
LONGEST_NAME = 100
"""Characters: file systems take 255, and names get endings."""


@contextlib.contextmanager
def atomic_write(path: Path | str) -> Iterator[IO[bytes]]:
    """Opens a temporary binary file that replaces `path` when the block ends well and vanishes when it does not."""
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_left(path)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}; choose another folder or mend its permissions") from error
    try:
        with os.fdopen(handle, "wb") as stream:
            with contextlib.suppress(OSError, AttributeError):  # of a file system without locks, or without `fcntl`
                fcntl.flock(stream, fcntl.LOCK_SH)
            yield stream
        umask = os.umask(0)
        os.umask(umask)
        Path(temporary).chmod(0o666 & ~umask)  # mkstemp makes files that only their owner can read
        Path(temporary).replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):  # of a disk that has become read-only
            Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise UserError(
                f"cannot write {path}: {error.strerror or error}; free some space or choose another folder"
            ) from error
        raise


def check_writable(*paths: Path | None) -> None:
    """Raises a `UserError` for a file that cannot be written, before the work that it is for."""
    for path in filter(None, paths):
        try:
            folder = next(parent for parent in path.absolute().parents if parent.exists())
            tempfile.TemporaryFile(dir=folder).close()
            if path.is_dir():
                raise IsADirectoryError(errno.EISDIR, "it is a folder")
        except OSError as error:
            raise UserError(f"cannot write {path}: {error.strerror}; choose another place or mend its permissions") from error


def left_by_killed(path: Path) -> list[Path]:
    """Returns the temporary files beside a file, which a process that was killed while it wrote left there."""
    return [*path.parent.glob(f".{glob.escape(path.name)}.????????")] if path.parent.is_dir() else []


def _remove_left(path: Path) -> None:
    """Removes what killed processes left of a file. Who still writes holds a lock; who has just begun may not hold it yet."""
    for left in left_by_killed(path):
        with contextlib.suppress(OSError):
            if fcntl is not None and time.time() - left.stat().st_mtime >= STALE_S:
                with left.open("rb+") as stream:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    left.unlink()


def read_text(path: Path) -> str:
    """Returns the content of a text file; anything else is a `UserError`, a pipe too, which nobody may ever write to."""
    try:
        if path.exists() and not path.is_file():
            raise UserError(f"{path} is not a file; put one in its place")
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}; the folder must hold it") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not a text file ({error.reason}); copy it again") from error


def safe_name(name: str) -> str:
    """Returns a name, as data give it, that is no path: letters, digits, blanks and -+._ alone, and no dot at an end."""
    return re.sub(r"[^\w+. -]+", "_", name).strip("._ ")[:LONGEST_NAME] or "data"


def write_csv(path: Path | str, rows: Iterable[Iterable[Any]]) -> None:
    """Writes rows, a header first, as a CSV file, atomically."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    with atomic_write(path) as stream:
        stream.write(text.getvalue().encode())


def write_json(path: Path | str, value: Any) -> None:
    """Writes `value` as indented JSON, atomically. NaN is refused: a figure that is not a number is a mistake upstream."""
    with atomic_write(path) as stream:
        stream.write((json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: Path | str) -> Any:
    """Returns the content of a JSON file; a missing or broken one is a `UserError`."""
    path = Path(path)
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not valid JSON ({error}); it may be truncated: make it again") from error
