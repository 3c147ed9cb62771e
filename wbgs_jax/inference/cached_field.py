"""A trained field at one receiver as the commands keep it: the next one answers at once.

Reading a run, planning its receiver and tracing its model takes many times as long as one answer. The first command leaves what
came of it in the folder of compiled programs: the program (`export.answer_all`), which runs of equal shapes share, and the
arrays that it takes. The next one needs neither the run's data nor the model's code, as long as none of the files has changed.
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
from wbgs_jax.inference.domain import Domain
from wbgs_jax.inference.quantities import QUANTITIES
from wbgs_jax.inference.queries import Product
from wbgs_jax.types import Query

if TYPE_CHECKING:
    from wbgs_jax.inference.evaluate_quantities import LoadedField

MOST = 16
"""Queries of an answer."""
LARGEST = 200e6
"""Bytes of arrays that are kept: reading more takes as long as planning does."""
FOLDER = "ready"
META = "meta"


@dataclass(frozen=True)
class CachedField:
    """A field that answers up to `MOST` queries at a time."""

    meta: dict[str, Any]
    """`source` and `domain` (of `LoadedField`, as JSON), `what` (names of quantities), `lowest_hz`."""
    arrays: tuple[np.ndarray, ...]
    program: Callable[..., dict[str, Any]]

    @property
    def source(self) -> dict[str, Any]:
        """Where its answers come from (`LoadedField.source`)."""
        return dict(self.meta["source"])

    @cached_property
    def domain(self) -> Domain:
        """Where it was trained."""
        return Domain.from_json(self.meta["domain"])

    def answer(self, what: str, block: list[Product]) -> dict[str, np.ndarray]:
        """Returns what `LoadedField.answer` does, for at most `MOST` queries."""
        rows = np.concatenate([product.rows for product in block])
        order = np.argsort(rows)
        positions = np.concatenate([np.repeat(one.tx_positions, len(one.frequencies_hz), axis=0) for one in block])[order]
        frequencies = np.concatenate([np.tile(one.frequencies_hz, len(one.tx_positions)) for one in block])[order]
        chosen = np.minimum(np.arange(size_for(len(rows))), len(rows) - 1)  # the last query fills the block up
        query = np.asarray(positions, np.float32)[chosen], np.asarray(frequencies, np.float32)[chosen]
        found = self.program(*self.arrays, *query)
        answers = {name: np.asarray(found[name])[: len(rows)] for name in QUANTITIES[what].outputs if name in found}
        return self.domain.without_intervals(answers, positions)


def size_for(count: int) -> int:
    """Returns how many queries the program for this many of them takes."""
    return 1 if count == 1 else MOST


def load_cached(run: Path, rx: str, what: str, count: int, lowest_hz: float) -> CachedField | None:
    """Returns a run's field as `make_cached` left it; None where it did not, where a file has changed since, or where it cannot
    answer.

    Args:
        run: the run folder.
        rx: the receiver, as on the command line.
        what: a name of `QUANTITIES`.
        count: of the queries.
        lowest_hz: the lowest frequency among them.
    """
    path = _place(run, rx, count)
    if count > MOST or path is None or not path.exists():
        return None
    try:
        with opened_archive(path, "", "") as archive:
            meta = json.loads(str(archive[META]))
            if meta["state"] != _state(meta["watched"]) or what not in meta["what"] or lowest_hz < meta["lowest_hz"]:
                return None
            arrays = tuple(archive[str(i)] for i in range(meta["arrays"]))
        return CachedField(meta, arrays, load_program(path.parents[1], meta["program"]))
    except Exception:
        return None  # damaged, in whatever way: it is made again


def make_cached(run: Path, rx: str, count: int, loaded: "LoadedField", watched: Sequence[Path]) -> CachedField | None:
    """Returns a trained field at one receiver for few queries, and leaves it for `load_cached`; None where nothing can be kept.

    Args:
        run: its folder.
        rx: the receiver, as on the command line.
        count: of the queries.
        loaded: the field at that receiver.
        watched: files and folders that it follows from.
    """
    from wbgs_jax.inference.evaluate_quantities import known_quantities, lowest_frequency
    from wbgs_jax.inference.export import FROZEN, answer_all, freeze, frozen_outputs

    path, trained = _place(run, rx, count), loaded.trained
    if path is None or not type(trained.field).__module__.startswith("wbgs_jax."):  # `source_digest` knows no others
        return None
    names = frozen_outputs(trained, loaded.dataset)
    leaves, structure = jax.tree.flatten(freeze(trained, loaded.receiver))
    arrays = tuple(np.asarray(leaf) for leaf in leaves)
    if sum(array.nbytes for array in arrays) > LARGEST:
        return None

    def answer(*arrays: Any) -> dict[str, Any]:
        return answer_all(jax.tree.unflatten(structure, arrays[:-2]), Query(*arrays[-2:]), names)

    size = size_for(count)
    shapes = [jax.ShapeDtypeStruct(array.shape, array.dtype) for array in arrays]
    asked = [jax.ShapeDtypeStruct(shape, np.float32) for shape in ((size, 3), (size,))]
    meta = {
        "source": loaded.source,
        "domain": loaded.domain.as_json(),
        "what": [what for what in FROZEN if what in known_quantities(trained.field, loaded.dataset)],
        "lowest_hz": lowest_frequency(trained.field, loaded.dataset),
        "watched": [str(place) for place in watched],
        "state": _state(watched),
        "arrays": len(arrays),
    }
    try:
        program = trace_program(path.parents[1], answer, [*shapes, *asked], f"{structure} {names}")
        with atomic_write(path) as stream:
            named: dict[str, Any] = {str(i): array for i, array in enumerate(arrays)}
            np.savez(stream, **named, meta=np.array(json.dumps(meta | {"program": program})))
    except UserError:  # a cache that cannot be written costs time, and no answer
        return None
    return CachedField(meta, arrays, load_program(path.parents[1], program))


def _place(run: Path, rx: str, count: int) -> Path | None:
    folder = cache_folder()
    words = os.fsencode(run.resolve()) + f"\n{rx}\n{size_for(count)}".encode()
    return None if folder is None else folder / FOLDER / f"{hashlib.sha256(words).hexdigest()[:32]}.npz"


def _state(watched: Sequence[Path | str]) -> str:
    """Returns a checksum that changes where this package, JAX or one of the files does (by size and time)."""
    words = [source_digest(), jax.__version__, jax.default_backend(), os.environ.get("XLA_FLAGS", "")]
    for root in map(Path, watched):
        for path in sorted(root.rglob("*")) if root.is_dir() else [root]:
            there = path.stat() if path.exists() else None
            words.append(f"{path} {there and (there.st_size, there.st_mtime_ns)}")
    return hashlib.sha256(os.fsencode("\n".join(words))).hexdigest()
