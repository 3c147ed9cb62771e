"""Train a field: `wbgs-jax train --scene 1|--data FOLDER [--preset smoke|cpu|gpu] [--resume]`."""

import wbgs_jax._util.quiet  # noqa: F401, before JAX is loaded

# isort: split

import contextlib
import dataclasses
import shlex
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro

from wbgs_jax._util.cli import counted, option_value, run_command, say
from wbgs_jax._util.compilation import use_compilation_cache
from wbgs_jax._util.declared_types import misfits, plain
from wbgs_jax._util.devices import by_first, connect, is_first
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.progress_lines import Pulse
from wbgs_jax.config import Settings, check, from_sections, present_option, sections
from wbgs_jax.data.conventions import ConventionName
from wbgs_jax.data.dataset import VALIDATION, Dataset
from wbgs_jax.data.load import released_scenes, source_names
from wbgs_jax.fields import default_field, field_names, get_field
from wbgs_jax.fields.base import check_config
from wbgs_jax.inference.intervals import write_confidence
from wbgs_jax.inference.kriging import write_neighbours
from wbgs_jax.inference.trained_field import RunConfig, TrainedField
from wbgs_jax.training import curves
from wbgs_jax.training.batches import check_data, knows_no_paths, limited
from wbgs_jax.training.checkpoint import checkpoint_steps
from wbgs_jax.training.cross_validation import Training, is_few, learn_few
from wbgs_jax.training.fit_intervals import learn_confidence
from wbgs_jax.training.fit_kriging import Learned, learn_neighbours
from wbgs_jax.training.loop import TrainResult, train
from wbgs_jax.training.progress import Interrupted, duration_words, expected_seconds
from wbgs_jax.training.run_folder import load_trained, locked, prepare_folder, write_manifest

PROGRAM = "wbgs-jax train"


@dataclass(frozen=True)
class Command:
    """Train a radiance field on the observations of one scene, and store it in a run folder."""

    scene: str | None = None
    """Released scene (1, 2, ...) or scene file (.npz); several with different receivers in one room as A,B."""
    data: str | None = None
    """Instead: a folder of the published layout (docs/formats.md)."""
    out: Path | None = None
    """Run folder; by default runs/SCENE-FIELD-PRESET-seedSEED."""
    field: str = dataclasses.field(default_factory=default_field)
    """Model to train (docs/which_field.md)."""
    preset: str = "cpu"
    """Size: smoke (minutes), cpu (default without a GPU), gpu, or paper (wideband field only: as published)."""
    seed: int = 0
    """Seed of all random numbers."""
    resume: bool = False
    """Continue from the run folder's newest checkpoint, if any."""
    frequency_ghz: float | None = None
    """Frequency of a folder that does not record it."""
    convention: ConventionName | None = None
    """Order of the rows of a folder's images, if not recorded."""
    train_ghz: tuple[float, ...] = ()
    """Train only at these frequencies, and test at the others."""
    train_tx: int = 0
    """Number of training transmitters; 0: all not held out."""
    validation: float = VALIDATION
    """Fraction of the training transmitters held out for validation; 0: none."""
    test_box: tuple[float, ...] = ()
    """Test on the transmitters in a box (lowest and highest corner, metres), and train on the others."""
    receiver: int | None = None
    """Use only the receiver with this index."""
    neighbours: bool = True
    """Correct predictions by measured spectra nearby, if that improves the validation score."""
    devices: int = 0
    """Number of devices to use; 0: all (docs/scaling.md)."""
    distributed: bool = False
    """Run as one of several processes (docs/scaling.md)."""


def default_preset() -> str:
    """Returns `gpu` if JAX finds one, otherwise `cpu`."""
    return "gpu" if jax.default_backend() == "gpu" else "cpu"


def preset_of(field: str, preset: str) -> Settings:
    """Returns the settings of a field's preset.

    Raises:
        UserError: the field or the preset is unknown.
    """
    kind = get_field(field)
    if preset not in kind.presets:
        others = [f"--field {name}" for name in field_names() if preset in get_field(name).presets]
        raise UserError(f"{field} has no preset {preset!r}; choose one of: {', '.join([*kind.presets, *others])}")
    return kind.presets[preset]


def parse(arguments: list[str]) -> tuple[Command, Settings]:
    """Returns the command and its settings. Field and preset are read first, because they determine the settings and their
    defaults. `--help` lists the options of the command, `--help-settings` also those of the field."""
    arguments = [present_option(argument) for argument in arguments]
    field = option_value(arguments, "--field", default_field())
    preset = option_value(arguments, "--preset", default_preset())
    default = preset_of(field, preset)
    parts = sections(default, field)
    everything = "--help-settings" in arguments
    if everything:
        arguments = [argument for argument in arguments if argument != "--help-settings"] + ["--help"]
    command_type = Command if {"-h", "--help"} & set(arguments) and not everything else _with_settings(parts)
    parsed = tyro.cli(
        command_type,
        default=command_type(field=field, preset=preset),
        args=arguments,
        prog=PROGRAM,
        description=f"{Command.__doc__} Settings of the field: {PROGRAM} --field {field} --help-settings.",
    )
    values = {f.name: getattr(parsed, f.name) for f in dataclasses.fields(Command)}
    return Command(**values), from_sections({name: getattr(parsed, name) for name in parts}, default, field)


def _with_settings(parts: dict[str, Any]) -> type[Command]:
    """Returns the type of the command with the sections of settings as additional options, --SECTION.NAME."""
    fields = [
        (name, Annotated[type(part), tyro.conf.arg(help="")], dataclasses.field(default=part)) for name, part in parts.items()
    ]
    made: Any = dataclasses.make_dataclass("CommandWithSettings", fields, bases=(Command,), frozen=True)
    made.__doc__ = Command.__doc__
    return made


def run_config(command: Command, settings: Settings) -> RunConfig:
    """Returns the configuration of the run, checked before any work is done."""
    if (command.scene is None) == (command.data is None):
        raise UserError("give either --scene (1, 2, ... or a .npz file) or --data (a folder of spectra)")
    if not 0 <= command.validation < 1:
        raise UserError(
            f"--validation is {command.validation}; give a fraction of the training transmitters, at least 0 and below 1"
        )
    largest_seed = 2**32 - 1  # the keys of JAX have 32 bits
    if not 0 <= command.seed <= largest_seed:
        raise UserError(f"--seed is {command.seed}; give a whole number from 0 to {largest_seed}")
    if len(command.test_box) not in (0, 6):
        raise UserError(
            f"--test-box has {len(command.test_box)} numbers; give six: x y z of the lowest corner, then of the highest"
        )
    check(settings)
    check_config(command.field, settings.field)
    source = command.scene if command.data is None else command.data
    words, released = source_names(str(source)), released_scenes() if command.data is None else {}
    names = [str(Path(word).resolve()) if word not in released and Path(word).exists() else word for word in words]
    if command.frequency_ghz is not None and not any(Path(name).is_dir() for name in names):
        raise UserError(f"--frequency-ghz is for folders that do not record it; {source} is not a folder, or does not exist")
    if command.convention is not None and not any(Path(name).is_dir() for name in names):
        raise UserError(f"--convention is for folders of spectra, and {source} is not one")
    return RunConfig(
        source=",".join(names),
        field=command.field,
        preset=command.preset,
        seed=command.seed,
        frequency_ghz=command.frequency_ghz,
        settings=settings,
        train_ghz=tuple(command.train_ghz),
        train_tx=command.train_tx,
        validation=command.validation,
        test_box=tuple(command.test_box),
        receiver=command.receiver,
        neighbours=command.neighbours,
        convention=command.convention,
    )


def default_folder(dataset: Dataset, config: RunConfig) -> Path:
    """Returns runs/<scene>-<field>-<preset>-seed<seed>."""
    return Path("runs") / f"{dataset.name}-{config.field}-{config.preset}-seed{config.seed}"


def main(arguments: list[str] | None = None) -> None:
    """Entry point."""
    use_compilation_cache()
    arguments = sys.argv[1:] if arguments is None else arguments
    if "--distributed" in arguments:  # before `parse`, which makes JAX look for devices
        connect()
    _train(*parse(arguments))


def train_field(
    source: str | Path,
    out: str | Path,
    field: str | None = None,
    preset: str | None = None,
    settings: Mapping[str, Mapping[str, Any]] | None = None,
    **options: Any,
) -> TrainedField:
    """Trains a field and writes its run folder, as `wbgs-jax train` does.

    Args:
        source: a released scene ("1", "2", ...), a scene file (.npz), or a folder of the published layout.
        out: run folder, a new one unless `resume=True`.
        field: model to train; by default the hybrid one.
        preset: size of the field and of its training; by default "gpu" if JAX finds one, else "cpu".
        settings: changes of the preset by section and name, as in the options --SECTION.NAME.
        options: further options of the command by name: `seed`, `resume`, `train_ghz`, `train_tx`, `validation`, ...

    Returns:
        The trained field, which `load_trained(out)` reads again.

    Raises:
        UserError: the data, an option or a setting is invalid, or the folder holds something else.
        Interrupted: Ctrl-C; the run continues with `resume=True`.

    Example:
        >>> run = train_field("1", "runs/short", preset="smoke", settings={"optim": {"steps": 100}})  # doctest: +SKIP
    """
    where = "data" if Path(str(source).split(",")[0]).is_dir() else "scene"
    given: Any = {where: str(source), "out": Path(out), "field": field or default_field(), "preset": preset or default_preset()}
    try:
        command = Command(**given, **_of_types(Command, options))
    except TypeError as error:
        known = ", ".join(f.name for f in dataclasses.fields(Command))
        raise UserError(f"an option is unknown ({error}); those of train_field are {known}") from error
    if command.distributed:
        raise UserError(f"distributed is an option of the command line alone; run {PROGRAM} --distributed in every process")
    default = preset_of(command.field, command.preset)
    parts = sections(default, command.field)
    try:
        changed = {
            name: dataclasses.replace(parts[name], **_of_types(type(parts[name]), values, f"{name}."))
            for name, values in (settings or {}).items()
        }
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"a setting is unknown ({error}); {PROGRAM} --help-settings lists all of them") from error
    _train(command, from_sections(parts | changed, default, command.field))
    return load_trained(out)


def _of_types(cls: type, values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns values for fields of a dataclass as read from a file, or raises a `UserError` for one that no file may hold."""
    values = {name: plain(value) for name, value in values.items()}
    for name, wanted in misfits(cls, values).items():
        raise UserError(f"--{(prefix + name).replace('_', '-')} is {repr(values[name])[:60]}; give {wanted}")
    return values


def _train(command: Command, settings: Settings) -> None:
    """Trains and writes the run folder."""
    config = run_config(command, settings)
    dataset = config.dataset()
    config = dataclasses.replace(config, convention=dataset.convention)
    check_data(dataset, get_field(config.field))
    folder = command.out or default_folder(dataset, config)
    begin = time.monotonic()
    by_first(lambda: prepare_folder(folder, config, command.resume))
    counts = f"{len(dataset.train)} spectra, {len(dataset.validation)} for validation, {len(dataset.test)} for the test"
    tell = say if is_first() else _nothing
    tell(f"training {config.field} ({config.preset} preset) on {dataset.name}: {counts}")
    with contextlib.ExitStack() as stack:
        by_first(lambda: stack.enter_context(locked(folder)))
        steps = checkpoint_steps(folder / "checkpoints")
        if steps:
            tell(f"continuing from the checkpoint of step {steps[-1]}")
        total = limited(config.settings, dataset, get_field(config.field)).optim.steps
        for line in opening_lines(folder, config, dataset, total, steps[-1] if steps else 0):
            tell(line)
        try:
            result = train(dataset, config.field, config.settings, config.seed, folder, command.resume, command.devices)
            by_first(lambda: learn_beside(result, dataset, config, folder, command.devices))
        except KeyboardInterrupt:  # in the last epoch, after it, or for the second time
            raise Interrupted("stopped; run the same command with --resume to continue") from None
        by_first(lambda: write_manifest(folder, load_trained(folder)))
    for line in mesh_lines(curves.read(folder / "metrics.jsonl"), settings):
        tell(line)
    tell(summary(result, folder, time.monotonic() - begin))
    tell(f"next: wbgs-jax eval --run {shlex.quote(str(folder))}   (scores on held-out transmitters, and figures)")


def _nothing(line: str) -> None:
    """Ignores a line, on all processes but the first."""


def opening_lines(folder: Path, config: RunConfig, dataset: Dataset, steps: int, done: int) -> list[str]:
    """Returns lines with the expected duration of the remaining steps, `done` being complete, and the results folder."""
    field, usual = get_field(config.field), get_field(config.field).presets[config.preset].optim
    share = max(steps - done, 0) / (usual.steps * usual.share_with_paths)
    if knows_no_paths(dataset, field):
        field = next((part for part in field.components.values() if "paths" not in part.outputs), field)
        share *= usual.share_with_paths * (2 if config.neighbours and is_few(dataset) else 1)  # those of cross-validation
    seconds = expected_seconds(field, config.preset, share)
    lasts = "the lines below show the remaining time" if seconds is None else f"{duration_words(seconds)} on this machine"
    return [
        f"{max(steps - done, 0)} steps, {lasts}; Ctrl-C stops it, and the same command with --resume continues it",
        f"results: {folder} (checkpoints, curves in metrics.jsonl)",
    ]


def learn_beside(result: TrainResult, dataset: Dataset, config: RunConfig, folder: Path, devices: int) -> None:
    """Fits and writes the corrections by measured spectra and the prediction intervals of a trained field."""
    trained = result.field, result.params, dataset
    if config.neighbours and is_few(dataset):
        training = Training(config.field, config.settings, result.steps, config.seed, folder, devices)
        state = "validation: simple methods, prediction intervals"

        def stage(text: str) -> None:
            nonlocal state
            state = text
            say(text)

        begin = time.monotonic()
        with Pulse(lambda: f"{state} ({time.monotonic() - begin:.0f} s)"):
            few = learn_few(*trained, training, stage)
            write_neighbours(folder, few.mixture)
            say(few.line)
            of_spectra, of_powers = learn_confidence(*trained, None)
            fitted = few.mixture is not None or few.confidence is not None
            write_confidence(folder, few.confidence if fitted else of_spectra, of_powers)
        return
    with Pulse(lambda: "validation: correction by measured spectra nearby, prediction intervals") as pulse:
        pulse.print()
        learned = learn_neighbours(*trained) if config.neighbours else Learned()
        write_neighbours(folder, learned.neighbours)
        if learned.line:
            say(learned.line)
        write_confidence(folder, *learn_confidence(*trained, learned.of_training))


def mesh_lines(entries: list[dict[str, Any]], settings: Settings) -> list[str]:
    """Returns lines on what the calibration found wrong with the mesh, and what it did; none for an accurate mesh.

    Args:
        entries: of `metrics.jsonl`.
        settings: of the training.
    """
    report = next((entry for entry in entries if "doubt" in entry), {})
    lines, where = [], "in metrics.jsonl"
    if bodies := report.get("absent", {}).get("centres"):
        lines.append(f"mesh: {counted(len(bodies), 'body', 'bodies')} left out, absent in the data (`absent` {where})")
    off, geometry = report.get("doubt", {}).get("spread_mm", 0.0), report.get("geometry")
    found = f"mesh: spectra fit best if surfaces are off by about {off:.2g} mm"
    if geometry is not None and geometry["kept"]:
        moved = f"bodies moved by up to {geometry['largest_mm']:.2g} mm, the receiver by {geometry['receiver_mm']:.2g} mm"
        lines.append(f"{found}; {moved} (`geometry` {where})")
    elif geometry is not None:
        lines.append(f"{found}; none was moved, since no motion fits significantly better (`geometry` {where})")
    elif (rule := settings.calibration) and not rule.geometry and off > 1e3 * rule.geometry_position_std:
        lines.append(f"{found}; none was moved: --calibration.geometry (off in the smoke preset) looks for the motions")
    return lines


def summary(result: TrainResult, folder: Path, seconds: float) -> str:
    """Returns the last line of a training that took `seconds` of wall time since it was started or continued."""
    sizes = ", ".join(counted(count, name.removesuffix("s")) for name, count in result.sizes.items())
    return f"trained {result.steps} steps, {sizes}, {seconds:.0f} s in all: {folder}"


if __name__ == "__main__":
    run_command(main)
