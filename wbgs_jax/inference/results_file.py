"""Storage of predictions, and their output as files and as lines of text.

The predictions for many queries are stored block by block in a folder next to the result file, so that an interruption loses
at most one block and only one block is in memory at a time.
"""

import contextlib
import json
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wbgs_jax._util.cli import link_words
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, opened_archive, read_json, reported, write_csv, write_json
from wbgs_jax.inference.quantities import QUANTITIES
from wbgs_jax.inference.queries import COLUMNS, Queries, shown_rows

SHARED = ("offsets_hz", "delays_s", "tx_elements")
"""Arrays common to all queries; all others have one row per query (or several: tables of paths)."""


class Answers:
    """Blocks of predictions in memory: arrays by name."""

    def __init__(self, blocks: list[Mapping[str, np.ndarray]] | None = None):
        self._blocks = blocks or []

    def __len__(self) -> int:
        return len(self._blocks)

    def add(self, block: Mapping[str, np.ndarray]) -> None:
        """Appends a block."""
        self._blocks.append(block)

    @contextlib.contextmanager
    def opened(self, number: int) -> Iterator[Mapping[str, np.ndarray]]:
        """Yields a block."""
        yield self._blocks[number]

    def names(self) -> list[str]:
        """Returns the names of the arrays with rows for queries."""
        with self.opened(0) as block:
            return [name for name in block if name not in SHARED]

    def shared(self) -> dict[str, np.ndarray]:
        """Returns the arrays common to all queries."""
        with self.opened(0) as block:
            return {name: block[name] for name in block if name in SHARED}

    def pieces(self, name: str) -> Iterator[np.ndarray]:
        """Yields an array block by block."""
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
        """Returns rows of an array by their indices, which must be ascending."""
        found, start = [], 0
        for piece in self.pieces(name):
            inside = wanted[(wanted >= start) & (wanted < start + len(piece))]
            found.append(piece[inside - start])
            start += len(piece)
        return _joined(found)

    def remove(self) -> None:
        """Removes temporary data."""


class PartFiles(Answers):
    """Blocks of predictions in a folder."""

    def __init__(self, folder: Path, done: int):
        super().__init__()
        self.folder, self.done = folder, done

    def __len__(self) -> int:
        return self.done

    def add(self, block: Mapping[str, np.ndarray]) -> None:
        """Writes one more block, either completely or not at all."""
        with atomic_write(_file(self.folder, self.done)) as stream:
            arrays: dict[str, Any] = dict(block)
            np.savez(stream, **arrays)
        self.done += 1

    @contextlib.contextmanager
    def opened(self, number: int) -> Iterator[Mapping[str, np.ndarray]]:
        """Yields a block; its arrays are read when they are accessed."""
        path = _file(self.folder, number)
        with opened_archive(path, "", "remove it and all later blocks, and continue with --resume") as block:
            yield block

    def remove(self) -> None:
        """Removes the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def part_folder(target: Path) -> Path:
    """Returns the folder of the blocks of an incomplete result file."""
    return target.with_name(f"{target.name}.part")


def open_parts(target: Path, question: dict[str, Any], resume: bool) -> PartFiles:
    """Returns the blocks of a result file: none yet or, with `resume`, those of an interrupted command.

    Raises:
        UserError: there are blocks without `resume`, or the blocks belong to other queries.
    """
    folder = part_folder(target)
    recorded, done = folder / "question.json", 0
    while _file(folder, done).exists():
        done += 1
    if done and not resume:
        raise UserError(
            f"{folder} contains results of an interrupted command; add --resume to continue it, or remove the folder"
        )
    if done and (changed := _difference(read_json(recorded), question)):
        raise UserError(
            f"{folder} contains results of another command ({changed} changed); remove the folder, or choose another --out"
        )
    if not done:
        write_json(recorded, question)
    return PartFiles(folder, done)


def write_archive(
    path: Path, answers: Answers, shape: tuple[int, ...] | None, known: dict[str, Any], source: dict[str, Any]
) -> None:
    """Writes predictions to a compressed .npz file, block by block.

    Args:
        path: the file.
        answers: all blocks.
        shape: leading axes that replace the axis of queries; None for tables, whose rows are not queries.
        known: further arrays.
        source: provenance, stored as JSON text in `meta`.
    """
    single = {**answers.shared(), **known, "meta": np.array(json.dumps(source))}
    quick = 1  # compression level; higher levels make spectra hardly smaller
    with atomic_write(path) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=quick) as archive:
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


def write_arrays(path: Path, arrays: dict[str, Any], source: dict[str, Any]) -> None:
    """Writes arrays to a compressed .npz file, with their provenance as JSON text in `meta`."""
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **arrays | {"meta": np.array(json.dumps(source))})


def _joined(pieces: list[np.ndarray]) -> np.ndarray:
    with reported("a stored block of results", "remove the folder of blocks, and run the command again"):
        return np.concatenate(pieces)


def _file(folder: Path, number: int) -> Path:
    return folder / f"{number:06}.npz"


def _difference(before: Any, now: dict[str, Any]) -> str:
    before = before if isinstance(before, dict) else {}
    return ", ".join(key for key in now if before.get(key) != json.loads(json.dumps(now[key])))


DIGITS, EXACT = ".7g", ".12g"
"""Formats of results, which are in single precision, and of places and frequencies."""


def write(path: Path, what: str, answers: Answers, queries: Queries, source: dict[str, Any]) -> None:
    """Writes all predictions: to a .csv file with one row per query or path, or to an .npz file with arrays (tx, freq, ...), or
    (queries, ...) if the queries are paired."""
    if path.suffix == ".csv":
        write_csv(path, table_rows(answers) if QUANTITIES[what].form == "table" else query_rows(answers, queries))
        return
    known: dict[str, Any] = {}
    if QUANTITIES[what].form != "table":
        known = {"tx_positions": queries.tx_positions, "frequencies_hz": queries.frequencies_hz}
    write_archive(path, answers, None if QUANTITIES[what].form == "table" else queries.shape, known, source)


def query_rows(answers: Answers, queries: Queries) -> Iterator[list[Any]]:
    """Yields a header, then one row per query with x, y, z, ghz and the predicted numbers."""
    names = answers.names()
    columns = []
    two = ("azimuth", "zenith")  # prefixes of the column names of pairs of angles
    for name in names:
        values = answers.whole(name)
        if values.ndim == 1:
            columns.append((name, values))
        else:
            columns += [(f"{two[i]}_{name}", values[:, i]) for i in range(values.shape[1])]
    yield [*COLUMNS, *(name for name, _ in columns)]
    positions, frequencies = queries.flat()
    for i, (position, frequency) in enumerate(zip(positions, frequencies, strict=True)):
        link, numbers = (*position, frequency / 1e9), (values[i] for _, values in columns)
        yield [*(format(float(part), EXACT) for part in link), *(format(float(number), DIGITS) for number in numbers)]


def table_rows(answers: Answers) -> Iterator[list[Any]]:
    """Yields a header, then the rows of a table; columns that hold several numbers per row are in archives only."""
    names = [name for name in answers.names() if next(answers.pieces(name)).ndim == 1]
    digits = [EXACT if name in (*COLUMNS, "frequency_ghz") else DIGITS for name in names]
    yield names
    for number in range(len(answers)):
        with answers.opened(number) as block:
            for row in zip(*(block[name] for name in names), strict=True):
                cells = zip(row, digits, strict=True)
                yield [format(value, own) if isinstance(value, np.floating) else value for value, own in cells]


def lines(what: str, answers: Answers, queries: Queries, source: dict[str, Any]) -> list[str]:
    """Returns lines with the expected quality of some of the predictions, if the run has prediction intervals. Their level is
    in `source` (`LoadedField.source`)."""
    if QUANTITIES[what].form == "table" or not {"expected", "within_db"} & set(answers.names()):
        return []
    shown = shown_rows(len(queries))
    positions, frequencies = (part[shown] for part in queries.flat())
    where = [link_words(position, float(frequency)) for position, frequency in zip(positions, frequencies, strict=True)]
    level = f"{100 * source['interval_level' if what == 'spectra' else 'power_interval_level']:.0f} %"
    places = "outside of the scene or of the trained band, at the receiver, or where no antenna can be placed"
    no_confidence = f"no prediction interval ({places})"
    if what == "spectra":
        expected = zip(where, answers.rows("expected", shown), strict=True)
        return [
            f"{link}: {no_confidence}"
            if np.isnan(ssim)
            else f"{link}: expected SSIM {ssim:.2f}, {level} between {low:.2f} and {high:.2f}"
            for link, (ssim, low, high) in expected
        ]
    columns = (answers.rows(name, shown) for name in ("power_db", "expected_error_db", "within_db"))
    return [
        f"{link}: {power:.1f} dB relative to the transmitted power; "
        + (no_confidence if np.isnan(error) else f"expected error {error:.1f} dB, {level} within {within:.1f} dB")
        for link, power, error, within in zip(where, *columns, strict=True)
    ]
