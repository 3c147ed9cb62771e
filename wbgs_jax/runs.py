"""A run folder: what it was trained on and how (`config.json`), its checkpoints, and the trained field in it.

config.json   metrics.jsonl   checkpoints/STEP/   eval.json   pictures/*.png
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import wbgs_jax
from wbgs_jax import checkpoint
from wbgs_jax.config import Settings, from_dict, to_dict
from wbgs_jax.data import load_dataset
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.splits import fewer_transmitters, unseen_frequencies
from wbgs_jax.errors import UserError
from wbgs_jax.fields import Field, get_field
from wbgs_jax.files import read_json, write_json


@dataclass(frozen=True)
class RunConfig:
    """Everything that determines a run."""

    source: str
    """Scene number, scene file or folder."""
    field: str
    preset: str
    seed: int
    frequency_ghz: float | None
    """Of a single-frequency folder that does not say."""
    settings: Settings
    train_ghz: tuple[float, ...] = ()
    """Train at these frequencies and test at the others; none: train and test at all."""
    train_tx: int = 0
    """Number of training transmitters; 0: all."""

    def dataset(self) -> Dataset:
        """Load the data the run was trained on."""
        frequency = None if self.frequency_ghz is None else self.frequency_ghz * 1e9
        dataset = load_dataset(self.source, frequency_hz=frequency, seed=self.seed)
        if self.train_ghz:
            dataset = unseen_frequencies(dataset, self.train_ghz)
        return fewer_transmitters(dataset, self.train_tx, self.seed) if self.train_tx else dataset


@dataclass(frozen=True)
class TrainedField:
    """A field with the parameters of a run's newest checkpoint."""

    config: RunConfig
    field: Field
    params: Any
    step: int
    seconds: float
    """Training time."""


def write_config(folder: Path, config: RunConfig) -> None:
    """Start a run folder."""
    values = {"version": wbgs_jax.__version__} | {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    write_json(folder / "config.json", values | {"settings": to_dict(config.settings)})


def read_config(folder: Path) -> RunConfig:
    """The configuration of a run folder."""
    path = folder / "config.json"
    if not path.exists():
        raise UserError(f"{folder} is not a run folder: it has no config.json; train first (make train SCENE=1)")
    values = read_json(path)
    try:
        values = {f.name: values[f.name] for f in dataclasses.fields(RunConfig)}
    except (KeyError, TypeError) as error:
        raise UserError(f"{path} lacks {error}; it belongs to another version of wbgs-jax: train again") from error
    return RunConfig(**values | {"settings": from_dict(values["settings"]), "train_ghz": tuple(values["train_ghz"])})


def difference(a: RunConfig, b: RunConfig) -> str:
    """The first setting in which two configurations differ, as "name: a, not b"; empty if they are equal."""

    def flat(value: Any, name: str = "") -> dict[str, Any]:
        if dataclasses.is_dataclass(value):
            return {
                k: v for f in dataclasses.fields(value) for k, v in flat(getattr(value, f.name), f"{name}.{f.name}").items()
            }
        return {name.lstrip("."): value}

    left, right = flat(a), flat(b)
    return next((f"{key}: {left[key]}, not {right[key]}" for key in left if left[key] != right[key]), "")


def load_trained(folder: Path) -> TrainedField:
    """The field of a run's newest checkpoint."""
    config = read_config(folder)
    steps = checkpoint.checkpoint_steps(folder / "checkpoints")
    if not steps:
        raise UserError(f"{folder} holds no checkpoint yet; train on with the same command and --resume")
    metadata = checkpoint.load_metadata(folder / "checkpoints", steps[-1])
    field = get_field(config.field)
    like = field.skeleton(getattr(config.settings, config.field), metadata["sizes"])
    params = checkpoint.load(folder / "checkpoints", steps[-1], like, prefix=".params")
    return TrainedField(config, field, params, steps[-1], float(metadata["seconds"]))
