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
    """Returns all entries; of a file that is not there, none."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def forget_after(path: Path, step: int) -> None:
    """Drops entries after the checkpoint that a run resumes from (those steps are done again), and a line cut short."""
    if path.exists():
        kept = []
        for line in path.read_text().splitlines():
            with contextlib.suppress(ValueError):
                kept += [line] * (json.loads(line)["step"] <= step)
        with atomic_write(path) as stream:
            stream.write("".join(line + "\n" for line in kept).encode())
