"""Bring a trained field up to date with a few new links, after something in the room may have changed:

wbgs-jax update --run RUN --data NEW.npz --out RUN2 [--false-alarms 0.05]
"""

import wbgs_jax._util.quiet  # noqa: F401, before JAX is loaded

# isort: split

import shlex
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from wbgs_jax._util.cli import run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.errors import UserError
from wbgs_jax.commands.options import TrainedFieldOptions

LARGEST = 0.5
"""Largest rate of false alarms; a higher one makes no test."""


@dataclass(frozen=True)
class Command(TrainedFieldOptions):
    """Find what has changed in a room from a few new links, and bring a trained field with paths up to date."""

    data: Path | None = None
    """Scene file (.npz) or folder of the new links, with a receiver of the training (docs/formats.md)."""
    out: Path | None = None
    """New run folder, which is written only if something has changed."""
    false_alarms: float = 0.05
    """Probability of finding a change where there is none."""


def check(command: Command) -> None:
    """Raises a `UserError` for an invalid or incomplete command line."""
    folder = command.folder  # one is named
    if command.data is None:
        raise UserError("give the new links: --data NEW.npz")
    if command.out is None:
        raise UserError("give a folder for the updated run: --out RUN2")
    if command.out.resolve() == folder.resolve():
        raise UserError(f"--out {command.out} is the run itself, which is kept as it is; choose another folder")
    if command.out.exists() and (not command.out.is_dir() or any(command.out.iterdir())):
        raise UserError(f"{command.out} holds other files; choose another --out")
    if not 0 < command.false_alarms <= LARGEST:
        raise UserError(f"--false-alarms {command.false_alarms:g} is not a probability; give more than 0 and at most {LARGEST}")


def update(command: Command) -> None:
    """Tests whether the room has changed, finds what has, and writes the updated run."""
    from wbgs_jax.training.run_folder import open_run
    from wbgs_jax.training.update import check_new, lines_of, updated, write_run

    assert command.data is not None and command.out is not None, "checked"
    begin = time.monotonic()
    trained = open_run(command.folder)
    old = trained.dataset()
    new = check_new(trained.config.other_data(str(command.data)), old)
    found = updated(trained, old, new, command.false_alarms, say)
    for line in found.remarks:
        say(line)
    p_value = found.notice.p_value
    if p_value > command.false_alarms:
        print(f"nothing has changed (p = {p_value:.3g}): {command.folder} holds, and nothing is written")
        return
    if not found.changes and not found.gain_db:
        print(f"something has changed (p = {p_value:.3g}), but no object explains it: measure more links, or train again")
        return
    print(f"the room has changed (p = {p_value:.3g})")
    for line in lines_of(found, old):
        print(line)
    write_run(command.out, found, old)
    say(f"{time.monotonic() - begin:.0f} s; the updated run: {command.out}")
    say(f"next: wbgs-jax view --run {shlex.quote(str(command.out))}")


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="wbgs-jax update")
    check(command)
    use_compilation_cache()
    update(command)


if __name__ == "__main__":
    run_command(main)
