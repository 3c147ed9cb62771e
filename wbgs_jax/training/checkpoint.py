"""Checkpoints, written with Orbax: the training state, its field, and metadata.

A tree is saved as a flat dictionary of arrays, named by their path in the tree; names of the field begin with "field". Orbax
writes to a temporary folder and renames it, so that a checkpoint is either complete or absent (one that is written again is
absent for a moment).
"""

import contextlib
import errno
import hashlib
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key, PyTree

from wbgs_jax._util.devices import is_first
from wbgs_jax._util.errors import UserError

FIELD, EMPTY, DIGEST = "field", "empty", "sha256"


@dataclass(frozen=True)
class Saved:
    """The content of a checkpoint."""

    path: Path
    state: dict[str, np.ndarray]
    """Arrays of the state by their path, such as ".params.gaussians.means"."""
    field: dict[str, np.ndarray]
    """Arrays of the field by their path, such as ".frame.centre"."""
    metadata: dict[str, Any]


def _flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
    return {prefix + jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def digest(arrays: dict[str, np.ndarray], metadata: dict[str, Any]) -> str:
    """Returns a checksum of the content of a checkpoint; a flipped bit would otherwise change parameters without any error."""
    found = hashlib.sha256(json.dumps(metadata, sort_keys=True).encode())
    for key in sorted(arrays):
        array = np.ascontiguousarray(arrays[key])
        found.update(f"{key} {array.dtype.name} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def checkpoint_steps(folder: Path) -> list[int]:
    """Returns the steps of the complete checkpoints in a folder, ascending."""
    if not folder.is_dir():
        return []
    return sorted(int(entry.name) for entry in folder.iterdir() if entry.name.isdigit())


def save(folder: Path, step: int, state: Any, field: PyTree, metadata: dict[str, Any], keep: int) -> None:
    """Writes a checkpoint, replacing one of the same step, and removes all but the newest `keep`. All processes call this with
    the same state; the first process writes.

    Args:
        folder: folder of the checkpoints.
        step: number of the step.
        state: training state.
        field: field.
        metadata: values that can be stored as JSON.
        keep: number of checkpoints to keep.

    Raises:
        UserError: the checkpoint cannot be written.
    """
    from orbax.checkpoint import v1 as ocp

    # Host arrays can be loaded on any device. Orbax refuses empty arrays; the metadata describe them.
    host = {key: np.asarray(leaf) for key, leaf in (_flatten(state) | _flatten(field, FIELD)).items()}
    empty = {key: [list(leaf.shape), leaf.dtype.name] for key, leaf in host.items() if not leaf.size}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _quiet():
            full = {key: leaf for key, leaf in host.items() if leaf.size}
            metadata = metadata | {EMPTY: empty}
            metadata |= {DIGEST: digest(host, metadata)}
            _demand_room(folder, full)
            with _small_files(), _plain(folder) as place:
                ocp.save(place / str(step), full, custom_metadata=metadata, overwrite=True)
    except (OSError, ValueError) as error:  # TensorStore raises a ValueError for a full disk
        for unfinished in folder.glob(f"{step}.*tmp*"):
            shutil.rmtree(unfinished, ignore_errors=True)
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0][:200]
        kept = [old for old in checkpoint_steps(folder) if old != step]
        left = f"the checkpoint of step {kept[-1]} is intact" if kept else "there is no checkpoint yet"
        where = f"cannot write checkpoint {folder.absolute() / str(step)}"
        raise UserError(f"{where}: {reason}; {left}. Free some space and continue with --resume") from error
    if is_first():
        tidy(folder, keep)


def tidy(folder: Path, keep: int) -> None:
    """Removes all but the newest `keep` checkpoints, and the remains of one whose removal was interrupted.

    A checkpoint is renamed before it is removed, so that a folder named by a number is always complete. Errors are ignored,
    since only the newest checkpoint matters and it exists.
    """
    removed = ".removed"  # suffix of a checkpoint that is being removed
    for old in checkpoint_steps(folder)[:-keep]:
        shutil.rmtree(folder / f"{old}{removed}", ignore_errors=True)
        with contextlib.suppress(OSError):
            (folder / str(old)).rename(folder / f"{old}{removed}")
    for left in folder.glob(f"*{removed}"):
        shutil.rmtree(left, ignore_errors=True)


def _demand_room(folder: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raises an `OSError` for lack of disk space before Orbax begins: its writes run concurrently, and after the first failure
    the threads of the others would print errors on stderr."""
    margin = 2**16  # bytes of a checkpoint in addition to its arrays
    if shutil.disk_usage(folder).free < sum(array.nbytes for array in arrays.values()) + margin:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def read(folder: Path, step: int) -> Saved:
    """Returns the content of a checkpoint.

    Raises:
        UserError: the checkpoint is damaged or incomplete.
    """
    from orbax.checkpoint import v1 as ocp

    path = folder / str(step)
    state = "state"  # folder of the arrays in a checkpoint
    with _explained(path), _quiet():
        with _alone(), _plain(path) as place:
            _read_every_value(place / state)
            metadata = ocp.metadata(place).custom_metadata
            if not metadata:  # Orbax returns None for a file that it cannot read
                raise ValueError("no metadata")
            found = {key: np.asarray(value) for key, value in ocp.load(place).items()}
        metadata = dict(metadata)
        expected = metadata.pop(DIGEST, None)  # older checkpoints have none
        found |= {key: np.zeros(shape, dtype) for key, (shape, dtype) in metadata.get(EMPTY, {}).items()}
        if expected not in (None, digest(found, metadata)):
            raise ValueError("its checksum does not match")
        metadata.pop(EMPTY, None)
    field = {key.removeprefix(FIELD): value for key, value in found.items() if key.startswith(FIELD)}
    return Saved(path, {key: value for key, value in found.items() if not key.startswith(FIELD)}, field, metadata)


def fill(saved: Saved, init: Callable[[Any], Any], key: Key[Array, ""], prefix: str) -> Any:
    """Returns saved parameters in the structure of `init(key)`; the sizes of leading axes are those that were saved.

    Args:
        saved: content of a checkpoint.
        init: returns initial parameters; only their structure and shapes are evaluated.
        key: random key.
        prefix: path of the parameters in the saved state, such as ".params".

    Raises:
        UserError: the checkpoint belongs to another configuration.
    """
    like = jax.eval_shape(init, key)

    def shaped(path: Any, leaf: Any) -> Any:
        value = saved.state.get(prefix + jax.tree_util.keystr(path))
        _demand(value is not None and value.shape[1:] == leaf.shape[1:] and value.ndim == len(leaf.shape), saved)
        assert value is not None
        return jax.ShapeDtypeStruct(value.shape, leaf.dtype)

    return fill_like(saved, jax.tree_util.tree_map_with_path(shaped, like), prefix)


def fill_like(saved: Saved, like: Any, prefix: str = "") -> Any:
    """Returns the saved state in the structure, shapes and dtypes of `like` (arrays or ShapeDtypeStructs).

    `prefix` is the path of this part of the saved state, such as ".params".
    """
    wanted = _flatten(like, prefix)
    _demand(all(key in saved.state and saved.state[key].shape == leaf.shape for key, leaf in wanted.items()), saved)
    leaves = [jax.numpy.asarray(saved.state[key], leaf.dtype) for key, leaf in wanted.items()]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _demand(fits: bool, saved: Saved) -> None:
    if not fits:
        raise UserError(f"checkpoint {saved.path} does not fit this configuration; start a new run in another OUT")


def _small_files() -> contextlib.AbstractContextManager[Any]:
    """Makes Orbax write files of a limited size, in the array format that allows this."""
    from orbax.checkpoint import v1 as ocp

    file_bytes = 8 * 2**20  # approximate size of a checkpoint's files, small enough for uploads that are limited in size
    saving = ocp.options.ArrayOptions.Saving(use_zarr3=True, ocdbt_target_data_file_size=file_bytes)
    context: contextlib.AbstractContextManager[Any] = ocp.Context(array_options=ocp.options.ArrayOptions(saving=saving))
    return context


def _alone() -> contextlib.AbstractContextManager[Any]:
    """Makes Orbax read without waiting for other processes, since only this process may be reading."""
    from orbax.checkpoint import v1 as ocp

    if jax.process_count() == 1:
        return contextlib.nullcontext()
    own = jax.process_index()
    options = ocp.options.MultiprocessingOptions(primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"p{own}")
    context: contextlib.AbstractContextManager[Any] = ocp.Context(multiprocessing_options=options)
    return context


@contextlib.contextmanager
def _plain(folder: Path) -> Iterator[Path]:
    """Yields an absolute path to a folder that is valid UTF-8, as TensorStore requires."""
    path = folder.absolute()
    if os.fsencode(path).decode(errors="ignore") == str(path):
        yield path
        return
    with tempfile.TemporaryDirectory() as beside:
        link = Path(beside) / "checkpoints"
        link.symlink_to(path, target_is_directory=True)
        yield link


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silences Orbax, which logs every file that it writes; failures are reported by a `UserError` here."""
    loggers = [logging.getLogger(name) for name in ("absl", "asyncio")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


def _read_every_value(folder: Path) -> None:
    """Reads all values one after another and raises an error for the first unreadable one. Orbax reads them concurrently, and
    after the first failure the threads of the others would print errors on stderr."""
    import tensorstore  # a dependency of Orbax

    values = tensorstore.KvStore.open({"driver": "ocdbt", "base": folder.absolute().as_uri() + "/"}).result()
    for key in values.list().result():
        values.read(key).result()


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        if isinstance(error, UserError):
            raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        older = [step for step in checkpoint_steps(path.parent) if str(step) != path.name]
        advice = (
            f"delete that folder to use that of step {older[-1]}"
            if older
            else "there is no other: delete the run and train again"
        )
        raise UserError(f"checkpoint {path} is damaged or incomplete ({reason}); {advice}") from error
