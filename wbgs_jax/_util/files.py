"""Reading and writing of files.

Files are written under a temporary name in the same folder and then renamed, so that they are either complete or absent.

Array archives (.npz) may be damaged or not archives at all. Every error of NumPy, zipfile, zlib and Python's tokenizer about
them becomes one `UserError`. Python objects are never unpickled, as this would run code from the file.

A pytree of arrays is one archive of a run folder.

YAML files are small and written by hand. Anything but plain data is rejected, such as aliases that expand to gigabytes or very
deep nesting.
"""

import codecs
import contextlib
import csv
import dataclasses
import errno
import glob
import io
import json
import os
import re
import tempfile
import time
import zipfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import yaml

from wbgs_jax._util.errors import UserError

T = TypeVar("T")

try:
    import fcntl
except ImportError:  # on Windows, where stale files are not removed
    fcntl = None  # type: ignore[assignment]

STALE_S = 5.0
"""Age in seconds from which temporary files may be left over from a killed process."""


@contextlib.contextmanager
def atomic_write(path: Path | str) -> Iterator[IO[bytes]]:
    """Opens a temporary binary file that replaces `path` if the block succeeds and is removed otherwise.

    Raises:
        UserError: the file cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_left(path)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}; choose another folder or fix its permissions") from error
    try:
        with os.fdopen(handle, "wb") as stream:
            with contextlib.suppress(OSError, AttributeError):  # file systems without locks, platforms without `fcntl`
                fcntl.flock(stream, fcntl.LOCK_SH)
            yield stream
        umask = os.umask(0)
        os.umask(umask)
        Path(temporary).chmod(0o666 & ~umask)  # mkstemp makes files readable only by their owner
        Path(temporary).replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):  # the disk may have become read-only
            Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise UserError(
                f"cannot write {path}: {error.strerror or error}; free some space or choose another folder"
            ) from error
        raise


def check_writable(*paths: Path | None) -> None:
    """Raises a `UserError` if a file cannot be written, before the work whose results it will hold."""
    for path in filter(None, paths):
        try:
            folder = next(parent for parent in path.absolute().parents if parent.exists())
            tempfile.TemporaryFile(dir=folder).close()
            if path.is_dir():
                raise IsADirectoryError(errno.EISDIR, "it is a folder")
        except OSError as error:
            raise UserError(f"cannot write {path}: {error.strerror}; choose another place or fix its permissions") from error


def left_by_killed(path: Path) -> list[Path]:
    """Returns temporary files beside a file that were left by processes killed while writing it."""
    return [*path.parent.glob(f".{glob.escape(path.name)}.????????")] if path.parent.is_dir() else []


def _remove_left(path: Path) -> None:
    """Removes files left by killed processes. A process that is still writing holds a lock; one that has just started may not
    hold it yet."""
    for left in left_by_killed(path):
        with contextlib.suppress(OSError):
            if fcntl is not None and time.time() - left.stat().st_mtime >= STALE_S:
                with left.open("rb+") as stream:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    left.unlink()


def read_text(path: Path, other: str = "") -> str:
    """Returns the content of a text file.

    Args:
        path: of the file.
        other: encoding of files that are neither UTF-8 nor UTF-16; without it they are an error.

    Raises:
        UserError: anything else, including pipes, from which a read might never return.
    """
    try:
        if path.exists() and not path.is_file():
            raise UserError(f"{path} is not a file; put one in its place")
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}; the folder must contain it") from error
    except UnicodeDecodeError as error:
        if error.object[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            raise UserError(f"{path} is in UTF-16; save it as text in UTF-8") from error
        if other:
            return path.read_bytes().decode(other)
        raise UserError(f"{path} is not a text file ({error.reason}); copy it again") from error


def safe_name(name: str) -> str:
    """Returns a name from data as a safe file name: only letters, digits, blanks and -+._, without dots at the ends."""
    longest_name = 100  # characters: file systems allow 255, and endings are appended
    return re.sub(r"[^\w+. -]+", "_", name).strip("._ ")[:longest_name] or "data"


def read_csv(path: Path) -> tuple[list[str], Iterator[tuple[int, list[str]]]]:
    """Returns the names of the columns of a CSV file, in lower case, and its rows with their line numbers, without empty rows.

    Raises:
        UserError: the file is not a CSV file, names a column twice, or (from the iterator) a row has another number of cells.
    """
    rows = _csv_rows(path)
    names = [name.lower() for name in next(rows, (1, []))[1]]
    for sign, word in ((";", "semicolons"), ("\t", "tabs")):
        if len(names) == 1 and sign in names[0]:
            raise UserError(f"the columns of {path} are separated by {word}; write commas, and decimal points in numbers")
    if twice := [name for name in names if name and names.count(name) > 1]:
        raise UserError(f"{path} has two columns {twice[0]!r}; name every column once")
    return names, rows


def _csv_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yields the line number and the cells of every row that is not empty."""
    reader = csv.reader(io.StringIO(read_text(path)))
    count = None
    try:
        for row in reader:
            if not any(map(str.strip, row)):
                continue
            count = count or len(row)
            if len(row) != count:
                raise UserError(
                    f"line {reader.line_num} of {path} has {len(row)} cells, but the header has {count}; write decimal points, "
                    "and one cell per column"
                )
            yield reader.line_num, [cell.strip() for cell in row]
    except csv.Error as error:
        raise UserError(f"line {reader.line_num} of {path} is not CSV ({error}); check its quotation marks") from error


def write_csv(path: Path | str, rows: Iterable[Iterable[Any]]) -> None:
    """Writes rows, a header first, as a CSV file, atomically."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    with atomic_write(path) as stream:
        stream.write(text.getvalue().encode())


def write_json(path: Path | str, value: Any) -> None:
    """Writes `value` as indented JSON, atomically. NaN is rejected, since it indicates an error in the computation."""
    with atomic_write(path) as stream:
        stream.write((json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: Path | str) -> Any:
    """Returns the content of a JSON file.

    Raises:
        UserError: the file is missing or invalid.
    """
    path = Path(path)
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not valid JSON ({error}); it may be truncated: create it again") from error


MOST_BYTES = 8 * 2**30
"""Maximum size of an uncompressed archive."""


def read_arrays(path: Path, what: str, advice: str, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Returns the arrays of an .npz file by name.

    Args:
        path: of the file.
        what: kind of file, for messages, such as "scene file".
        advice: what to do if it cannot be read, for messages.
        names: arrays to read, as far as they exist; by default all.

    Raises:
        UserError: the file is missing, damaged, not an array archive, or expands to more than `MOST_BYTES`.
    """
    with opened_archive(path, what, advice) as archive:
        return {name: archive[name] for name in archive if names is None or name in names}


@contextlib.contextmanager
def opened_archive(path: Path, what: str, advice: str) -> Iterator["Archive"]:
    """Yields the arrays of an .npz file, each of which is read on access; otherwise like `read_arrays`."""
    where = f"{what} {path}".strip()
    with reported(where, advice):
        check_file(path, where, advice)
        with path.open("rb") as stream:
            if not zipfile.is_zipfile(stream):
                raise UserError(f"{where} is damaged or not an .npz archive; {advice}")
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as archive:
                check_size(archive.zip, path)
                yield Archive(archive, where, advice)


class Archive(dict[str, np.ndarray]):
    """Arrays by name; entries that are not arrays or cannot be read raise a `UserError`."""

    def __init__(self, archive: Any, where: str, advice: str):
        super().__init__(dict.fromkeys(archive.files))
        self._archive, self._where, self._advice = archive, where, advice

    def __getitem__(self, name: str) -> np.ndarray:
        with reported(f"{self._where}: {name!r}", self._advice):
            value = self._archive[name]
            if not isinstance(value, np.ndarray):
                raise UserError(f"{self._where} has the entry {name[:40]!r}, which is not an array; {self._advice}")
            return value


def check_file(path: Path, where: str, advice: str) -> None:
    """Raises a `UserError` for anything that is not a regular file: a folder, or a pipe, which might never deliver data."""
    if path.exists() and not path.is_file():
        raise UserError(f"{where} is not a file; {advice}")


def check_size(archive: zipfile.ZipFile, path: Path) -> None:
    """Raises a `UserError` for an archive that would fill the memory: a few kilobytes can expand to terabytes."""
    expanded = sum(entry.file_size for entry in archive.infolist())
    if expanded > MOST_BYTES:
        raise UserError(f"{path} expands to {expanded / 2**30:.1f} GiB, more than {MOST_BYTES / 2**30:g}; split it")


@contextlib.contextmanager
def reported(where: str, advice: str) -> Iterator[None]:
    """Converts any error of a parser to a `UserError` of one line.

    Args:
        where: description of the file, for the message.
        advice: what to do, for the message.
    """
    try:
        yield
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"cannot read {where}: {error.strerror or 'it is damaged'}; {advice}") from error
    except MemoryError as error:
        raise UserError(f"{where} is damaged, or larger than the memory; {advice}") from error
    except Exception as error:  # the parsers of several libraries raise many kinds of errors for damaged files
        raise UserError(f"{where} is damaged ({_reason(error)}); {advice}") from error


def _reason(error: Exception) -> str:
    """Returns a library's error message, short and on one line. NumPy's advice to unpickle is replaced."""
    words = " ".join(str(error).split())
    if "pickle" in words or "Object arrays" in words:
        return "it contains Python objects, which are never loaded"
    return words[:200] or type(error).__name__


class _PlainLoader(yaml.SafeLoader):
    """PyYAML's safe loader without aliases and repeated keys, and with decimal numbers only: YAML 1.1 also reads 010 as 8 and
    1:30 as 90."""

    deepest = 20
    """Maximum number of levels of nesting, far more than files of positions need."""
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Returns a node; aliases and very deep nesting are errors."""
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("it has an alias (*name); write the values out")
        self.depth += 1
        if self.depth > self.deepest:
            raise yaml.YAMLError(f"it is nested more than {self.deepest} levels deep")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
        """Returns the tag of a node; numbers that are not decimal are text."""
        tag = super().resolve(kind, value, implicit)
        numeric = tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
        decimal = r"[-+]?(0|[1-9]\d*|\d*\.\d*([eE][-+]?\d+)?|\.inf|\.nan)"
        return self.DEFAULT_SCALAR_TAG if numeric and not re.fullmatch(decimal, value, re.IGNORECASE) else tag

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Returns a mapping; repeated keys are errors."""
        found = super().construct_mapping(node, deep)
        if len(found) < len(node.value):
            keys = [key.value for key, _ in node.value]
            twice = next((key for key in keys if keys.count(key) > 1), keys[-1])
            raise yaml.YAMLError(f"it has the key {str(twice)[:40]!r} more than once")
        return found


def read_yaml(path: Path) -> Any:
    """Returns the content of a YAML file.

    Raises:
        UserError: the file is missing, damaged, too large, or uses aliases or very deep nesting.
    """
    text, largest = read_text(path), 1_000_000
    if len(text) > largest:
        raise UserError(f"{path} has {len(text):,} characters; a file of positions has far fewer than {largest:,}")
    try:
        return yaml.load(text, _PlainLoader)
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError) as error:  # ValueError: an invalid date
        raise UserError(f"{path} is not valid YAML ({' '.join(str(error).split())}); correct it") from error


def write_tree(path: Path, tree: Any) -> None:
    """Writes the arrays of a pytree under the names of its fields; None removes the file."""
    if tree is None:
        path.unlink(missing_ok=True)
        return
    arrays: dict[str, Any] = {f.name: np.asarray(getattr(tree, f.name)) for f in dataclasses.fields(tree)}
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **arrays)


def read_tree(path: Path, classes: Sequence[type[T]], without: str, before: Mapping[str, Any] | None = None) -> T | None:
    """Returns the pytree stored in a file, in single precision or in the smaller type it was written in; None if there is no
    file.

    Args:
        path: of the file.
        classes: possible classes; the first one with the file's fields is used.
        without: what removing the file means, for the message.
        before: values of arrays that older files lack.

    Raises:
        UserError: the file is damaged.
    """
    if not path.exists():
        return None
    advice = f"remove it to {without}, or train again"
    arrays = {name: np.asarray(value) for name, value in (before or {}).items()} | read_arrays(path, "", advice)
    fits = (cls for cls in classes if {f.name for f in dataclasses.fields(cls)} == arrays.keys())  # type: ignore[arg-type]
    with reported(str(path), advice):
        return next(fits, classes[-1])(**{name: _in_memory(value) for name, value in arrays.items()})


def _in_memory(value: np.ndarray) -> Any:
    import jax.numpy as jnp  # imported here because commands read files without JAX

    return jnp.asarray(value, value.dtype if value.dtype in (np.uint8, np.float16) else jnp.float32)  # images as stored
