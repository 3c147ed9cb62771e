"""Received powers as NeRF2 (Zhao et al., MobiCom 2023) publishes them, and as those publish who followed.

    tx_pos.csv              x,y,z, a row a transmitter

    gateway_position.yml    name: [x, y, z] of Bluetooth gateways, and
    gateway_rssi.csv        dBm, one column a gateway, of its name; -100: not received

    base-station.yml        base_station: [[x, y, z], ...], the antennas, or rx_positions.yml, name: [x, y, z], and
    csidata.npy             complex channel state (transmitter, antenna, subcarrier)

Of channel state its mean power over the subcarriers is taken, in dB of whatever it was measured in; carriers without a value
(NaN, or zero throughout, as at direct current and at the edges of the band) do not count. NeRF2's own set of channel
state has no `tx_pos.csv`: it asks for a downlink where an uplink is known, not where a transmitter stands.
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from wbgs_jax._util.archives import check_file, told
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.yaml_files import read_yaml
from wbgs_jax.measured.columns import match_columns
from wbgs_jax.measured.plausible import check_powers, not_received
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
