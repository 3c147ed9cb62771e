"""Queries from command lines and files: transmitters and frequencies, in all combinations or in pairs."""

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from wbgs_jax._util.cli import parse_number, parse_vector
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_csv

COLUMNS = ("x", "y", "z", "ghz")
"""Columns of a file of queries."""


class Product(NamedTuple):
    """All combinations of some transmitters and some frequencies."""

    rows: Int[np.ndarray, " n"]
    """Indices of the queries; the frequency varies fastest."""
    tx_numbers: Int[np.ndarray, " tx"]
    tx_positions: Float[np.ndarray, "tx 3"]
    frequencies_hz: Float[np.ndarray, " freq"]


@dataclass(frozen=True)
class Queries:
    """Every transmitter at every frequency or, if `paired`, the i-th transmitter at the i-th frequency."""

    tx_positions: Float[np.ndarray, "tx 3"]
    """World frame, metres."""
    frequencies_hz: Float[np.ndarray, " freq"]
    paired: bool = False

    def __len__(self) -> int:
        return len(self.tx_positions) * (1 if self.paired else len(self.frequencies_hz))

    @property
    def shape(self) -> tuple[int, ...]:
        """Leading axes of a result: (tx, freq), or (queries,) if paired."""
        return (len(self),) if self.paired else (len(self.tx_positions), len(self.frequencies_hz))

    def flat(self) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        """Returns the positions and frequencies of all queries, frequency fastest."""
        if self.paired:
            return self.tx_positions, self.frequencies_hz
        tx, freq = self.shape
        return np.repeat(self.tx_positions, freq, axis=0), np.tile(self.frequencies_hz, tx)

    def some(self, rows: Int[np.ndarray, " k"]) -> "Queries":
        """Returns a selection of the queries, paired."""
        positions, frequencies = self.flat()
        return Queries(positions[rows], frequencies[rows], paired=True)

    def blocks(self, size: int) -> list[list[Product]]:
        """Returns all queries in order, in blocks of at most about `size`. A block is a range of queries as a list of products,
        so that work for a transmitter or a frequency is done once."""
        if self.paired:
            return [
                list(self._by_frequency(np.arange(start, min(start + size, len(self))))) for start in range(0, len(self), size)
            ]
        tx, freq = self.shape
        step_freq = min(size, freq)
        step_tx = max(size // freq, 1)
        rows = np.arange(tx * freq).reshape(tx, freq)
        blocks = []
        for i in range(0, tx, step_tx):
            for j in range(0, freq, step_freq):
                some, at = slice(i, i + step_tx), slice(j, j + step_freq)
                numbers = np.arange(tx)[some]
                blocks.append([Product(rows[some, at].ravel(), numbers, self.tx_positions[some], self.frequencies_hz[at])])
        return blocks

    def _by_frequency(self, rows: Int[np.ndarray, " k"]) -> Iterator[Product]:
        for frequency in np.unique(self.frequencies_hz[rows]):
            alike = rows[self.frequencies_hz[rows] == frequency]
            yield Product(alike, alike, self.tx_positions[alike], np.array([frequency]))

    def digest(self) -> str:
        """Returns a checksum of all positions and frequencies."""
        positions, frequencies = (np.ascontiguousarray(part, np.float64) for part in self.flat())
        return hashlib.sha256(positions.tobytes() + frequencies.tobytes()).hexdigest()


def flatten(
    block: list[Product],
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Returns the order that sorts a block's products, one after the other, into the order of the queries, and the position
    (metres) and frequency (hertz) of each query in that order."""
    order = np.argsort(np.concatenate([product.rows for product in block]))
    flat = [Queries(product.tx_positions, product.frequencies_hz).flat() for product in block]
    positions, frequencies = (np.concatenate(parts)[order] for parts in zip(*flat, strict=True))
    return order, positions, frequencies


def shown_rows(count: int) -> Int[np.ndarray, " k"]:
    """Returns the indices of the queries in a figure: all, or twelve evenly spaced ones."""
    return np.unique(np.linspace(0, count - 1, min(count, 12)).round().astype(int))


def check_count(count: int, source: str) -> None:
    """Raises a `UserError` for too many queries."""
    most = 1_000_000  # maximum number of queries
    if count > most:
        raise UserError(f"{source} gives {count:,} queries; at most {most:,} are possible at a time")


def parse_line(word: str) -> Float[np.ndarray, "tx 3"]:
    """Returns equally spaced positions (metres), including both ends, parsed from "x,y,z:x,y,z:NUMBER"."""
    start, end, number = _three(word, "--line", "0,0,1.5:4,0,1.5:41")
    count = _number(number, "--line", word)
    first, last = (parse_vector(place, "--line", "position", "metres") for place in (start, end))
    return np.linspace(first, last, count)


def parse_grid(word: str) -> Float[np.ndarray, "tx 3"]:
    """Returns the positions of a grid (metres), x fastest, parsed from "x,y,z:x,y,z:NXxNYxNZ": lowest corner, highest corner,
    and the number of positions along each axis."""
    example = "-2,-2,1.5:2,2,1.5:9x9x1"
    low, high, number = _three(word, "--grid", example)
    counts = [_number(part, "--grid", word) for part in number.split("x")]
    if len(counts) != 3:
        raise UserError(
            f"--grid {word[:60]} lacks three numbers of points after the corners; give x,y,z:x,y,z:NXxNYxNZ, such as {example}"
        )
    check_count(int(np.prod(counts)), "--grid")
    corners = [parse_vector(corner, "--grid", "position", "metres") for corner in (low, high)]
    axes = [np.linspace(a, b, n) for a, b, n in zip(*corners, counts, strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    return np.stack([x, y, z], -1).reshape(-1, 3)


def parse_sweep(word: str) -> tuple[float, ...]:
    """Returns logarithmically spaced frequencies (GHz), including both ends, parsed from "LOWEST:HIGHEST:NUMBER"."""
    low, high, number = _three(word, "--sweep", "1:100:50")
    try:
        ends = parse_number(low), parse_number(high)
    except ValueError:
        ends = np.nan, np.nan
    if not (0 < ends[0] < np.inf and 0 < ends[1] < np.inf):
        raise UserError(f"--sweep {word[:60]} lacks two frequencies; give LOWEST:HIGHEST:NUMBER in GHz, such as 1:100:50")
    swept = np.geomspace(*ends, _number(number, "--sweep", word))
    return tuple(np.clip(swept, min(ends), max(ends)).tolist())  # rounding must not exceed the band


def parse_array(word: str, option: str = "--tx-array") -> tuple[int, int]:
    """Returns the numbers of rows and columns, parsed from "4x2"; anything else is a `UserError`."""
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", word)
    rows, columns = (int(number) for number in found.groups()) if found else (0, 0)
    most_elements = 1024  # maximum number of elements of an array
    if not 0 < rows * columns <= most_elements:
        raise UserError(f"{option} {word} is not an array; give ROWSxCOLUMNS, such as 4x2, at most {most_elements} elements")
    return rows, columns


def read_queries(path: Path) -> tuple[Float[np.ndarray, "n 3"], tuple[float, ...]]:
    """Returns positions (metres) and frequencies (GHz) of a CSV file with the columns x, y, z and ghz, one row per query."""
    table = _read_columns(path, COLUMNS, "queries")
    return table[:, :3], tuple(table[:, 3].tolist())


def read_positions(path: Path) -> Float[np.ndarray, "n 3"]:
    """Returns the positions (metres) of a CSV file with the columns x, y and z."""
    return _read_columns(path, COLUMNS[:3], "places")


def _read_columns(path: Path, columns: tuple[str, ...], name: str) -> Float[np.ndarray, "n columns"]:
    """Returns columns of a CSV file, the first three of which are positions, metres."""
    (names, rows), needed = read_csv(path), ",".join(columns)
    units = "metres, gigahertz" if "ghz" in columns else "metres"
    if missing := [column for column in columns if column not in names]:
        raise UserError(f"{path} has no column {', '.join(missing)}; its first line must name {needed} ({units})")
    places, found = [names.index(column) for column in columns], []
    for line, row in rows:
        try:
            values = [parse_number(row[place]) for place in places]
        except ValueError:
            values = [np.nan]
        if not np.isfinite(values).all():
            raise UserError(f"line {line} of {path} lacks a number; give {needed} ({units})")
        found.append(values)
        check_count(len(found), str(path))
    if not found:
        raise UserError(f"{path} has no {name}; give one per row below the line {needed}")
    for values in found:
        parse_vector(",".join(map(str, values[:3])), str(path), "position", "metres")
    return np.array(found)


def _three(word: str, option: str, example: str) -> list[str]:
    parts = word.split(":")
    if len(parts) != 3:
        raise UserError(
            f"{option} {word[:60]} does not have three parts separated by colons; give FROM:TO:NUMBER, such as {example}"
        )
    return parts


def _number(word: str, option: str, whole: str) -> int:
    if not (word.isdecimal() and len(word) < 8 and int(word) > 0):
        raise UserError(f"{option} {whole[:60]} has no number of points; {word[:20]!r} must be 1, 2, ...")
    check_count(int(word), option)
    return int(word)
