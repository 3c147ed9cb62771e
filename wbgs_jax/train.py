"""Train a field: `python -m wbgs_jax.train --scene 1`, `--data FOLDER`, `--preset smoke|cpu|gpu`, `--resume`, `--help`."""

import dataclasses
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import tyro

from wbgs_jax.compilation import use_compilation_cache
from wbgs_jax.config import PRESETS, Settings, check, preset_settings
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.errors import UserError, run_command
from wbgs_jax.fields import get_field
from wbgs_jax.runs import RunConfig, difference, read_config, write_config
from wbgs_jax.trainer import TrainResult, train


@dataclass(frozen=True)
class Command:
    """Train a radiance field on the spectra of one scene."""

    scene: str | None = None
    """Released scene (1, 2, ...) or a scene file (.npz)."""
    data: str | None = None
    """Folder of the published layout (spectrum/*.png, tx_pos.csv, ...), instead of --scene."""
    out: Path | None = None
    """Run folder; the default names scene, field, preset and seed under runs/."""
    field: str = "wideband"
    """The model."""
    preset: str = "cpu"
    """smoke (< 1 min), cpu (the default without a GPU) or gpu (the paper's size)."""
    seed: int = 0
    resume: bool = False
    """Go on where the run folder's newest checkpoint ends; starts anew where there is none."""
    frequency_ghz: float | None = None
    """Frequency of a single-frequency folder that does not say."""
    train_ghz: tuple[float, ...] = ()
    """Train at these frequencies alone; the evaluation asks for the others (held-out transmitters, unseen frequencies)."""
    train_tx: int = 0
    """Train with this number of transmitters; 0: all that are not held out."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Settings)
    """Every setting of the preset can be overridden."""


def default_preset() -> str:
    """`gpu` where JAX finds one, else `cpu`."""
    return "gpu" if jax.default_backend() == "gpu" else "cpu"


def parse(arguments: list[str]) -> Command:
    """The command line; field and preset are looked at first because they set the defaults of everything else."""
    field, preset = _value(arguments, "--field", "wideband"), _value(arguments, "--preset", default_preset())
    if preset not in PRESETS:
        raise UserError(f"unknown preset {preset!r}; choose one of: {', '.join(PRESETS)}")
    default = Command(field=field, preset=preset, settings=preset_settings(preset, field))
    return tyro.cli(Command, default=default, args=arguments, prog="python -m wbgs_jax.train")


def _value(arguments: list[str], name: str, default: str) -> str:
    """What follows an option on the command line."""
    for i, argument in enumerate(arguments):
        if argument == name:
            return "".join(arguments[i + 1 : i + 2])
        if argument.startswith(f"{name}="):
            return argument.split("=", 1)[1]
    return default


def run_config(command: Command) -> RunConfig:
    """Check what was asked for before any work is done."""
    if (command.scene is None) == (command.data is None):
        raise UserError("give either --scene (1, 2, ... or a .npz file) or --data (a folder of spectra)")
    get_field(command.field)
    check(command.settings)
    source = command.scene if command.data is None else command.data
    if Path(str(source)).exists():
        source = str(Path(str(source)).resolve())
    chosen = (command.field, command.preset, command.seed, command.frequency_ghz, command.settings)
    return RunConfig(str(source), *chosen, tuple(command.train_ghz), command.train_tx)


def prepare_folder(folder: Path, config: RunConfig, resume: bool) -> None:
    """Make the run folder, or make sure that the one there belongs to the same run."""
    if not (folder / "config.json").exists():
        if folder.is_dir() and any(folder.iterdir()):
            raise UserError(f"{folder} holds other files; choose another OUT")
        write_config(folder, config)
    elif found := difference(read_config(folder), config):
        raise UserError(f"{folder} holds a run of another configuration ({found}); choose another OUT or remove the folder")
    elif not resume:
        raise UserError(f"{folder} already holds this run; add --resume to go on with it, or choose another OUT")
    if not os.access(folder, os.W_OK):
        raise UserError(f"cannot write to run folder {folder}; choose another OUT or mend its permissions")


def default_folder(dataset: Dataset, config: RunConfig) -> Path:
    """runs/<scene>-<field>-<preset>-seed<seed>."""
    return Path("runs") / f"{dataset.name}-{config.field}-{config.preset}-seed{config.seed}"


def main() -> None:
    """Entry point."""
    command = parse(sys.argv[1:])
    use_compilation_cache()
    config = run_config(command)
    dataset = config.dataset()
    folder = command.out or default_folder(dataset, config)
    prepare_folder(folder, config, command.resume)
    counts = f"{len(dataset.train)} spectra, {len(dataset.test)} held out"
    say(f"training {config.field} ({config.preset} preset) on {dataset.name}: {counts}")
    result = train(dataset, config.field, config.settings, config.seed, folder, command.resume)
    say(summary(result, folder))


def summary(result: TrainResult, folder: Path) -> str:
    """One line at the end."""
    size = f"{result.gaussians} Gaussians, {result.compilations} compilations"
    return f"trained {result.steps} steps in {result.seconds:.0f} s, {size}: {folder}"


def say(line: str) -> None:
    """A line for people, on stderr: stdout is for results."""
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    run_command(main)
