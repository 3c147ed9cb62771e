"""Checkpoints with Orbax: the training state, the field it belongs to, and metadata.

A tree is saved as a flat dictionary of arrays named by their place in it; those of the field begin with "field". Orbax writes
to a temporary folder and renames it, so a checkpoint is whole or absent (one that is written again is absent for a moment).
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
from jaxtyping import Array, Key

from wbgs_jax._util.devices import is_first
from wbgs_jax._util.errors import UserError

FIELD, EMPTY, DIGEST = "field", "empty", "sha256"
MARGIN = 2**16
"""Bytes that a checkpoint takes beside its arrays."""
FILE_BYTES = 8 * 2**20
"""Of a checkpoint's files, about: they can be sent where large ones cannot."""
STATE = "state"
"""Folder of the arrays in a checkpoint."""
REMOVED = ".removed"
"""Ending of a checkpoint that is being removed."""


@dataclass(frozen=True)
class Saved:
    """The content of a checkpoint."""

    path: Path
    state: dict[str, np.ndarray]
    """Arrays of the state by their place, such as ".params.gaussians.means"."""
    field: dict[str, np.ndarray]
    """Arrays of the field by their place, such as ".frame.centre"."""
    metadata: dict[str, Any]


def _flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
    return {prefix + jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def digest(arrays: dict[str, np.ndarray], metadata: dict[str, Any]) -> str:
    """Returns a checksum of everything that a checkpoint holds: a flipped bit would be other parameters, and nothing more."""
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


def save(folder: Path, step: int, state: Any, field: Any, metadata: dict[str, Any], keep: int) -> None:
    """Writes a checkpoint (replacing one of the same step) and removes the oldest beyond `keep`. Of several processes all call
    it with the same state; the first one writes."""
    from orbax.checkpoint import v1 as ocp

    # Host arrays load on any device; Orbax refuses empty ones, which the metadata stand for.
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
    except (OSError, ValueError) as error:  # ValueError: what TensorStore makes of a full disk
        for unfinished in folder.glob(f"{step}.*tmp*"):
            shutil.rmtree(unfinished, ignore_errors=True)
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0][:200]
        kept = [old for old in checkpoint_steps(folder) if old != step]
        left = f"the checkpoint of step {kept[-1]} is whole" if kept else "there is no checkpoint yet"
        where = f"cannot write checkpoint {folder.absolute() / str(step)}"
        raise UserError(f"{where}: {reason}; {left}. Free some space and go on with --resume") from error
    if is_first():
        tidy(folder, keep)


def tidy(folder: Path, keep: int) -> None:
    """Removes the oldest checkpoints beyond `keep`, and what a process that was killed meanwhile left of one.

    A checkpoint is renamed before it is removed: what a number names is whole. Errors are nobody's: the newest one is there,
    and that is what counts.
    """
    for old in checkpoint_steps(folder)[:-keep]:
        shutil.rmtree(folder / f"{old}{REMOVED}", ignore_errors=True)
        with contextlib.suppress(OSError):
            (folder / str(old)).rename(folder / f"{old}{REMOVED}")
    for left in folder.glob(f"*{REMOVED}"):
        shutil.rmtree(left, ignore_errors=True)


def _demand_room(folder: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raises an `OSError` for a disk that is too full, before Orbax begins: of its writes, which all run at once, one would
    fail, and the others go on to complain on stderr, in threads of their own."""
    if shutil.disk_usage(folder).free < sum(array.nbytes for array in arrays.values()) + MARGIN:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def read(folder: Path, step: int) -> Saved:
    """Returns the content of a checkpoint; a damaged one is a `UserError`."""
    from orbax.checkpoint import v1 as ocp

    path = folder / str(step)
    with _explained(path), _quiet():
        with _alone(), _plain(path) as place:
            _read_every_value(place / STATE)
            metadata = ocp.metadata(place).custom_metadata
            if not metadata:  # Orbax gives None for a file that it cannot read
                raise ValueError("no metadata")
            found = {key: np.asarray(value) for key, value in ocp.load(place).items()}
        metadata = dict(metadata)
        expected = metadata.pop(DIGEST, None)  # older checkpoints have none
        found |= {key: np.zeros(shape, dtype) for key, (shape, dtype) in metadata.get(EMPTY, {}).items()}
        if expected not in (None, digest(found, metadata)):
            raise ValueError("its checksum is another one")
        metadata.pop(EMPTY, None)
    field = {key.removeprefix(FIELD): value for key, value in found.items() if key.startswith(FIELD)}
    return Saved(path, {key: value for key, value in found.items() if not key.startswith(FIELD)}, field, metadata)


def fill(saved: Saved, init: Callable[[Any], Any], key: Key[Array, ""], prefix: str) -> Any:
    """Returns saved parameters in the structure that `init(key)` gives; numbers of rows are those that were saved."""
    like = jax.eval_shape(init, key)

    def shaped(path: Any, leaf: Any) -> Any:
        value = saved.state.get(prefix + jax.tree_util.keystr(path))
        _demand(value is not None and value.shape[1:] == leaf.shape[1:] and value.ndim == len(leaf.shape), saved)
        assert value is not None
        return jax.ShapeDtypeStruct(value.shape, leaf.dtype)

    return fill_like(saved, jax.tree_util.tree_map_with_path(shaped, like), prefix)


def fill_like(saved: Saved, like: Any, prefix: str = "") -> Any:
    """Returns the saved state in the structure, shapes and dtypes of `like` (arrays or ShapeDtypeStructs).

    `prefix` names the part of the saved state that `like` stands for, such as ".params".
    """
    wanted = _flatten(like, prefix)
    _demand(all(key in saved.state and saved.state[key].shape == leaf.shape for key, leaf in wanted.items()), saved)
    leaves = [jax.numpy.asarray(saved.state[key], leaf.dtype) for key, leaf in wanted.items()]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _demand(fits: bool, saved: Saved) -> None:
    if not fits:
        raise UserError(f"checkpoint {saved.path} does not fit this configuration; start a new run in another OUT")


def _small_files() -> contextlib.AbstractContextManager[Any]:
    """Lets Orbax write files of no more than about `FILE_BYTES`, in the format of arrays that allows it."""
    from orbax.checkpoint import v1 as ocp

    saving = ocp.options.ArrayOptions.Saving(use_zarr3=True, ocdbt_target_data_file_size=FILE_BYTES)
    context: contextlib.AbstractContextManager[Any] = ocp.Context(array_options=ocp.options.ArrayOptions(saving=saving))
    return context


def _alone() -> contextlib.AbstractContextManager[Any]:
    """Lets Orbax read without waiting for other processes: one may be the only one to do so."""
    from orbax.checkpoint import v1 as ocp

    if jax.process_count() == 1:
        return contextlib.nullcontext()
    own = jax.process_index()
    options = ocp.options.MultiprocessingOptions(primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"p{own}")
    context: contextlib.AbstractContextManager[Any] = ocp.Context(multiprocessing_options=options)
    return context


@contextlib.contextmanager
def _plain(folder: Path) -> Iterator[Path]:
    """Gives an absolute path that leads to a folder and is UTF-8, which TensorStore demands of paths."""
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
    """Silences Orbax, which reports every file that it writes; what fails is explained by a `UserError` here."""
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
    """Raises an error for a value that cannot be read, one after another: Orbax reads all at once and stops at the first that
    fails, and the others go on to complain on stderr, in threads of their own."""
    import tensorstore  # of Orbax

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
