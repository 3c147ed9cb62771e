"""Readings of received power at several fixed receivers from many positions, read from folders and averaged over cells.

    readings.csv (or calibration.csv)   x,y[,z][,room][,floor], and one column of dBm per receiver, named by its id;
                                        empty: not received
    receivers.csv (or anchors.csv)      id,x,y,z
    walls.csv (or layout.csv)           optional; floor_plan.py

or in one of the layouts of NeRF2 (below). All positions are in metres in one frame. Headers may be in capitals.

Received powers in the layouts published by NeRF2 (Zhao et al., MobiCom 2023) and its successors:

    tx_pos.csv              x,y,z, one row per transmitter

    gateway_position.yml    name: [x, y, z] of Bluetooth gateways, and
    gateway_rssi.csv        dBm, one column per gateway, with its name; -100: not received

    base-station.yml        base_station: [[x, y, z], ...], the antennas, or rx_positions.yml, name: [x, y, z], and
    csidata.npy             complex channel state (transmitter, antenna, subcarrier)

Channel state is reduced to its mean power over the subcarriers, in dB relative to its own unit; subcarriers without a value
(NaN, or zero throughout, as at direct current and at the edges of the band) are ignored. NeRF2's own channel state data have no
`tx_pos.csv`: their task is to predict the downlink from the uplink, not from the position of a transmitter.
"""

import dataclasses
import itertools
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import check_file, read_yaml, reported
from wbgs_jax.data.tables import (
    check_frame,
    check_metres,
    check_positions,
    check_powers,
    found,
    match_columns,
    not_received,
    note_of_powers,
    numbers,
    read_table,
)

RSSI, CSI = "gateway_rssi.csv", "csidata.npy"
FLOORS = ("floor", "storey", "level")
"""Names of columns of floors."""
TRANSMITTERS, GATEWAYS = ("tx_pos.csv",), ("gateway_position.yml",)

Powers = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n r"], Float[np.ndarray, "r 3"]]
"""Transmitter positions (metres), powers (dB; NaN: nothing received), and receiver positions (metres)."""


def is_nerf2(folder: Path) -> bool:
    """Returns whether a folder has one of NeRF2's layouts."""
    return (folder / RSSI).exists() or (folder / CSI).exists()


def load_nerf2(folder: Path) -> Powers:
    """Reads a folder in one of NeRF2's layouts.

    Raises:
        UserError: a file is missing or damaged.
    """
    antennas = ("base-station.yml", "rx_positions.yml")
    if (folder / RSSI).exists():
        source, listed = folder / RSSI, found(folder, GATEWAYS)
        names, receivers = _positions(listed)
        values = _rssi(source, names if names else len(receivers))
    else:
        source, listed = folder / CSI, found(folder, antennas)
        (_, receivers), values = _positions(listed), _csi(source)
        if not (folder / TRANSMITTERS[0]).exists():
            raise UserError(
                f"{folder} has no {TRANSMITTERS[0]} (x,y,z) with the positions of its transmitters; NeRF2's own channel "
                "state is about uplinks and downlinks, not about positions"
            )
    tx = found(folder, TRANSMITTERS)
    places = numbers(tx, *read_table(tx), ["x", "y", "z"])
    if values.shape != (len(places), len(receivers)):
        raise UserError(
            f"{source} has powers of {values.shape[0]} transmitters at {values.shape[1]} receivers; there are {len(places)} "
            f"positions in {tx.name} and {len(receivers)} in {listed.name}"
        )
    return places, values, receivers


def _rssi(path: Path, gateways: list[str] | int) -> Float[np.ndarray, "n r"]:
    header, rows = read_table(path)
    count = gateways if isinstance(gateways, int) else len(gateways)
    if len(header) != count:
        raise UserError(f"{path} has powers of {len(header)} gateways, but {GATEWAYS[0]} has {count}")
    values = numbers(path, header, rows, match_columns(path, header, gateways))
    values = not_received(path, np.where(values == -100.0, np.nan, values))  # -100: not received
    check_powers(path, values)
    return values


def _csi(path: Path) -> Float[np.ndarray, "n r"]:
    advice = "it must hold complex numbers (transmitter, antenna, subcarrier)"
    with reported(str(path), advice):
        check_file(path, str(path), advice)
        state = np.load(path, allow_pickle=False)
    if not isinstance(state, np.ndarray) or state.ndim != 3 or not np.iscomplexobj(state):
        raise UserError(f"{path} must hold complex numbers (transmitter, antenna, subcarrier)")
    powers = np.abs(state.astype(np.complex128)) ** 2
    powers[..., (powers == 0).all((0, 1))] = np.nan  # direct current and the edges of the band carry no signal
    with np.errstate(divide="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # antennas without any value are NaN, as intended
        power = np.nanmean(powers, -1)
        decibels: Float[np.ndarray, "n r"] = 10 * np.log10(power)
    return np.where(np.isfinite(decibels), decibels, np.nan)


def _positions(path: Path) -> tuple[list[str], Float[np.ndarray, "r 3"]]:
    """Returns the names and positions listed in a YAML file: one list without names, or one entry per name; other entries are
    ignored."""
    entries = read_yaml(path)
    try:
        if "base_station" in entries:
            names, listed = [], entries["base_station"]
        else:
            places = {str(name): place for name, entry in entries.items() if (place := _position(entry)) is not None}
            names, listed = list(places), list(places.values())
        receivers = np.array([[float(value) for value in position] for position in listed])
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError):
        names, receivers = [], np.zeros(0)
    if receivers.ndim != 2 or receivers.shape[1] != 3:
        raise UserError(f"{path} does not list positions; write 'gateway1: [x, y, z]' for each")
    return names, receivers


def _position(entry: Any) -> Any:
    """Returns the position in an entry; None for a text or a number."""
    if isinstance(entry, dict):
        return entry["position"]
    return entry if isinstance(entry, list) else None


@dataclass(frozen=True)
class Readings:
    """Powers received, or not received, by R receivers from N transmitter positions."""

    places: Float[np.ndarray, "n 3"]
    """Positions of the transmitter, metres."""
    powers: Float[np.ndarray, "n r"]
    """dBm; NaN where nothing was received."""
    counts: Float[np.ndarray, "n r"]
    """Number of readings averaged in each power."""
    rooms: tuple[str, ...]
    """Room of every position; empty if not specified."""
    receivers: Float[np.ndarray, "r 3"]
    """Metres."""
    ids: tuple[str, ...] = ()
    """Ids of the receivers; empty if not specified."""

    @property
    def titles(self) -> list[str]:
        """Number of every receiver, counted from 1, with its id."""
        ids = self.ids or ("",) * len(self.receivers)
        return [f"receiver {number}" + f" ({own})" * bool(own) for number, own in enumerate(ids, 1)]

    def without(self, places: Bool[np.ndarray, " n"]) -> "Readings":
        """Returns the readings as if nothing had been received from the given positions (mask)."""
        return dataclasses.replace(self, powers=np.where(places[:, None], np.nan, self.powers))


def load_readings(folder: Path, height: float) -> Readings:
    """Reads a folder of readings.

    Args:
        folder: in one of the layouts above.
        height: of the transmitter above the floor (metres), for files without a column z.

    Returns:
        Positions (n, 3) in metres and received powers (n, receivers) in dBm; NaN where there is no reading.

    Raises:
        UserError: a file is missing or damaged.
    """
    if not folder.is_dir():
        raise UserError(f"folder {folder} does not exist")
    if is_nerf2(folder):
        places, powers, receivers = load_nerf2(folder)
        counts = np.isfinite(powers).astype(float)
        return _checked(Readings(places, powers, counts, ("",) * len(places), receivers), folder)
    return _checked(_load_tables(folder, height), folder)


def _load_tables(folder: Path, height: float) -> Readings:
    reading_files, receiver_files = ("readings.csv", "calibration.csv"), ("receivers.csv", "anchors.csv")
    path, of_receivers = found(folder, reading_files), found(folder, receiver_files)
    names, entries = read_table(of_receivers)
    receivers = numbers(of_receivers, names, entries, ["x", "y", "z"])
    header, rows = read_table(path)
    # Names of columns that are ignored.
    ignored = ("time", "timestamp", "date", "datetime", "comment", "note", "device", "index")
    # Names of columns that divide readings; those of floors require heights.
    room_columns = ("room", *FLOORS)
    powers = [name for name in header if name not in ("x", "y", "z", *room_columns, *ignored)]
    if len(powers) != len(receivers):
        raise UserError(
            f"{path} has {len(powers)} columns of powers ({', '.join(powers)}), {of_receivers} has {len(receivers)} receivers; "
            "name these columns by the ids of receivers, and remove columns that are not powers"
        )
    named = _ids(of_receivers, names, entries, powers)
    powers = match_columns(path, powers, list(named) or len(receivers))
    places = numbers(path, header, rows, ["x", "y", "z"] if "z" in header else ["x", "y"])
    parts = [header.index(name) for name in room_columns if name in header]
    if places.shape[1] == 2 and set(FLOORS) & set(header):
        raise UserError(f"{path} has a column of floors but no heights; add the column z, metres in the receivers' frame")
    for file, columns, cells, points in ((path, header, rows, places), (of_receivers, names, entries, receivers)):
        for name in (column for column in FLOORS if column in columns):
            _check_floors(file, name, [row[columns.index(name)] for row in cells], points[:, 2])
    if places.shape[1] == 2:
        places = np.column_stack([places, np.full(len(places), height)])
    rooms = tuple("/".join(row[part] for part in parts if row[part]) for row in rows)
    values = not_received(path, numbers(path, header, rows, powers))
    check_powers(path, values)
    return Readings(places, values, np.isfinite(values).astype(float), rooms, receivers, named)


def _check_floors(path: Path, column: str, floors: list[str], heights: Float[np.ndarray, " n"]) -> None:
    """Raises a `UserError` if two floors are at one height (metres)."""
    storey = 1.0  # metres: smallest difference of the heights of two floors
    of_floor = {floor: float(np.median(heights[np.array(floors) == floor])) for floor in dict.fromkeys(floors) if floor}
    ordered = sorted(of_floor, key=lambda floor: of_floor[floor])
    for low, high in itertools.pairwise(ordered):
        if of_floor[high] - of_floor[low] < storey:
            raise UserError(
                f"{path} has the {column}s {low!r} and {high!r} at the same height (z = {of_floor[low]:g} and "
                f"{of_floor[high]:g}); z must count from one origin, not from each floor (use 'room' for parts of one floor)"
            )


def _ids(path: Path, header: list[str], rows: list[list[str]], powers: list[str]) -> tuple[str, ...]:
    """Returns the ids of receivers; empty if no column holds them.

    Args:
        path: of the receivers, for messages.
        header: names of its columns.
        rows: its cells.
        powers: columns of powers; those of a single column of unknown name that match them are ids.

    Raises:
        UserError: there are other columns of unknown meaning.
    """
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    devices = ["receiver", "gateway", "anchor", "ap"]
    # Names of columns of ids, ...
    identifiers = ["id", "name", *devices, "mac", "bssid", *(f"{name}_id" for name in devices), "rx", "label", "number", "ssid"]
    # ... of columns that are ignored, and of those in which pandas counts rows.
    ignored = ("comment", "comments", "note", "notes", "description", "room", "location", "device", "model", "date", *FLOORS)
    counted = [name for name in ("", "index", "unnamed: 0") if columns.get(name) == tuple(map(str, range(len(rows))))]
    others = [name for name in header if name not in ("x", "y", "z", *identifiers, *ignored, *counted)]
    known = [name for name in identifiers if name in header]
    candidates = known + (others if len(others) == 1 else [])
    ids = next((name for name in candidates if _match(path, powers, columns[name])), next(iter(known), None))
    if unknown := [name for name in others if name != ids]:
        raise UserError(
            f"{path} has columns of unknown meaning ({', '.join(map(repr, unknown))}); remove them, and name a column of ids "
            "'id', or of remarks 'comment'"
        )
    return () if ids is None else columns[ids]


def _match(path: Path, columns: list[str], ids: tuple[str, ...]) -> bool:
    """Returns whether columns can be matched with receivers."""
    try:
        return bool(match_columns(path, columns, ids))
    except UserError:
        return False


def _checked(readings: Readings, folder: Path) -> Readings:
    """Returns the readings after checking that positions are plausible."""
    check_positions(f"{folder}: places", readings.places)
    check_positions(f"{folder}: receivers", readings.receivers)
    check_metres(f"{folder}: receivers and places", np.concatenate([readings.receivers, readings.places]))
    check_frame(f"{folder}: places", readings.places, readings.receivers)
    if np.isnan(readings.powers).all():
        raise UserError(f"{folder}: nothing was received anywhere")
    note_of_powers(str(folder), readings.places, readings.powers, readings.receivers)
    return readings


def cell_means(readings: Readings, size: float, highest: float = np.inf) -> Readings:
    """Returns means (of dBm) over cubic cells, which average out fading. The position of a cell is the mean position of its
    readings; a cell that extends over two rooms is divided.

    Args:
        readings: to average.
        size: of a cell, metres.
        highest: maximum height of a cell, metres.

    Returns:
        One reading per cell.
    """
    names, room = np.unique(np.array(readings.rooms), return_inverse=True)
    cubes = np.column_stack([np.floor(readings.places / [size, size, min(size, highest)]).astype(int), room.reshape(-1)])
    cubes, cell = np.unique(cubes, axis=0, return_inverse=True)
    cell, n = cell.reshape(-1), len(cubes)
    received = np.isfinite(readings.powers)
    counts = _sums(cell, n, np.where(received, readings.counts, 0))
    totals = _sums(cell, n, np.where(received, readings.counts * np.nan_to_num(readings.powers), 0))
    powers = np.where(counts > 0, totals / np.maximum(counts, 1), np.nan)
    places = _sums(cell, n, readings.places) / np.bincount(cell)[:, None]
    return Readings(places, powers, counts, tuple(names[cubes[:, -1]].tolist()), readings.receivers, readings.ids)


def _sums(cell: Int[np.ndarray, " m"], n: int, values: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "n k"]:
    total = np.zeros((n, values.shape[1]))
    np.add.at(total, cell, values)
    return total


def attribution(folder: Path) -> list[str]:
    """Returns the paragraphs of a folder's README about the origin and licence of the data."""
    path = folder / "README.md"
    if not path.is_file():
        return []
    paragraphs = re.split(r"\n\s*\n", path.read_text(encoding="utf-8", errors="replace"))
    terms = re.compile(r"licen[cs]e|\bdoi\b|copyright|CC BY", re.IGNORECASE)
    return [" ".join(paragraph.split()) for paragraph in paragraphs if terms.search(paragraph)]
