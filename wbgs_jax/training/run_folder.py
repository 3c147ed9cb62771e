"""A run folder: what it was trained on and how (`config.json`), its checkpoints, and the trained field in it.

config.json   metrics.jsonl   checkpoints/STEP/   eval.json   manifest.json   pictures/*.png
kriging.npz   intervals.npz   power_confidence.npz

One training a folder: two would write over each other's curves and checkpoints.
"""

import contextlib
import dataclasses
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import wbgs_jax
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import left_by_killed, read_json, write_json
from wbgs_jax._util.pytree import replaced
from wbgs_jax._util.typed import misfit
from wbgs_jax.config import Settings, check, from_dict, sections, to_dict
from wbgs_jax.data.conventions import ConventionName
from wbgs_jax.data.dataset import Dataset, check_data
from wbgs_jax.data.load import load_dataset, source_paths
from wbgs_jax.data.splits import (
    VALIDATION,
    fewer_transmitters,
    hold_out_box,
    hold_out_validation,
    select_receivers,
    unseen_frequencies,
)
from wbgs_jax.fields import Field, field_names, get_field
from wbgs_jax.fields.base import Params, check_config, field_from_arrays
from wbgs_jax.inference import intervals, kriging
from wbgs_jax.inference.intervals import Confidence, PowerConfidence, read_confidence, read_power_confidence
from wbgs_jax.inference.kriging import Beside, read_neighbours
from wbgs_jax.training import checkpoint

FIRST_PRESET = "cpu"

MANIFEST = "manifest.json"
"""Written last, when a training is finished."""


@dataclass(frozen=True)
class RunConfig:
    """Everything that determines a run."""

    source: str
    """Scene number, scene file or folder; several with commas between them."""
    field: str
    preset: str
    seed: int
    frequency_ghz: float | None
    """Frequency of a single-frequency folder that does not say."""
    settings: Settings
    train_ghz: tuple[float, ...] = ()
    """Train at these frequencies and test at the others; none: train and test at all."""
    train_tx: int = 0
    """Number of training transmitters; 0: all."""
    validation: float = VALIDATION
    """Share of the training transmitters that is held out for validation, where the data name none."""
    test_box: tuple[float, ...] = ()
    """Test at the transmitters in a box, lowest and highest corner (metres), and train elsewhere; none: as the data say."""
    receiver: int | None = None
    """Number of the only receiver that is looked at; None: all."""
    neighbours: bool = True
    """Whether known spectra are asked beside the field, where that gains on validation."""
    convention: ConventionName | None = None
    """In which the pixels of a folder are ordered; None where there is no folder, or as it is not known yet."""

    def other_data(self, source: str, convention: ConventionName | None = None) -> Dataset:
        """Returns data of any name, read as those that the run was trained on."""
        frequency = None if self.frequency_ghz is None else self.frequency_ghz * 1e9
        return load_dataset(source, frequency_hz=frequency, seed=self.seed, convention=convention)

    def dataset(self) -> Dataset:
        """Returns the data that the run was trained on."""
        dataset = self.other_data(self.source, self.convention)
        if self.receiver is not None:
            dataset = select_receivers(dataset, [self.receiver])
        if self.test_box:
            dataset = hold_out_box(dataset, self.test_box[:3], self.test_box[3:])
        if self.train_ghz:
            dataset = unseen_frequencies(dataset, self.train_ghz)
        if self.train_tx:
            dataset = fewer_transmitters(dataset, self.train_tx, self.seed)
        return hold_out_validation(dataset, self.validation) if self.validation else dataset


@dataclass(frozen=True)
class TrainedField:
    """A field with the parameters of a run's newest checkpoint."""

    config: RunConfig
    field: Field
    params: Params
    step: int
    seconds: float
    """Training time."""
    neighbours: Beside = None
    """Known spectra that are asked beside it."""
    confidence: Confidence | None = None
    """How sure its answers are."""
    power_confidence: PowerConfidence | None = None
    """How sure the received powers are that it says."""
    data: str = ""
    """Checksum of the data that it was trained on; empty where nobody has kept it."""

    def dataset(self) -> Dataset:
        """Returns the data that it was trained on; others under the same name are a `UserError`."""
        return check_data(self.config.dataset(), self.data, f"this run ({self.config.source})")

    def origin(self) -> dict[str, Any]:
        """Returns where it comes from: field, preset, seed and step."""
        return {name: getattr(self.config, name) for name in ("field", "preset", "seed")} | {"step": self.step}


def sources_of(folder: Path, config: RunConfig) -> list[Path]:
    """Returns the files and folders that a trained field and its data are read from."""
    beside = ("config.json", "checkpoints", kriging.FILE, intervals.FILE, intervals.POWER_FILE)
    return [*(folder / name for name in beside), *source_paths(config.source)]


def write_config(folder: Path, config: RunConfig) -> None:
    """Starts a run folder."""
    values = {"version": wbgs_jax.__version__} | {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    write_json(folder / "config.json", values | {"settings": to_dict(config.settings, config.field)})


def read_config(folder: Path) -> RunConfig:
    """Returns the configuration of a run folder; a folder without one, or of another version, is a `UserError`."""
    path = folder / "config.json"
    if not path.exists():
        raise UserError(f"{folder} is not a run folder: it has no config.json; train first (make train SCENE=1)")
    values = read_json(path)
    try:
        values = {f.name: values[f.name] for f in dataclasses.fields(RunConfig)}
    except (KeyError, TypeError) as error:
        raise UserError(f"{path} lacks {error}; it belongs to another version of wbgs-jax: train again") from error
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    if values["field"] not in field_names():
        raise UserError(f"{path} names a field that is not known, {str(values['field'])[:40]!r}; mend it, or train again")
    kind = get_field(values["field"])
    settings = from_dict(values.pop("settings"), kind.presets[FIRST_PRESET], kind.name)
    for section, part in sections(settings, kind.name).items():
        _demand_types(path, part, f"{section}.")
    check(settings)
    check_config(kind.name, settings.field)
    config = replaced(RunConfig("", "", "", 0, None, settings), **values)  # unchecked, until the next line
    _demand_types(path, config, "")
    return config


def _demand_types(path: Path, value: Any, prefix: str) -> None:
    if wrong := misfit(value):
        raise UserError(f"{path} is damaged ({prefix}{wrong}); mend it, or train again")


def prepare_folder(folder: Path, config: RunConfig, resume: bool) -> None:
    """Makes the run folder, or makes sure that the one there belongs to the same run."""
    if not (folder / "config.json").exists():
        if folder.is_dir() and set(folder.iterdir()) - {*left_by_killed(folder / "config.json")}:
            raise UserError(f"{folder} holds other files; choose another OUT")
        write_config(folder, config)
    elif found := difference(read_config(folder), config):
        raise UserError(f"{folder} holds a run of another configuration ({found}); choose another OUT or remove the folder")
    elif not resume:
        raise UserError(f"{folder} already holds this run; add --resume to go on with it, or choose another OUT")
    if not os.access(folder, os.W_OK):
        raise UserError(f"cannot write to run folder {folder}; choose another OUT or mend its permissions")


def difference(a: RunConfig, b: RunConfig) -> str:
    """Returns the first setting in which two configurations differ, as "name: a, not b"; empty if they are equal."""

    def flat(config: RunConfig) -> dict[str, Any]:
        values = {f.name: getattr(config, f.name) for f in dataclasses.fields(config) if f.name != "settings"}
        for section, part in sections(config.settings, config.field).items():
            values |= {f"settings.{section}.{name}": value for name, value in dataclasses.asdict(part).items()}
        return values

    left, right = flat(a), flat(b)
    return next((f"{key}: {left[key]}, not {right.get(key)}" for key in left if left[key] != right.get(key)), "")


def open_run(folder: Path) -> TrainedField:
    """Returns what `load_trained` does, for a command, with a note if the training is not finished."""
    trained = load_trained(folder)
    if not (folder / MANIFEST).exists():
        warnings.warn(
            f"the training of {folder} is not finished (step {trained.step} is saved): its answers know neither neighbours "
            "nor how sure they are; train on with the same command and --resume",
            stacklevel=2,
        )
    return trained


def load_trained(folder: Path | str) -> TrainedField:
    """Returns the field of a run's newest checkpoint; the data are not read."""
    folder = Path(folder)
    config = read_config(folder)
    steps = checkpoint.checkpoint_steps(folder / "checkpoints")
    if not steps:
        raise UserError(f"{folder} holds no checkpoint yet; train on with the same command and --resume")
    saved = checkpoint.read(folder / "checkpoints", steps[-1])
    field = field_from_arrays(get_field(config.field), jax.tree.map(jnp.asarray, saved.field), config.settings.field)
    params = checkpoint.fill(saved, field.init, jax.random.key(0), prefix=".params")
    seconds = float(saved.metadata["seconds"])
    beside = read_neighbours(folder), read_confidence(folder), read_power_confidence(folder)
    return TrainedField(config, field, params, steps[-1], seconds, *beside, data=saved.metadata.get("data", ""))


try:
    import fcntl
except ImportError:  # not on Windows, where nobody is kept out
    fcntl = None  # type: ignore[assignment]

FILE = "training.lock"


class Taken(UserError):
    """Another process has the folder."""


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keeps a run folder for this process while the block runs; the lock goes with the process, however that ends.

    Raises:
        Taken: another process has it; the message says which.
    """
    with (folder / FILE).open("a+") as stream:
        if fcntl is not None:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                stream.seek(0)
                holder = stream.read(200).strip() or "another process"
                raise Taken(f"{folder} is being trained by {holder}; wait for it, or choose another OUT") from None
            except OSError:  # some clusters' file systems know no locks
                warnings.warn(f"{folder} cannot be locked on its file system; train one run there at a time", stacklevel=3)
        stream.truncate(0)
        stream.write(f"process {os.getpid()}")
        stream.flush()
        yield
    (folder / FILE).unlink(missing_ok=True)
