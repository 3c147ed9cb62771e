"""What a piece of work left in its folder, for comparison with undisturbed work."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from wbgs_jax.training import checkpoint

NAMES = {"seconds", "ms_per_pas", "ms_per_pas_single", "wall_seconds", "training_seconds", "evaluation_seconds", "environment"}
"""What differs between two runs."""


def outcome(folder: Path) -> dict[str, Any]:
    """Returns every file below a folder by name, as numbers or bytes; without times and without what belongs to no result."""
    found: dict[str, Any] = {}
    for steps in {path.parent for path in folder.rglob("state") if path.parent.name.isdigit()}:
        found |= {str(steps.relative_to(folder)): checkpoint.read(steps.parent, int(steps.name)).metadata.keys()}
        saved = checkpoint.read(steps.parent, int(steps.name))
        found[str(steps.relative_to(folder))] = _plain(saved.state | {f"field{k}": v for k, v in saved.field.items()})
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_dir() or any(part.isdigit() for part in Path(name).parts[:-1]) or "locks" in name:
            continue
        found[name] = _content(path, str(folder))
    return found


def _content(path: Path, folder: str) -> Any:
    if path.suffix == ".npz" and path.name not in ("scene.npz",):
        with np.load(path) as archive:
            return _plain({key: archive[key] for key in archive if key not in NAMES})
    if path.suffix in (".json", ".jsonl"):
        lines = [path.read_text()] if path.suffix == ".json" else path.read_text().splitlines()
        return [_timeless(json.loads(line.replace(folder, "")), path.name) for line in lines]
    return path.read_bytes()


def _plain(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    return {key: (value.dtype.str, value.shape, np.ascontiguousarray(value).tobytes()) for key, value in arrays.items()}


def _timeless(value: Any, name: str) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(inner, name) for key, inner in value.items() if key not in NAMES}
    return [_timeless(inner, name) for inner in value] if isinstance(value, list) else value
