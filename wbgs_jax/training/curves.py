"""Training curves of a run: metrics.jsonl has one JSON object per line, each with the step at which it was written."""

import contextlib
import json
from pathlib import Path
from typing import Any

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write


def append(path: Path, entry: dict[str, Any]) -> None:
    """Appends an entry.

    Raises:
        UserError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as stream:
            stream.write(json.dumps(entry) + "\n")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}; free some space or choose another OUT") from error


def read(path: Path) -> list[dict[str, Any]]:
    """Returns all entries; an empty list if the file does not exist. Invalid lines are skipped."""
    return [entry for _, entry in _entries(path)]


def forget_after(path: Path, step: int) -> None:
    """Removes entries after the step of the checkpoint that a run resumes from (these steps are repeated), and truncated
    lines."""
    if path.exists():
        kept = [line for line, entry in _entries(path) if entry["step"] <= step]
        with atomic_write(path) as stream:
            stream.write("".join(line + "\n" for line in kept).encode())


def _entries(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """Returns lines with their entries. Curves are only displayed, so that damaged lines are skipped without an error."""
    found = []
    for line in path.read_bytes().decode(errors="replace").splitlines() if path.is_file() else ():
        with contextlib.suppress(ValueError, RecursionError):
            entry = json.loads(line)
            if isinstance(entry, dict) and isinstance(entry.get("step"), int):
                found.append((line, entry))
    return found
