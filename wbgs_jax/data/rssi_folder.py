"""Readings of received power at several fixed receivers from many places, read from folders and averaged over cells.

    readings.csv (or calibration.csv)   x,y[,z][,room][,floor], and a column of dBm a receiver, named by its id;
                                        empty: not received
    receivers.csv (or anchors.csv)      id,x,y,z
    walls.csv (or layout.csv)           optional; floor_plan.py

or in a layout of NeRF2 (below). Metres and one frame throughout. Headers may be in capitals.

Received powers as NeRF2 (Zhao et al., MobiCom 2023) publishes them, and as those publish who followed.

    tx_pos.csv              x,y,z, a row a transmitter

    gateway_position.yml    name: [x, y, z] of Bluetooth gateways, and
    gateway_rssi.csv        dBm, one column a gateway, of its name; -100: not received

    base-station.yml        base_station: [[x, y, z], ...], the antennas, or rx_positions.yml, name: [x, y, z], and
    csidata.npy             complex channel state (transmitter, antenna, subcarrier)

Of channel state its mean power over the subcarriers is taken, in dB of whatever it was measured in; carriers without a value
(NaN, or zero throughout, as at direct current and at the edges of the band) do not count. NeRF2's own set of channel
state has no `tx_pos.csv`: it asks for a downlink where an uplink is known, not where a transmitter stands.
"""

import dataclasses
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import check_file, read_yaml, told
from wbgs_jax.data.tables import (
    check_frame,
    check_metres,
    check_positions,
    check_powers,
    found,
    match_columns,
    not_received,
    numbers,
    read_table,
)

RSSI, CSI = "gateway_rssi.csv", "csidata.npy"
TRANSMITTERS, GATEWAYS = ("tx_pos.csv",), ("gateway_position.yml",)
ANTENNAS = ("base-station.yml", "rx_positions.yml")
NOT_RECEIVED = -100.0

Powers = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n r"], Float[np.ndarray, "r 3"]]
"""Places of the transmitter (metres), powers (dB; NaN: nothing received), and places of the receivers."""


def is_nerf2(folder: Path) -> bool:
    """Returns whether a folder holds one of these layouts."""
    return (folder / RSSI).exists() or (folder / CSI).exists()


def load_nerf2(folder: Path) -> Powers:
    """Reads a folder; a missing or damaged file is a `UserError`."""
    if (folder / RSSI).exists():
        heard, listed = folder / RSSI, found(folder, GATEWAYS)
        names, receivers = _positions(listed)
        values = _rssi(heard, names if names else len(receivers))
    else:
        heard, listed = folder / CSI, found(folder, ANTENNAS)
        (_, receivers), values = _positions(listed), _csi(heard)
        if not (folder / TRANSMITTERS[0]).exists():
            raise UserError(
                f"{folder} has no {TRANSMITTERS[0]} (x,y,z) that says where its transmitters stood; NeRF2's own channel "
                "state is about uplinks and downlinks, not about places"
            )
    tx = found(folder, TRANSMITTERS)
    places = numbers(tx, *read_table(tx), ["x", "y", "z"])
    if values.shape != (len(places), len(receivers)):
        raise UserError(
            f"{heard} has powers of {values.shape[0]} transmitters at {values.shape[1]} receivers; there are {len(places)} "
            f"positions in {tx.name} and {len(receivers)} in {listed.name}"
        )
    return places, values, receivers


def _rssi(path: Path, gateways: list[str] | int) -> Float[np.ndarray, "n r"]:
    header, rows = read_table(path)
    count = gateways if isinstance(gateways, int) else len(gateways)
    if len(header) != count:
        raise UserError(f"{path} has powers of {len(header)} gateways, {GATEWAYS[0]} {count}")
    values = numbers(path, header, rows, match_columns(path, header, gateways))
    values = not_received(path, np.where(values <= NOT_RECEIVED, np.nan, values))
    check_powers(path, values)
    return values


def _csi(path: Path) -> Float[np.ndarray, "n r"]:
    advice = "it must hold complex numbers (transmitter, antenna, subcarrier)"
    with told(str(path), advice):
        check_file(path, str(path), advice)
        state = np.load(path, allow_pickle=False)
    if not isinstance(state, np.ndarray) or state.ndim != 3 or not np.iscomplexobj(state):
        raise UserError(f"{path} must hold complex numbers (transmitter, antenna, subcarrier)")
    powers = np.abs(state.astype(np.complex128)) ** 2
    powers[..., (powers == 0).all((0, 1))] = np.nan  # at direct current and the band's edges nothing is sent
    with np.errstate(divide="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of antennas without any value: NaN is right
        power = np.nanmean(powers, -1)
        decibels: Float[np.ndarray, "n r"] = 10 * np.log10(power)
    return np.where(np.isfinite(decibels), decibels, np.nan)


def _positions(path: Path) -> tuple[list[str], Float[np.ndarray, "r 3"]]:
    """Returns the names and positions that a YAML file lists: of one list without names, or one a name; other entries are left
    alone."""
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
    """Returns the position that an entry stands for; None where it is a text or a number."""
    if isinstance(entry, dict):
        return entry["position"]
    return entry if isinstance(entry, list) else None


READINGS, RECEIVERS = ("readings.csv", "calibration.csv"), ("receivers.csv", "anchors.csv")
NAMES = ("id", "name", "receiver", "gateway", "anchor", "ap", "mac", "bssid")
"""Columns that may name a receiver."""
ROOMS = ("room", "floor", "storey", "level")
"""Columns that part readings; those of floors go with heights alone."""
IGNORED = ("time", "timestamp", "date", "datetime", "comment", "note", "device", "index")
"""Columns that change nothing."""


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
        counts = np.isfinite(powers).astype(float)
        return _checked(Readings(places, powers, counts, ("",) * len(places), receivers), folder)
    return _checked(_load_tables(folder, height), folder)


def _load_tables(folder: Path, height: float) -> Readings:
    path, of_receivers = found(folder, READINGS), found(folder, RECEIVERS)
    names, entries = read_table(of_receivers)
    receivers = numbers(of_receivers, names, entries, ["x", "y", "z"])
    header, rows = read_table(path)
    powers = [name for name in header if name not in ("x", "y", "z", *ROOMS, *IGNORED)]
    if len(powers) != len(receivers):
        raise UserError(
            f"{path} has {len(powers)} columns of powers ({', '.join(powers)}), {of_receivers} {len(receivers)} receivers; "
            "name columns by the ids of receivers, and leave out what is no power"
        )
    ids = next((names.index(name) for name in NAMES if name in names), None)
    powers = match_columns(path, powers, len(receivers) if ids is None else [entry[ids] for entry in entries])
    places = numbers(path, header, rows, ["x", "y", "z"] if "z" in header else ["x", "y"])
    parts = [header.index(name) for name in ROOMS if name in header]
    if places.shape[1] == 2 and set(ROOMS[1:]) & set(header):
        raise UserError(f"{path} has a column of floors but no heights; give the column z, metres in the receivers' frame")
    if places.shape[1] == 2:
        places = np.column_stack([places, np.full(len(places), height)])
    rooms = tuple("/".join(row[part] for part in parts) for row in rows)
    values = not_received(path, numbers(path, header, rows, powers))
    check_powers(path, values)
    return Readings(places, values, np.isfinite(values).astype(float), rooms, receivers)


def _checked(readings: Readings, folder: Path) -> Readings:
    """Returns readings whose positions are plausible."""
    check_positions(f"{folder}: places", readings.places)
    check_positions(f"{folder}: receivers", readings.receivers)
    check_metres(f"{folder}: receivers and places", np.concatenate([readings.receivers, readings.places]))
    check_frame(f"{folder}: places", readings.places, readings.receivers)
    if np.isnan(readings.powers).all():
        raise UserError(f"{folder}: nothing was received anywhere")
    return readings


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
