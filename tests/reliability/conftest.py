"""What tests of faults share: a process to fork from, what it works on, and results to compare with."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.reliability.forking import Ended, Forks

from wbgs_jax.training import checkpoint

WITHOUT_A_RUN = ("train", "write", "run", "generate", "lay out", "measure")
"""Pieces of work that do not ask a trained field."""
NAMES = {"seconds", "ms_per_pas", "ms_per_pas_single", "wall_seconds", "training_seconds", "evaluation_seconds", "environment"}
"""What differs between two runs."""


@pytest.fixture(scope="session")
def forks(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Forks]:
    folder = tmp_path_factory.mktemp("programs")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
    found = Forks()
    yield found
    found.close()


@pytest.fixture(scope="session")
def base(forks: Forks, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with everything that pieces of work start from."""
    folder = tmp_path_factory.mktemp("base") / "base"
    folder.mkdir()
    done = forks.run("prepare", folder)
    assert done.code == 0, done.err
    return folder


@pytest.fixture(scope="session")
def fresh(base: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Makes a folder for a piece of work."""

    def make(work: str) -> Path:
        folder = tmp_path_factory.mktemp("work") / "w"
        shutil.copytree(base, folder)
        if work.split()[0] not in WITHOUT_A_RUN and work not in WITHOUT_A_RUN:
            shutil.copytree(base / "run_base", folder / "run")
        return folder

    return make


@pytest.fixture(scope="session")
def undisturbed(forks: Forks, fresh: Callable[[str], Path]) -> Callable[[str], tuple[Ended, dict[str, Any]]]:
    """Does a piece of work without faults, once: how it ended, and its result."""
    known: dict[str, tuple[Ended, dict[str, Any]]] = {}

    def do(work: str) -> tuple[Ended, dict[str, Any]]:
        if work not in known:
            folder = fresh(work)
            done = forks.run(work, folder)
            assert done.code == 0, done.err
            known[work] = done, outcome(folder)
        return known[work]

    return do


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
