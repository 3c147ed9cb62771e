"""The curves of a run: metrics.jsonl, a JSON object a line, each with the step it was written at."""

import contextlib
import json
from pathlib import Path
from typing import Any

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write


def append(path: Path, entry: dict[str, Any]) -> None:
    """Appends a line; a file that cannot be written is a `UserError`."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as stream:
            stream.write(json.dumps(entry) + "\n")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}; free some space or choose another OUT") from error


def read(path: Path) -> list[dict[str, Any]]:
    """Returns all entries; of a file that is not there, none. Lines that are none are left out."""
    return [entry for _, entry in _entries(path)]


def forget_after(path: Path, step: int) -> None:
    """Drops entries after the checkpoint that a run resumes from (those steps are done again), and a line cut short."""
    if path.exists():
        kept = [line for line, entry in _entries(path) if entry["step"] <= step]
        with atomic_write(path) as stream:
            stream.write("".join(line + "\n" for line in kept).encode())


def _entries(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """Returns lines and what they hold. A curve is there to be looked at: a damaged line is no reason to stop."""
    found = []
    for line in path.read_bytes().decode(errors="replace").splitlines() if path.is_file() else ():
        with contextlib.suppress(ValueError, RecursionError):
            entry = json.loads(line)
            if isinstance(entry, dict) and isinstance(entry.get("step"), int):
                found.append((line, entry))
    return found
