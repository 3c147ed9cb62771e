"""A run folder: its configuration (`config.json`), checkpoints, and the trained field.

config.json   metrics.jsonl   checkpoints/STEP/   eval.json   manifest.json   pictures/*.png
neighbours.npz   confidence.npz   power_confidence.npz

There is one training per folder: two would overwrite each other's curves and checkpoints.
"""

import contextlib
import dataclasses
import os
import platform
import warnings
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import wbgs_jax
from wbgs_jax._util.declared_types import misfits
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import left_by_killed, read_json, write_json
from wbgs_jax._util.pytree import replaced
from wbgs_jax.config import check, from_dict, sections, to_dict
from wbgs_jax.data.load import source_paths
from wbgs_jax.evaluation.report import provenance
from wbgs_jax.fields import field_names, get_field
from wbgs_jax.fields.base import check_config, field_from_arrays
from wbgs_jax.inference import intervals, kriging
from wbgs_jax.inference.intervals import read_confidence, read_power_confidence
from wbgs_jax.inference.kriging import read_neighbours
from wbgs_jax.inference.trained_field import RunConfig, TrainedField
from wbgs_jax.training import EXAMPLE, checkpoint

MANIFEST = "manifest.json"
"""File that is written last, when a training is finished."""


def sources_of(folder: Path, config: RunConfig) -> list[Path]:
    """Returns the files and folders that a trained field and its data are read from."""
    beside = ("config.json", "checkpoints", kriging.FILE, intervals.FILE, intervals.POWER_FILE)
    return [*(folder / name for name in beside), *source_paths(config.source)]


def write_config(folder: Path, config: RunConfig) -> None:
    """Writes the configuration of a new run folder."""
    values = {"version": wbgs_jax.__version__} | {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    write_json(folder / "config.json", values | {"settings": to_dict(config.settings, config.field)})


def read_config(folder: Path) -> RunConfig:
    """Returns the configuration of a run folder.

    Raises:
        UserError: the folder has no configuration, or it is damaged or of another version.
    """
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
        raise UserError(f"{path} names an unknown field {str(values['field'])[:40]!r}; correct it, or train again")
    kind = get_field(values["field"])
    settings = from_dict(values.pop("settings"), kind.presets["cpu"], kind.name)
    for section, part in sections(settings, kind.name).items():
        _demand_types(path, part, f"{section}.")
    check(settings)
    check_config(kind.name, settings.field)
    config = replaced(RunConfig("", "", "", 0, None, settings), **values)  # the next line checks the types
    _demand_types(path, config, "")
    return config


def _demand_types(path: Path, value: Any, prefix: str) -> None:
    for name in misfits(type(value), vars(value)):
        raise UserError(f"{path} is damaged ({prefix}{name} is {repr(getattr(value, name))[:60]}); correct it, or train again")


def prepare_folder(folder: Path, config: RunConfig, resume: bool) -> None:
    """Creates the run folder, or checks that an existing one belongs to the same run.

    Raises:
        UserError: the folder holds other files or another run, `resume` is needed, or it is not writable.
    """
    if not (folder / "config.json").exists():
        if folder.is_dir() and set(folder.iterdir()) - {*left_by_killed(folder / "config.json")}:
            raise UserError(f"{folder} holds other files; choose another OUT")
        write_config(folder, config)
    elif found := difference(read_config(folder), config):
        raise UserError(f"{folder} holds a run of another configuration ({found}); choose another OUT or remove the folder")
    elif not resume:
        raise UserError(f"{folder} already holds this run; add --resume to continue it, or choose another OUT")
    if not os.access(folder, os.W_OK):
        raise UserError(f"cannot write to run folder {folder}; choose another OUT or correct its permissions")


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
    """Returns the result of `load_trained`, for a command, and warns if the training is not finished."""
    trained = load_trained(folder)
    if not (folder / MANIFEST).exists():
        warnings.warn(
            f"the training of {folder} is not finished (step {trained.step} is saved): it has neither residual kriging nor "
            "prediction intervals yet; continue training with the same command and --resume",
            stacklevel=2,
        )
    return trained


def load_trained(folder: Path | str | None = None) -> TrainedField:
    """Returns the field of a run's newest checkpoint; the data are not read.

    Args:
        folder: a run folder of `wbgs-jax train` or `train_field`; None: the example that comes with the package, a hybrid field
            of scene 1.

    Returns:
        The field with its parameters, corrections and prediction intervals.

    Raises:
        UserError: the folder is not a run folder, or it has no valid checkpoint.
    """
    folder = EXAMPLE if folder is None else Path(folder)
    config = read_config(folder)
    steps = checkpoint.checkpoint_steps(folder / "checkpoints")
    if not steps:
        raise UserError(f"{folder} holds no checkpoint yet; continue training with the same command and --resume")
    saved = checkpoint.read(folder / "checkpoints", steps[-1])
    field = field_from_arrays(get_field(config.field), jax.tree.map(jnp.asarray, saved.field), config.settings.field)
    params = checkpoint.fill(saved, field.init, jax.random.key(0), prefix=".params")
    seconds = float(saved.metadata["seconds"])
    beside = read_neighbours(folder), read_confidence(folder), read_power_confidence(folder)
    return TrainedField(config, field, params, steps[-1], seconds, *beside, data=saved.metadata.get("data", ""))


try:
    import fcntl
except ImportError:  # not available on Windows, where folders are not locked
    fcntl = None  # type: ignore[assignment]

FILE = "training.lock"


class Taken(UserError):
    """Another process has locked the folder."""


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Locks a run folder for this process while the block runs; the lock is released when the process ends, in any way.

    Raises:
        Taken: another process has locked it; the message names that process.
    """
    with (folder / FILE).open("a+") as stream:
        if fcntl is not None:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                stream.seek(0)
                holder = stream.read(200).strip() or "another process"
                raise Taken(f"{folder} is being trained by {holder}; wait for it, or choose another OUT") from None
            except OSError:  # the file systems of some clusters do not support locks
                warnings.warn(f"{folder} cannot be locked on its file system; train one run there at a time", stacklevel=3)
        stream.truncate(0)
        stream.write(f"process {os.getpid()}")
        stream.flush()
        yield
    (folder / FILE).unlink(missing_ok=True)


def write_manifest(folder: Path, trained: TrainedField, report: dict[str, Any] | None = None) -> None:
    """Writes or updates the manifest of a run folder: a summary of data, model, training, versions, device and scores.

    Args:
        folder: run folder.
        trained: its field.
        report: result of an evaluation (`evaluation.score.evaluate`) whose scores are added; earlier scores are kept unless the
            run has been trained further since.
    """
    path = folder / MANIFEST
    known: dict[str, Any] = {}
    if path.exists():
        before = read_json(path)
        with contextlib.suppress(AttributeError, TypeError, ValueError):  # a file that is not a manifest has no scores
            known = dict(before.get("scores", {})) if before.get("training", {}).get("steps") == trained.step else {}
    config, origin = trained.config, provenance(trained)
    scores = known | ({} if report is None else {report["part"]: _figures(report)})
    write_json(
        path,
        {
            "format": 1,
            "data": {"source": config.source, "sha256": trained.data},
            "model": {"field": config.field, "preset": config.preset, **trained.field.inspect(trained.params).sizes},
            "training": {
                "command": origin["command"],
                "seed": config.seed,
                "steps": trained.step,
                "seconds": round(trained.seconds, 1),
                "settings": origin["settings"],
            },
            "versions": {"wbgs_jax": origin["version"], "commit": origin["commit"], "python": platform.python_version()}
            | {name: _version(name) for name in ("jax", "jaxlib", "numpy", "flax", "optax")},
            "device": origin["device"],
            "scores": scores,
        },
    )


def _figures(report: dict[str, Any]) -> dict[str, Any]:
    """Returns the scalar entries of a report."""
    return {name: value for name, value in report.items() if isinstance(value, int | float) and not isinstance(value, bool)}


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
