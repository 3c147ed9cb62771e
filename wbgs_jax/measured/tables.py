"""CSV files that people write: headers in any case, empty cells, one line for every mistake."""

import csv
from pathlib import Path

import numpy as np
from jaxtyping import Float

from wbgs_jax._util.errors import UserError


def found(folder: Path, names: tuple[str, ...]) -> Path:
    """Returns the first of these files that exists; none is a `UserError`."""
    for name in names:
        if (folder / name).exists():
            return folder / name
    raise UserError(f"{folder} has no {' or '.join(names)}; write it as docs/measured.md shows")


def read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Returns the header of a CSV file in small letters, and its rows, all of one length."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream)
            lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(map(str.strip, row))]
    except UnicodeDecodeError:
        raise UserError(f"{path} is no text in UTF-8; save it as CSV in UTF-8") from None
    except (OSError, csv.Error) as error:
        raise UserError(f"{path} cannot be read: {error}; check the path, or save it again as CSV") from None
    if len(lines) < 2:
        raise UserError(f"{path} has no rows below its header")
    header = [name.lower() for name in lines[0][1]]
    for sign, name in ((";", "';'"), ("\t", "tabs")):
        if len(header) == 1 and sign in header[0]:
            raise UserError(f"{path} has {name} between its cells; separate them by commas")
    if len(set(header)) < len(header):
        raise UserError(f"{path} names two columns alike: {', '.join(header)}")
    for number, row in lines[1:]:
        if len(row) != len(header):
            raise UserError(f"{path}, line {number} has {len(row)} cells, the header {len(header)}")
    return header, [row for _, row in lines[1:]]


def numbers(path: Path, header: list[str], rows: list[list[str]], columns: list[str]) -> Float[np.ndarray, "n k"]:
    """Returns some columns as numbers; empty cells are NaN."""
    if missing := [name for name in columns if name not in header]:
        raise UserError(f"{path} has no column {missing[0]!r}; its columns are {', '.join(header)}")
    where, values = [header.index(name) for name in columns], np.full((len(rows), len(columns)), np.nan)
    for i, row in enumerate(rows):
        for k, column in enumerate(where):
            try:
                values[i, k] = float(row[column]) if row[column] else np.nan
            except ValueError:
                hint = "leave cells empty where nothing was received"
                raise UserError(f"{path}, row {i + 1}: {row[column]!r} is no number; {hint}") from None
    return values
