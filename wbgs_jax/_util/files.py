"""Files that are either whole or absent: written under a temporary name beside the target, then renamed.

Archives of arrays (.npz) as they come from disk: damaged, from elsewhere, or no archives at all.

Whatever NumPy, zipfile, zlib and Python's tokenizer make of damaged bytes, it is one `UserError` in words of our own. Python
objects are never read: unpickling them would run whatever the file says.

Small YAML files that people write. What is no plain data is refused: aliases that unfold to gigabytes, endless nesting.
"""

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
import zipfile
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import yaml

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


MOST_BYTES = 8 * 2**30
"""That a file may unfold to."""


def read_arrays(path: Path, what: str, advice: str, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Returns the arrays of an .npz file by name.

    Args:
        path: of the file.
        what: it is, for the message, such as "scene file".
        advice: what to do where it cannot be read.
        names: of the arrays that are wanted, where they are there; by default all.

    Raises:
        UserError: the file is missing, damaged, no archive of arrays, or unfolds to more than `MOST_BYTES`.
    """
    with opened_archive(path, what, advice) as archive:
        return {name: archive[name] for name in archive if names is None or name in names}


@contextlib.contextmanager
def opened_archive(path: Path, what: str, advice: str) -> Iterator["Archive"]:
    """Gives the arrays of an .npz file, each read when it is asked for; otherwise as `read_arrays`."""
    where = f"{what} {path}".strip()
    with told(where, advice):
        check_file(path, where, advice)
        with path.open("rb") as stream:
            if not zipfile.is_zipfile(stream):
                raise UserError(f"{where} is damaged or no .npz archive; {advice}")
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as archive:
                check_size(archive.zip, path)
                yield Archive(archive, where, advice)


class Archive(dict[str, np.ndarray]):
    """Arrays by name; what is no array, or cannot be read, is a `UserError`."""

    def __init__(self, archive: Any, where: str, advice: str):
        super().__init__(dict.fromkeys(archive.files))
        self._archive, self._where, self._advice = archive, where, advice

    def __getitem__(self, name: str) -> np.ndarray:
        with told(f"{self._where}: {name!r}", self._advice):
            value = self._archive[name]
            if not isinstance(value, np.ndarray):
                raise UserError(f"{self._where} holds {name[:40]!r}, which is no array; {self._advice}")
            return value


def check_file(path: Path, where: str, advice: str) -> None:
    """Raises a `UserError` for what is no file: a folder, or a pipe that nobody may ever write to."""
    if path.exists() and not path.is_file():
        raise UserError(f"{where} is not a file; {advice}")


def check_size(archive: zipfile.ZipFile, path: Path) -> None:
    """Raises a `UserError` for an archive that would fill the memory: a few kilobytes can unfold to terabytes."""
    unfolded = sum(entry.file_size for entry in archive.infolist())
    if unfolded > MOST_BYTES:
        raise UserError(f"{path} unfolds to {unfolded / 2**30:.1f} GiB, more than {MOST_BYTES / 2**30:g}; split it")


@contextlib.contextmanager
def told(where: str, advice: str) -> Iterator[None]:
    """Turns whatever a parser of other people's files raises into a `UserError` of one line."""
    try:
        yield
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"cannot read {where}: {error.strerror or 'it is damaged'}; {advice}") from error
    except MemoryError as error:
        raise UserError(f"{where} is damaged, or larger than the memory; {advice}") from error
    except Exception as error:  # of many kinds, from a handful of libraries: none of them is a mistake of ours
        raise UserError(f"{where} is damaged ({_reason(error)}); {advice}") from error


def _reason(error: Exception) -> str:
    """Returns what a library says, on one line and short; NumPy's advice to unpickle is nobody's."""
    words = " ".join(str(error).split())
    if "pickle" in words or "Object arrays" in words:
        return "it holds Python objects, which are never read"
    return words[:200] or type(error).__name__


LARGEST, DEEPEST = 1_000_000, 20
"""Characters, and levels of nesting: no file of positions comes near."""


class _PlainLoader(yaml.SafeLoader):
    """PyYAML's safe loader without aliases."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Returns a node; an alias or too deep a one is an error."""
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("it has an alias (*name); write the values out")
        self.depth += 1
        if self.depth > DEEPEST:
            raise yaml.YAMLError(f"it is nested more than {DEEPEST} levels deep")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def read_yaml(path: Path) -> Any:
    """Returns the content of a YAML file; a missing, damaged or outlandish one is a `UserError`."""
    text = read_text(path)
    if len(text) > LARGEST:
        raise UserError(f"{path} has {len(text):,} characters; a file of positions has far fewer than {LARGEST:,}")
    try:
        return yaml.load(text, _PlainLoader)
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError) as error:  # ValueError: an impossible date
        raise UserError(f"{path} is not valid YAML ({' '.join(str(error).split())}); mend it") from error
