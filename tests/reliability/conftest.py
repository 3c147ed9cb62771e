"""What tests of faults share: a process to fork from, what it works on, and results to compare with."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from builders.reliability.forking import Ended, Forks
from builders.reliability.outcomes import outcome

WITHOUT_A_RUN = ("train", "write", "run", "generate", "lay out", "measure")
"""Pieces of work that do not ask a trained field."""


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
