"""Answers to many queries, block by block: in a folder beside the file that they end in, so that nothing is lost and memory
holds one block at a time."""

import contextlib
import json
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wbgs_jax._util.archives import opened_archive, told
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, read_json, write_json

QUESTION = "question.json"
QUICK = 1
"""Level of compression: spectra are hardly smaller at higher ones."""
SHARED = ("offsets_hz", "delays_s", "tx_elements")
"""Arrays that belong to all queries alike; all others have a row a query (or several: tables of paths)."""


class Answers:
    """Blocks of answers in memory: arrays by name."""

    def __init__(self, blocks: list[Mapping[str, np.ndarray]] | None = None):
        self._blocks = blocks or []

    def __len__(self) -> int:
        return len(self._blocks)

    def add(self, block: Mapping[str, np.ndarray]) -> None:
        """Keeps one more block."""
        self._blocks.append(block)

    @contextlib.contextmanager
    def opened(self, number: int) -> Iterator[Mapping[str, np.ndarray]]:
        """Gives a block."""
        yield self._blocks[number]

    def names(self) -> list[str]:
        """Returns the names of arrays with a row a query."""
        with self.opened(0) as block:
            return [name for name in block if name not in SHARED]

    def shared(self) -> dict[str, np.ndarray]:
        """Returns the arrays that belong to all queries alike."""
        with self.opened(0) as block:
            return {name: block[name] for name in block if name in SHARED}

    def pieces(self, name: str) -> Iterator[np.ndarray]:
        """Gives an array block by block."""
        for number in range(len(self)):
            with self.opened(number) as block:
                yield block[name]

    def whole(self, name: str, most: int | None = None) -> np.ndarray:
        """Returns an array, or its first `most` rows."""
        parts: list[np.ndarray] = []
        for piece in self.pieces(name):
            parts.append(piece)
            if most is not None and sum(map(len, parts)) >= most:
                break
        return _joined(parts)[:most]

    def rows(self, name: str, wanted: np.ndarray) -> np.ndarray:
        """Returns some rows of an array, by their numbers in ascending order."""
        found, start = [], 0
        for piece in self.pieces(name):
            inside = wanted[(wanted >= start) & (wanted < start + len(piece))]
            found.append(piece[inside - start])
            start += len(piece)
        return _joined(found)

    def remove(self) -> None:
        """Forgets what is no longer needed."""


class PartFiles(Answers):
    """Blocks of answers in a folder."""

    def __init__(self, folder: Path, done: int):
        super().__init__()
        self.folder, self.done = folder, done

    def __len__(self) -> int:
        return self.done

    def add(self, block: Mapping[str, np.ndarray]) -> None:
        """Writes one more block, whole or not at all."""
        with atomic_write(_file(self.folder, self.done)) as stream:
            arrays: dict[str, Any] = dict(block)
            np.savez(stream, **arrays)
        self.done += 1

    @contextlib.contextmanager
    def opened(self, number: int) -> Iterator[Mapping[str, np.ndarray]]:
        """Gives a block; its arrays are read when they are asked for."""
        path = _file(self.folder, number)
        with opened_archive(path, "", "remove it and all after it, and go on with --resume") as block:
            yield block

    def remove(self) -> None:
        """Removes the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def part_folder(target: Path) -> Path:
    """Returns where the blocks of a file's answers are kept until all are there."""
    return target.with_name(f"{target.name}.part")


def open_parts(target: Path, question: dict[str, Any], resume: bool) -> PartFiles:
    """Returns the blocks beside a file: none, or with `resume` those that an interrupted command left.

    Raises:
        UserError: blocks are there and are not to be used, or answer another question.
    """
    folder = part_folder(target)
    done = 0
    while _file(folder, done).exists():
        done += 1
    if done and not resume:
        raise UserError(
            f"{folder} holds answers of an interrupted command; add --resume to go on with it, or remove the folder"
        )
    if done and (changed := _difference(read_json(folder / QUESTION), question)):
        raise UserError(f"{folder} holds answers to another question ({changed}); remove the folder, or choose another --out")
    if not done:
        write_json(folder / QUESTION, question)
    return PartFiles(folder, done)


def write_archive(
    path: Path, answers: Answers, shape: tuple[int, ...] | None, known: dict[str, Any], source: dict[str, Any]
) -> None:
    """Writes answers as a compressed .npz file, block by block.

    Args:
        path: of the file.
        answers: all of them.
        shape: leading axes in place of the queries' one; None for tables, whose rows are no queries.
        known: further arrays.
        source: where they come from, JSON text in `meta`.
    """
    single = {**answers.shared(), **known, "meta": np.array(json.dumps(source))}
    with atomic_write(path) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=QUICK) as archive:
        for name in answers.names():
            shapes, dtypes = zip(*((piece.shape, piece.dtype) for piece in answers.pieces(name)), strict=True)
            count, dtype = sum(one[0] for one in shapes), np.result_type(*dtypes)
            leading = (count,) if shape is None else shape
            header = {"descr": dtype.str, "fortran_order": False, "shape": (*leading, *shapes[0][1:])}
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_2_0(member, header)
                for piece in answers.pieces(name):
                    member.write(np.ascontiguousarray(piece, dtype).tobytes())
        for name, values in single.items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.asarray(values), allow_pickle=False)


def _joined(pieces: list[np.ndarray]) -> np.ndarray:
    with told("a block of kept answers", "remove the folder of blocks, and ask again"):
        return np.concatenate(pieces)


def _file(folder: Path, number: int) -> Path:
    return folder / f"{number:06}.npz"


def _difference(before: Any, now: dict[str, Any]) -> str:
    before = before if isinstance(before, dict) else {}
    return ", ".join(key for key in now if before.get(key) != json.loads(json.dumps(now[key])))
