"""Archives of arrays (.npz) as they come from disk: damaged, from elsewhere, or no archives at all.

Whatever NumPy, zipfile, zlib and Python's tokenizer make of damaged bytes, it is one `UserError` in words of our own. Python
objects are never read: unpickling them would run whatever the file says.
"""

import contextlib
import zipfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from wbgs_jax._util.errors import UserError

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
