"""Makes the trained field that comes with the package (`wbgs-jax view --example`): python -m tools.example_field

Trains the default field of released scene 1 with the preset `cpu`, scores it on test and validation transmitters, and copies
what predictions need into the package: the configuration, the parameters of the last checkpoint without the optimiser's state,
what was learned after the last step, and the scores with their provenance (manifest and reports).
"""

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import tyro

from wbgs_jax._util.cli import run_command, say
from wbgs_jax.commands import evaluate, train
from wbgs_jax.evaluation.report import with_part
from wbgs_jax.inference import intervals, kriging
from wbgs_jax.training import EXAMPLE, checkpoint
from wbgs_jax.training.run_folder import MANIFEST, load_trained
from wbgs_jax.training.step import TrainState

PARTS = ("validation", "test")
SCORES = tuple(f"{with_part('eval', part)}.json" for part in PARTS)
BESIDE = ("config.json", MANIFEST, *SCORES, kriging.FILE, intervals.FILE, intervals.POWER_FILE)
"""Files of a run folder that predictions read, as far as they exist, and its scores."""


@dataclass(frozen=True)
class Command:
    """Train the example field, score it, and put it into the package."""

    run: Path = Path("runs/example")
    """Folder of the training; an interrupted one is continued."""
    out: Path = EXAMPLE
    """Folder of the package, replaced."""


def pack(run: Path, out: Path) -> None:
    """Copies what predictions need of a run folder to another folder, which is replaced."""
    trained = load_trained(run)
    saved = checkpoint.read(run / "checkpoints", trained.step)
    state = TrainState(trained.params, (), (), jnp.asarray(trained.step))
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as beside:
        made = Path(beside) / out.name
        made.mkdir()
        for name in BESIDE:
            if (run / name).exists():
                shutil.copyfile(run / name, made / name)
        checkpoint.save(made / "checkpoints", trained.step, state, trained.field, saved.metadata, keep=1)
        for note in made.rglob("commit_success.txt"):  # of Orbax, with a path of this machine; object stores alone need it
            note.unlink()
        shutil.rmtree(out, ignore_errors=True)
        made.rename(out)


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    command = tyro.cli(Command, args=arguments, prog="python -m tools.example_field")
    train.main(["--scene", "1", "--preset", "cpu", "--seed", "0", "--out", str(command.run), "--resume"])
    for part in PARTS:
        evaluate.main(["--run", str(command.run), "--part", part, "--no-pictures"])
    pack(command.run, command.out)
    size = sum(path.stat().st_size for path in command.out.rglob("*") if path.is_file())
    say(f"example: {command.out} ({size / 1e6:.1f} MB)")


if __name__ == "__main__":
    run_command(main)
