"""Disk cache of a trained field at one receiver, so that repeated commands start quickly.

Reading a run, preparing its receiver and tracing its model take many times as long as one prediction. The first command stores
the results in the folder of compiled programs: the program (`export.answer_all`), which runs with equal shapes share, and its
input arrays. Later commands need neither the run's data nor the model's code, as long as no file has changed.
"""

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from wbgs_jax._util.compilation import cache_folder, load_program, source_digest, trace_program
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, opened_archive
from wbgs_jax._util.pytree import map_blocks
from wbgs_jax.inference.domain import Domain
from wbgs_jax.inference.quantities import COMPILED, QUANTITIES
from wbgs_jax.inference.queries import Product, flatten
from wbgs_jax.types import Query, Transmitter

if TYPE_CHECKING:
    from wbgs_jax.inference.evaluate_quantities import LoadedField

MOST = 16
"""Maximum number of queries per call."""


@dataclass(frozen=True)
class CachedField:
    """A cached field; it evaluates up to `MOST` queries at a time."""

    meta: dict[str, Any]
    """`source` and `domain` of the `LoadedField` as JSON, `what` (names of the quantities), `lowest_hz`."""
    arrays: tuple[np.ndarray, ...]
    program: Callable[..., dict[str, Any]]

    @property
    def source(self) -> dict[str, Any]:
        """Provenance of the predictions (`LoadedField.source`)."""
        return dict(self.meta["source"])

    @cached_property
    def domain(self) -> Domain:
        """Positions and frequencies that the training covered."""
        return Domain.from_json(self.meta["domain"])

    def answer(self, what: str, block: list[Product]) -> dict[str, np.ndarray]:
        """Returns the same as `LoadedField.answer`, for at most `MOST` queries."""
        _, positions, frequencies = flatten(block)

        query = np.asarray(positions, np.float32), np.asarray(frequencies, np.float32)
        found = map_blocks(lambda block: self.program(*self.arrays, *block), query, size_for(len(positions)), full=True)
        answers = {name: found[name] for name in QUANTITIES[what].outputs if name in found}  # in order: JAX sorts the names
        return self.domain.without_intervals(answers, positions, frequencies)


def size_for(count: int) -> int:
    """Returns the number of queries of the compiled program that serves `count` queries."""
    return 1 if count == 1 else MOST


def load_cached(run: Path, rx: str, what: str, count: int, lowest_hz: float) -> CachedField | None:
    """Returns the field that `make_cached` stored for a run; None if there is none, if a file has changed since then, or if it
    does not cover the queries.

    Args:
        run: the run folder.
        rx: the receiver, as on the command line.
        what: a name of `QUANTITIES`.
        count: number of queries.
        lowest_hz: their lowest frequency.
    """
    if count > MOST or what not in COMPILED:
        return None
    path = _place(run, rx, count)
    if path is None or not path.exists():
        return None
    try:
        with opened_archive(path, "", "") as archive:
            meta = json.loads(str(archive["meta"]))
            if what not in meta["what"] or lowest_hz < meta["lowest_hz"] or meta["state"] != state_of(meta["watched"]):
                return None
            arrays = tuple(archive[str(i)] for i in range(meta["arrays"]))
        return CachedField(meta, arrays, load_program(path.parents[1], meta["program"]))
    except Exception:
        return None  # damaged in some way: it is created again


def make_cached(
    run: Path, rx: str, count: int, loaded: "LoadedField", watched: Sequence[Path], state: str
) -> CachedField | None:
    """Stores a trained field at one receiver for `load_cached`, and returns it; None if it cannot be stored.

    Args:
        run: the run folder.
        rx: the receiver, as on the command line.
        count: number of queries.
        loaded: the field at that receiver.
        watched: files and folders from which it is derived; a change invalidates the stored field.
        state: result of `state_of` for them, from before they were read: a training may write to them meanwhile.
    """
    from wbgs_jax.inference.evaluate_quantities import lowest_frequency
    from wbgs_jax.inference.export import answer_all, freeze, frozen_outputs

    path, trained = _place(run, rx, count), loaded.trained
    if path is None or not type(trained.field).__module__.startswith("wbgs_jax."):  # `source_digest` covers only this package
        return None
    names = frozen_outputs(trained, loaded.dataset)
    leaves, structure = jax.tree.flatten(freeze(trained, loaded.receiver))
    arrays = tuple(np.asarray(leaf) for leaf in leaves)
    largest = 200e6  # maximum size of the stored arrays, bytes; reading more takes as long as preparing the receiver
    if sum(array.nbytes for array in arrays) > largest:
        return None

    def answer(*arrays: Any) -> dict[str, Any]:
        return answer_all(jax.tree.unflatten(structure, arrays[:-2]), Query(Transmitter(arrays[-2]), arrays[-1]), names)

    size = size_for(count)
    shapes = [jax.ShapeDtypeStruct(array.shape, array.dtype) for array in arrays]
    queried = [jax.ShapeDtypeStruct(shape, np.float32) for shape in ((size, 3), (size,))]
    meta = {
        "source": loaded.source,
        "domain": loaded.domain.as_json(),
        "what": [what for what in COMPILED if QUANTITIES[what].outputs[0] in names],
        "lowest_hz": lowest_frequency(trained.field, loaded.dataset),
        "watched": [str(place) for place in watched],
        "state": state,
        "arrays": len(arrays),
    }
    try:
        program = trace_program(path.parents[1], answer, [*shapes, *queried], f"{structure} {names}")
        with atomic_write(path) as stream:
            named: dict[str, Any] = {str(i): array for i, array in enumerate(arrays)}
            np.savez(stream, **named, meta=np.array(json.dumps(meta | {"program": program})))
    except UserError:  # without a cache, commands are slower but still work
        return None
    return CachedField(meta, arrays, load_program(path.parents[1], program))


def _place(run: Path, rx: str, count: int) -> Path | None:
    folder = cache_folder()
    words = os.fsencode(run.resolve()) + f"\n{rx}\n{size_for(count)}".encode()
    return None if folder is None else folder / "ready" / f"{hashlib.sha256(words).hexdigest()[:32]}.npz"


def state_of(watched: Sequence[Path | str]) -> str:
    """Returns a checksum that changes with this package, JAX and the files (their sizes and modification times)."""
    words = [source_digest(), jax.__version__, jax.default_backend(), os.environ.get("XLA_FLAGS", "")]
    for root in map(Path, watched):
        for path in sorted(root.rglob("*")) if root.is_dir() else [root]:
            there = path.stat() if path.exists() else None
            words.append(f"{path} {there and (there.st_size, there.st_mtime_ns)}")
    return hashlib.sha256(os.fsencode("\n".join(words))).hexdigest()
