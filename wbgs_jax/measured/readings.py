"""Readings of received power at several fixed receivers from many places, read from folders and averaged over cells.

    readings.csv (or calibration.csv)   x,y[,z][,room], then one column a receiver, dBm: rssi_1,rssi_2,... ; empty: not received
    receivers.csv (or anchors.csv)      id,x,y,z, in the order of those columns
    walls.csv (or layout.csv)           optional; floor_plan.py

or in a layout of NeRF2 (nerf2.py). Metres and one frame throughout. Headers may be in capitals. Columns of powers that end in
the receivers' ids may stand in any order; others stand in that of the receivers.
"""

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax.measured.nerf2 import is_nerf2, load_nerf2
from wbgs_jax.measured.tables import found, numbers, read_table

READINGS, RECEIVERS = ("readings.csv", "calibration.csv"), ("receivers.csv", "anchors.csv")
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
    if is_nerf2(folder):
        places, powers, receivers = load_nerf2(folder)
        rooms = ("",) * len(places)
        return _checked(Readings(places, powers, np.isfinite(powers).astype(float), rooms, receivers), folder)
    return _checked(_load_tables(folder, height), folder)


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
        powers = _in_order(path, powers, [entry[names.index("id")].lower() for entry in entries])
    places = numbers(path, header, rows, ["x", "y", "z"] if "z" in header else ["x", "y"])
    if places.shape[1] == 2:
        places = np.column_stack([places, np.full(len(places), height)])
    rooms = tuple(row[header.index("room")] for row in rows) if "room" in header else ("",) * len(rows)
    values = numbers(path, header, rows, powers)
    return Readings(places, values, np.isfinite(values).astype(float), rooms, receivers)


def _in_order(where: Path, columns: list[str], ids: list[str]) -> list[str]:
    """Returns columns in the order of the receivers whose ids they end in; as they are, where none does.

    Raises:
        UserError: some of them do, and others do not.
    """
    by_id: dict[str, str] = {}
    for name in sorted(ids, key=len, reverse=True):  # a_1 before 1
        ending = [one for one in columns if one not in by_id.values() and (one == name or one.endswith(f"_{name}"))]
        by_id |= {name: ending[0]} if len(ending) == 1 else {}
    if by_id and len(by_id) < len(ids):
        other = next(name for name in ids if name not in by_id)
        raise UserError(
            f"{where}: no column of powers, or more than one, ends in the receiver's id {other!r}, as others end in theirs; "
            f"name the columns {', '.join('rssi_' + name for name in ids[:3])}, ..."
        )
    return [by_id[name] for name in ids] if by_id else columns


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
