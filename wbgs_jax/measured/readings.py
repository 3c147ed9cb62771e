"""Readings of received power at several fixed receivers from many places, read from folders and averaged over cells.

    readings.csv (or calibration.csv)   x,y[,z][,room], then one column a receiver, dBm: rssi_1,rssi_2,... ; empty: not received
    receivers.csv (or anchors.csv)      id,x,y,z, in the order of those columns
    walls.csv (or layout.csv)           optional; floor_plan.py

or as NeRF2 publishes received powers of Bluetooth gateways: tx_pos.csv (x,y,z), gateway_position.yml (name: [x, y, z]) and
gateway_rssi.csv (one column a gateway; -100: not received). Metres and one frame throughout. Headers may be in capitals.
Columns of powers that end in the receivers' ids may stand in any order; others stand in that of the receivers.
"""

import csv
import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Bool, Float, Int

from wbgs_jax._util.errors import UserError

READINGS, RECEIVERS = ("readings.csv", "calibration.csv"), ("receivers.csv", "anchors.csv")
NERF2 = ("tx_pos.csv", "gateway_position.yml", "gateway_rssi.csv")
NERF2_NOT_RECEIVED = -100.0
POWERS_DBM = (-200.0, 50.0)
"""Beyond it numbers are no powers; +100 often stands for nothing."""
FURTHEST = 1e4
"""Metres."""


@dataclass(frozen=True)
class Readings:
    """N places at which R receivers were, or were not, heard."""

    places: Float[np.ndarray, "n 3"]
    """Of the transmitter, metres."""
    powers: Float[np.ndarray, "n r"]
    """dBm; NaN where nothing was received."""
    counts: Float[np.ndarray, "n r"]
    """Readings that a power is the mean of."""
    rooms: tuple[str, ...]
    """Of every place; empty where nobody has said."""
    receivers: Float[np.ndarray, "r 3"]
    """Metres."""

    def without(self, places: Bool[np.ndarray, " n"]) -> "Readings":
        """Returns them as if nothing had been received from some of the places."""
        return dataclasses.replace(self, powers=np.where(places[:, None], np.nan, self.powers))


def load_readings(folder: Path, height: float) -> Readings:
    """Reads a folder.

    Args:
        folder: in one of the layouts above.
        height: of the transmitter above the floor (metres), where the file has no column z.

    Raises:
        UserError: a file is missing or damaged.
    """
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}")
    if (folder / NERF2[2]).exists():
        return _checked(_load_nerf2(folder), folder)
    return _checked(_load_tables(folder, height), folder)


def found(folder: Path, names: tuple[str, ...]) -> Path:
    """Returns the first of these files that exists; none is a `UserError`."""
    for name in names:
        if (folder / name).exists():
            return folder / name
    raise UserError(f"{folder} has no {' or '.join(names)}; docs/measured.md shows the layout")


def read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Returns the header of a CSV file in small letters, and its rows, all of one length."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream)
            lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(map(str.strip, row))]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} cannot be read: {error}") from None
    if len(lines) < 2:
        raise UserError(f"{path} has no rows below its header")
    header = [name.lower() for name in lines[0][1]]
    if len(header) == 1 and ";" in header[0]:
        raise UserError(f"{path} has ';' between its cells; separate them by commas")
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


def _load_tables(folder: Path, height: float) -> Readings:
    path, of_receivers = found(folder, READINGS), found(folder, RECEIVERS)
    names, entries = read_table(of_receivers)
    receivers = numbers(of_receivers, names, entries, ["x", "y", "z"])
    header, rows = read_table(path)
    powers = [name for name in header if name not in ("x", "y", "z", "room")]
    if len(powers) != len(receivers):
        raise UserError(
            f"{path} has {len(powers)} columns of powers ({', '.join(powers)}), {of_receivers} {len(receivers)} receivers"
        )
    if "id" in names:
        powers = _in_order(powers, [entry[names.index("id")].lower() for entry in entries])
    places = numbers(path, header, rows, ["x", "y", "z"] if "z" in header else ["x", "y"])
    if places.shape[1] == 2:
        places = np.column_stack([places, np.full(len(places), height)])
    rooms = tuple(row[header.index("room")] for row in rows) if "room" in header else ("",) * len(rows)
    values = numbers(path, header, rows, powers)
    return Readings(places, values, np.isfinite(values).astype(float), rooms, receivers)


def _in_order(columns: list[str], ids: list[str]) -> list[str]:
    """Returns columns in the order of the receivers whose ids they end in; as they are, where they do not."""
    by_id = {column.rsplit("_", 1)[-1]: column for column in columns}
    return [by_id[name] for name in ids] if sorted(by_id) == sorted(ids) else columns


def _load_nerf2(folder: Path) -> Readings:
    tx, gateways, heard = (found(folder, (name,)) for name in NERF2)
    places = numbers(tx, *read_table(tx), ["x", "y", "z"])
    try:
        entries = yaml.safe_load(gateways.read_text(encoding="utf-8"))
        found_at = [entry["position"] if isinstance(entry, dict) else entry for entry in entries.values()]
        receivers = np.array([[float(value) for value in position] for position in found_at])
    except (OSError, ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError):
        raise UserError(f"{gateways} does not list positions; write 'gateway1: [x, y, z]' for each") from None
    header, rows = read_table(heard)
    values = numbers(heard, header, rows, header)
    values = np.where(values <= NERF2_NOT_RECEIVED, np.nan, values)
    if values.shape != (len(places), len(receivers)) or receivers.shape[1:] != (3,):
        raise UserError(
            f"{heard} has {values.shape[0]} rows of {values.shape[1]} powers; there are {len(places)} positions and "
            f"{len(receivers)} gateways"
        )
    return Readings(places, values, np.isfinite(values).astype(float), ("",) * len(places), receivers)


def _checked(readings: Readings, folder: Path) -> Readings:
    """Returns readings whose positions and powers are plausible."""
    check_positions(f"{folder}: places", readings.places)
    check_positions(f"{folder}: receivers", readings.receivers)
    heard = readings.powers[~np.isnan(readings.powers)]
    if not len(heard):
        raise UserError(f"{folder}: nothing was received anywhere")
    if not ((heard >= POWERS_DBM[0]) & (heard <= POWERS_DBM[1])).all():
        span = " to ".join(f"{power:g}" for power in POWERS_DBM)
        raise UserError(f"{folder}: powers must be dBm, {span}; leave cells empty where nothing was received")
    return readings


def check_positions(what: str, positions: Float[np.ndarray, "*n k"]) -> None:
    """Raises a `UserError` for positions that are none."""
    if not (np.abs(positions) < FURTHEST).all():
        raise UserError(f"{what} must be numbers of metres, each nearer than {FURTHEST:g} m to the origin")


def cell_means(readings: Readings, size: float) -> Readings:
    """Returns the means (of dBm) over cubic cells: what is left when fading is averaged. A cell stands where its readings were
    taken on average; one that reaches into two rooms is two."""
    names, room = np.unique(np.array(readings.rooms), return_inverse=True)
    cubes = np.column_stack([np.floor(readings.places / size).astype(int), room.reshape(-1)])
    cubes, cell = np.unique(cubes, axis=0, return_inverse=True)
    cell, n = cell.reshape(-1), len(cubes)
    heard = np.isfinite(readings.powers)
    counts = _sums(cell, n, np.where(heard, readings.counts, 0))
    totals = _sums(cell, n, np.where(heard, readings.counts * np.nan_to_num(readings.powers), 0))
    powers = np.where(counts > 0, totals / np.maximum(counts, 1), np.nan)
    places = _sums(cell, n, readings.places) / np.bincount(cell)[:, None]
    return Readings(places, powers, counts, tuple(names[cubes[:, -1]].tolist()), readings.receivers)


def _sums(cell: Int[np.ndarray, " m"], n: int, values: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "n k"]:
    total = np.zeros((n, values.shape[1]))
    np.add.at(total, cell, values)
    return total


def attribution(folder: Path) -> list[str]:
    """Returns the paragraphs of a folder's README that say whose data they are, and on what terms."""
    path = folder / "README.md"
    if not path.is_file():
        return []
    paragraphs = re.split(r"\n\s*\n", path.read_text(encoding="utf-8", errors="replace"))
    terms = re.compile(r"licen[cs]e|\bdoi\b|copyright|CC BY", re.IGNORECASE)
    return [" ".join(paragraph.split()) for paragraph in paragraphs if terms.search(paragraph)]
