"""Checkpoints with Orbax: the training state, and in the metadata what is needed to rebuild its shape.

A state is saved as a flat dictionary of arrays named by their place in the tree. Orbax writes to a temporary folder and
renames it, so a checkpoint is whole or absent (one that is written again is absent for a moment).
"""

import contextlib
import logging
import shutil
from pathlib import Path
from typing import Any

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp

from wbgs_jax.errors import UserError

for _name in ("absl", "asyncio"):  # Orbax reports every file it writes; what fails is explained by a `UserError` here
    logging.getLogger(_name).setLevel(logging.CRITICAL)


def _flatten(tree: Any) -> dict[str, Any]:
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def checkpoint_steps(folder: Path) -> list[int]:
    """Steps of the complete checkpoints in a folder, ascending."""
    if not folder.is_dir():
        return []
    return sorted(int(entry.name) for entry in folder.iterdir() if entry.name.isdigit())


def save(folder: Path, step: int, state: Any, metadata: dict[str, Any], keep: int) -> None:
    """Write a checkpoint (replacing one of the same step) and remove the oldest beyond `keep`."""
    target = (folder / str(step)).absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Host arrays load on any device; Orbax refuses empty ones.
        host = {key: np.asarray(leaf) for key, leaf in _flatten(state).items() if np.size(leaf)}
        ocp.save(target, host, custom_metadata=metadata, overwrite=True)
    except OSError as error:
        raise UserError(
            f"cannot write checkpoint {target}: {error.strerror or error}; free some space or choose another OUT"
        ) from error
    for old in checkpoint_steps(folder)[:-keep]:
        shutil.rmtree(folder / str(old))


def load_metadata(folder: Path, step: int) -> dict[str, Any]:
    """The metadata given to `save`."""
    with _explained(folder / str(step)):
        metadata = ocp.metadata((folder / str(step)).absolute()).custom_metadata
        if not metadata:  # Orbax gives None for a file that it cannot read
            raise ValueError("no metadata")
        return dict(metadata)


def load(folder: Path, step: int, like: Any, prefix: str = "") -> Any:
    """Read a checkpoint into the structure, shapes and dtypes of `like` (arrays or ShapeDtypeStructs).

    `prefix` names the part of the saved state that `like` stands for, such as ".params".
    """
    path = folder / str(step)
    with _explained(path):
        found = ocp.load(path.absolute())
    wanted = {prefix + key: leaf for key, leaf in _flatten(like).items()}
    found |= {key: np.zeros(leaf.shape) for key, leaf in wanted.items() if 0 in leaf.shape}
    if any(key not in found or np.shape(found[key]) != leaf.shape for key, leaf in wanted.items()):
        raise UserError(f"checkpoint {path} does not fit this configuration; start a new run in another OUT")
    leaves = [jax.numpy.asarray(found[key], leaf.dtype) for key, leaf in wanted.items()]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


@contextlib.contextmanager
def _explained(path: Path):
    try:
        yield
    except Exception as error:
        if isinstance(error, UserError):
            raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(
            f"checkpoint {path} is damaged or incomplete ({reason}); delete that folder to use an older one"
        ) from error
