"""Whether tests notice wrong code: `python -m tools.qa.mutation [--only slab] [--number 20]` (needs the extra `mutation`).

cosmic-ray writes every small error into a module that it knows (another operator, number, comparison); some of these mutants
are drawn, one after the other goes into a copy of the tree, and the module's tests run. A mutant that they let pass is a
survivor: docs/reliability.md names a test that was added for it, or says why it does no harm. Writes
experiments/results/mutation.json.
"""

import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.results import FOLDER
from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_json, write_json
from wbgs_jax.evaluation.report import environment

ROOT = Path(__file__).parents[2]
MODULES = {
    "splat/composite": ("splat",),
    "splat/projection": ("splat",),
    "radio/array": ("radio",),
    "propagation/materials": ("propagation/test_slab.py", "propagation/test_transport.py"),
    "propagation/utd": ("propagation/test_utd.py", "propagation/test_transport.py"),
    "propagation/image_method": ("propagation/test_paths.py", "propagation/test_transport.py"),
}
"""Modules whose formulas everything rests on, and their tests."""
SENSELESS = ("Shift", "Bit", "Mod", "FloorDiv", "ExceptionReplacer")
"""Operators that break any number or annotation: whatever runs notices, and the share of what is noticed would be flattered."""
PATIENCE = 4.0
"""Times the unchanged code's: a mutant that takes longer hangs, and is noticed."""


@dataclass(frozen=True)
class Command:
    """Draw mutants of a module and see whether its tests notice."""

    only: tuple[str, ...] = ()
    """Modules (slab, array, ...); all by default."""
    number: int = 20
    """Number of mutants of a module."""
    seed: int | None = None
    """Seed of the mutants that are drawn; a new one by default."""
    out: Path = FOLDER


def mutants(path: Path) -> list[Any]:
    """Returns all changes of a module that make sense."""
    from cosmic_ray.commands.init import _all_work_items  # the command line gives nothing but a whole session

    specs = [item.mutations[0] for item in _all_work_items([path], {})]
    return [spec for spec in specs if not any(word in spec.operator_name for word in SENSELESS)]


def environment_of_tests(folder: Path, seed: int) -> dict[str, str]:
    """Returns the environment of the tests: compiled programs that a mutant leaves alone are found again."""
    return os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
        "WBGS_TEST_SEED": str(seed),
        "PYTHONDONTWRITEBYTECODE": "1",
    }


def passes(tree: Path, tests: tuple[str, ...], seed: int, limit: float | None = None) -> bool:
    """Returns whether a module's tests pass in a tree."""
    options = ["-x", "-q", "-m", "not slow", "-p", "no:cacheprovider"]
    words = [sys.executable, "-m", "pytest", *options, *(f"tests/{name}" for name in tests)]
    try:
        done = subprocess.run(
            words, cwd=tree, env=environment_of_tests(tree.parent, seed), capture_output=True, timeout=limit, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def changed_lines(before: str, after: str) -> str:
    """Returns the first line that differs, as it was and as it is."""
    pairs = zip(before.splitlines(), after.splitlines(), strict=False)
    return next((f"{old.strip()}  ->  {new.strip()}" for old, new in pairs if old != new), "")


def tried(tree: Path, module: str, number: int, seed: int) -> Iterator[tuple[Any, str, bool]]:
    """Yields mutants of a module, what they change, and whether they survive."""
    from cosmic_ray.mutating import use_mutation
    from cosmic_ray.plugins import get_operator

    path = tree / "wbgs_jax" / f"{module}.py"
    begin = time.perf_counter()
    if not passes(tree, MODULES[module], seed):
        raise UserError(f"the tests of {module} fail as the code stands; fix them first")
    limit = PATIENCE * (time.perf_counter() - begin)
    specs = mutants(path)
    for spec in random.Random(seed).sample(specs, min(number, len(specs))):
        operator = get_operator(spec.operator_name)(**spec.operator_args)
        with use_mutation(path, operator, spec.occurrence) as (before, after):
            yield spec, changed_lines(before, after or before), passes(tree, MODULES[module], seed, limit)


def account(tree: Path, module: str, number: int, seed: int) -> dict[str, Any]:
    """Returns how many mutants of a module were tried and noticed, and those that were not."""
    survivors, noticed = [], 0
    for spec, change, survives in tried(tree, module, number, seed):
        noticed += not survives
        if survives:
            survivors.append({"line": spec.start_pos[0], "in": spec.definition_name or "", "change": change})
            say(f"{module}:{spec.start_pos[0]} survives: {change}")
    return {"tried": noticed + len(survivors), "noticed": noticed, "seed": seed, "survivors": survivors}


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="python -m tools.qa.mutation")
    try:
        import cosmic_ray  # noqa: F401
    except ImportError:
        raise UserError("cosmic-ray is not installed; install it with: pip install 'wbgs-jax[mutation]'") from None
    wanted = [module for module in MODULES if not command.only or module.split("/")[-1] in command.only]
    if not wanted:
        raise UserError(f"there is no such module; choose among: {', '.join(name.split('/')[-1] for name in MODULES)}")
    seed = int.from_bytes(os.urandom(4)) if command.seed is None else command.seed
    path = command.out / "mutation.json"
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(tree)], check=True)
        for module in wanted:
            found = account(tree, module, command.number, seed) | {"environment": environment()}
            known = read_json(path) if path.exists() else {}
            write_json(path, known | {module: found})
            say(f"{module}: {found['noticed']} of {found['tried']} were noticed; {path}")


if __name__ == "__main__":
    run_command(main)
