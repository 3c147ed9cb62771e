"""A checksum of a data set: a run keeps that of its data, so that nobody goes on with others under the same name."""

import dataclasses
import hashlib

import jax
import numpy as np

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import Dataset

NAMES = ("name", "convention")


def checksum(dataset: Dataset) -> str:
    """Returns a checksum (SHA-256) of all numbers of a data set, its split included; names do not count."""
    found = hashlib.sha256()
    parts = {field.name: getattr(dataset, field.name) for field in dataclasses.fields(dataset) if field.name not in NAMES}
    parts["materials"] = None if dataset.materials is None else dataclasses.asdict(dataset.materials) | {"names": ()}
    for path, leaf in jax.tree_util.tree_leaves_with_path(parts):
        array = np.ascontiguousarray(leaf)
        found.update(f"{jax.tree_util.keystr(path)} {array.dtype.str} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def check_data(dataset: Dataset, expected: str, where: str) -> Dataset:
    """Returns a data set whose checksum is the expected one (empty: not known); any other is a `UserError`."""
    if expected and checksum(dataset) != expected:
        raise UserError(f"the data of {where} are not those that it was trained on; put them back, or train again")
    return dataset
