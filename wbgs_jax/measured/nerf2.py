"""Received powers as NeRF2 (Zhao et al., MobiCom 2023) publishes them, and as those publish who followed.

    tx_pos.csv              x,y,z, a row a transmitter

    gateway_position.yml    name: [x, y, z] of Bluetooth gateways, and
    gateway_rssi.csv        dBm, one column a gateway; -100: not received

    base-station.yml        base_station: [[x, y, z], ...], the antennas, or rx_positions.yml, name: [x, y, z], and
    csidata.npy             complex channel state (transmitter, antenna, subcarrier)

Of channel state its mean power over the subcarriers is taken, in dB of whatever it was measured in. NeRF2's own set of channel
state has no `tx_pos.csv`: it asks for a downlink where an uplink is known, not where a transmitter stands.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from wbgs_jax._util.archives import check_file, told
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.yaml_files import read_yaml
from wbgs_jax.measured.tables import found, numbers, read_table

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
        heard, listed, values = folder / RSSI, found(folder, GATEWAYS), _rssi(folder / RSSI)
    else:
        heard, listed, values = folder / CSI, found(folder, ANTENNAS), _csi(folder / CSI)
        if not (folder / TRANSMITTERS[0]).exists():
            raise UserError(
                f"{folder} has no {TRANSMITTERS[0]} (x,y,z) that says where its transmitters stood; NeRF2's own channel "
                "state is about uplinks and downlinks, not about places"
            )
    tx = found(folder, TRANSMITTERS)
    places, receivers = numbers(tx, *read_table(tx), ["x", "y", "z"]), _positions(listed)
    if values.shape != (len(places), len(receivers)):
        raise UserError(
            f"{heard} has powers of {values.shape[0]} transmitters at {values.shape[1]} receivers; there are {len(places)} "
            f"positions in {tx.name} and {len(receivers)} in {listed.name}"
        )
    return places, values, receivers


def _rssi(path: Path) -> Float[np.ndarray, "n r"]:
    header, rows = read_table(path)
    values = numbers(path, header, rows, header)
    return np.where(values <= NOT_RECEIVED, np.nan, values)


def _csi(path: Path) -> Float[np.ndarray, "n r"]:
    advice = "it must hold complex numbers (transmitter, antenna, subcarrier)"
    with told(str(path), advice):
        check_file(path, str(path), advice)
        state = np.load(path, allow_pickle=False)
    if not isinstance(state, np.ndarray) or state.ndim != 3 or not np.iscomplexobj(state):
        raise UserError(f"{path} must hold complex numbers (transmitter, antenna, subcarrier)")
    power = np.mean(np.abs(state.astype(np.complex128)) ** 2, -1)
    with np.errstate(divide="ignore"):
        decibels: Float[np.ndarray, "n r"] = 10 * np.log10(power)
    return np.where(np.isfinite(decibels), decibels, np.nan)


def _positions(path: Path) -> Float[np.ndarray, "r 3"]:
    """Returns the positions that a YAML file lists: of one list, or one a name; other entries are left alone."""
    entries = read_yaml(path)
    try:
        listed = entries["base_station"] if "base_station" in entries else [*filter(None, map(_position, entries.values()))]
        receivers = np.array([[float(value) for value in position] for position in listed])
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError):
        receivers = np.zeros(0)
    if receivers.ndim != 2 or receivers.shape[1] != 3:
        raise UserError(f"{path} does not list positions; write 'gateway1: [x, y, z]' for each")
    return receivers


def _position(entry: Any) -> Any:
    """Returns the position that an entry stands for; None where it is a text or a number."""
    if isinstance(entry, dict):
        return entry["position"]
    return entry if isinstance(entry, list) else None
