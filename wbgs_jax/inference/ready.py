"""A trained field made ready for one receiver: asked again, it answers at once.

Reading a run, planning its receiver and tracing its model takes many times as long as one answer. The first command that asks
leaves behind what came of it, in the folder of compiled programs: the program, which runs of equal shapes share, and the arrays
that it wants. The next one needs neither the run's data nor the model's code, as long as none of the files has changed.
"""

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from wbgs_jax._util.compilation import cache_folder, load_program, source_digest, trace_program
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, opened_archive
from wbgs_jax.types import Query, Receiver

MOST = 16
"""Queries of an answer."""
LARGEST = 200e6
"""Bytes of arrays that are kept: reading more takes as long as planning does."""
FOLDER = "ready"
META = "meta"
QUANTITIES = {
    "spectra": ("pas", "expected"),
    "power": ("power_db", "expected_error_db", "within_db"),
    "snapshot": ("snapshots",),
}
"""Names of the answers to what can be asked for; those of `wbgs-jax predict --what`."""


@dataclass(frozen=True)
class Ready:
    """A field that answers up to `MOST` queries at a time."""

    meta: dict[str, Any]
    """What lines and files say of it: `source`, `bounds` (`answers.Bounds`), `what` (names in `QUANTITIES`), `lowest_hz`."""
    arrays: tuple[np.ndarray, ...]
    program: Callable[..., dict[str, Any]]

    def __call__(
        self, what: str, tx_positions: Float[np.ndarray, "n 3"], frequencies_hz: Float[np.ndarray, " n"]
    ) -> dict[str, np.ndarray]:
        """Returns what is known of n queries, by name, leading axis n."""
        chosen = np.minimum(np.arange(size_for(len(tx_positions))), len(tx_positions) - 1)  # the last one fills it up
        query = np.asarray(tx_positions, np.float32)[chosen], np.asarray(frequencies_hz, np.float32)[chosen]
        found = self.program(*self.arrays, *query)
        return {name: np.asarray(found[name])[: len(tx_positions)] for name in QUANTITIES[what] if name in found}


def size_for(count: int) -> int:
    """Returns how many queries the program for this many of them takes."""
    return 1 if count == 1 else MOST


def load_ready(run: Path, rx: str, count: int) -> Ready | None:
    """Returns a run's field as `make_ready` left it; None where it did not, or where a file has changed since."""
    path = _place(run, rx, count)
    if path is None or not path.exists():
        return None
    try:
        with opened_archive(path, "", "") as archive:
            meta = json.loads(str(archive[META]))
            if meta["state"] != _state(meta["watched"]):
                return None
            arrays = tuple(archive[str(i)] for i in range(meta["arrays"]))
        return Ready(meta, arrays, load_program(path.parents[1], meta["program"]))
    except Exception:
        return None  # damaged, in whatever way: it is made again


def make_ready(
    run: Path, rx: str, count: int, trained: Any, receiver: Receiver, watched: Sequence[Path], meta: dict[str, Any]
) -> Ready | None:
    """Returns a trained field ready for one receiver, and leaves it for `load_ready`; None where nothing can be kept.

    Args:
        run: its folder.
        rx: the word that the receiver was asked for with.
        count: of the queries.
        trained: the field at the receiver (`trained_field.at_receiver`).
        receiver: at which it is asked.
        watched: files and folders that it follows from.
        meta: what is to be known of it (`Ready.meta`).
    """
    path = _place(run, rx, count)
    if path is None or not type(trained.field).__module__.startswith("wbgs_jax."):  # `source_digest` knows no others
        return None
    answer, arrays, structure = _as_function(trained, receiver)
    if sum(array.nbytes for array in arrays) > LARGEST:
        return None
    size = size_for(count)
    shapes = [jax.ShapeDtypeStruct(array.shape, array.dtype) for array in arrays]
    asked = [jax.ShapeDtypeStruct(shape, np.float32) for shape in ((size, 3), (size,))]
    kept = {"watched": [str(place) for place in watched], "state": _state(watched), "arrays": len(arrays)}
    try:
        program = trace_program(path.parents[1], answer, [*shapes, *asked], structure)
        meta = meta | kept | {"program": program}
        with atomic_write(path) as stream:
            named: dict[str, Any] = {str(i): array for i, array in enumerate(arrays)}
            np.savez(stream, **named, meta=np.array(json.dumps(meta)))
    except UserError:  # a cache that cannot be written costs time, and no answer
        return None
    return Ready(meta, arrays, load_program(path.parents[1], program))


def _as_function(trained: Any, receiver: Receiver) -> tuple[Callable[..., dict[str, Any]], tuple[np.ndarray, ...], str]:
    """Returns a function of arrays and of a query, the arrays, and what it follows from beside their shapes."""
    from wbgs_jax.inference.intervals import expected_power, expected_ssim
    from wbgs_jax.inference.kriging import correct, for_receiver

    known = (for_receiver(learned, receiver) for learned in (trained.neighbours, trained.confidence))
    plan = trained.field.plan(trained.params, receiver)
    leaves, structure = jax.tree.flatten((trained.field, trained.params, plan, *known, trained.power_confidence, receiver))

    def answer(*arrays: Any) -> dict[str, Any]:
        field, params, plan, neighbours, confidence, of_powers, asked = jax.tree.unflatten(structure, arrays[:-2])
        query = Query(*arrays[-2:])
        seen = field.render(params, plan, query)
        found = {"pas": correct(neighbours, seen.pas, query), "power_db": seen.power_db, "snapshots": seen.snapshots}
        if confidence is not None:
            found["expected"] = jnp.stack(expected_ssim(confidence, found["pas"], query, seen.power_db), -1)
        if of_powers is not None and seen.power_db is not None:
            sure = expected_power(of_powers, seen.power_db, query, asked.position)
            found |= {"expected_error_db": sure.error_db, "within_db": sure.within_db}
        return {name: values for name, values in found.items() if values is not None}

    return answer, tuple(np.asarray(leaf) for leaf in leaves), str(structure)


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
