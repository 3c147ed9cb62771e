"""Folders of DeepMIMO scenarios: which transmitters and users they hold, at which frequency, and their arrays.

A file an array, such as power_t001_tx000_r000.npz (or .mat): set and number of the transmitter, set of the users; and
params.json with the frequency and the sets. A set of users that are base stations too is taken if there is no other.
"""

import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wbgs_jax._util.archives import read_arrays
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, read_json, write_json
from wbgs_jax.interchange.matlab import read_mat

FILE = re.compile(r"(?P<name>[a-z_]+?)_t(?P<set>\d+)_tx(?P<tx>\d+)_r(?P<rx>\d+)\.(npz|mat)")
PARAMETERS = "params.json"
VERSION = "4.0.0"
"""Of DeepMIMO, whose form this is."""


class Pair(NamedTuple):
    """A transmitter and the users that it is about."""

    tx_set: int
    tx: int
    rx_set: int


def pairs_of(folder: Path, tx_set: int | None = None, tx: int | None = None, rx_set: int | None = None) -> list[Pair]:
    """Returns the transmitters of one set of users, in order; a choice is by number, None leaves it open.

    Raises:
        UserError: there is none.
    """
    every = {Pair(int(m["set"]), int(m["tx"]), int(m["rx"])) for m in _matches(folder)}
    wanted = (tx_set, tx, rx_set)
    found = [pair for pair in sorted(every) if all(want in (None, have) for want, have in zip(wanted, pair, strict=True))]
    if not found:
        there = ", ".join(f"t{s:03}_tx{t:03}_r{r:03}" for s, t, r in sorted(every)[:4])
        raise UserError(
            f"{folder} holds no such transmitter and users; it holds {there}" if every else
            f"{folder} holds no files such as power_t001_tx000_r000.npz; give the folder of a DeepMIMO scenario"
        )  # fmt: skip
    first = {pair.rx_set: pair for pair in reversed(found)}
    users = sorted(first)
    if len(users) > 1:  # sizes are read from files
        rank = {number: (_sends(folder, number, every), -_size(folder, pair)) for number, pair in first.items()}
        users.sort(key=lambda number: rank[number])
    sets = sorted({pair.tx_set for pair in found if pair.rx_set == users[0]})
    if len(users) > 1 or len(sets) > 1:
        others = [f"--rx-set {number}" for number in users[1:]] + [f"--tx-set {number}" for number in sets[1:]]
        warnings.warn(
            f"{folder}: users of set {users[0]}, transmitters of set {sets[0]}; others: {', '.join(others)}", stacklevel=3
        )
    return [pair for pair in found if pair.rx_set == users[0] and pair.tx_set == sets[0]]


def read_pair(folder: Path, pair: Pair) -> dict[str, np.ndarray]:
    """Returns the arrays of a transmitter and its users by name."""
    arrays: dict[str, np.ndarray] = {}
    for match in _matches(folder):
        if Pair(int(match["set"]), int(match["tx"]), int(match["rx"])) == pair:
            content = read_file(folder / match.string)
            arrays[match["name"]] = content.get(match["name"], next(iter(content.values()), np.zeros(0)))
    return arrays


def read_file(path: Path) -> dict[str, np.ndarray]:
    """Returns the numbers of an .npz or .mat file by name."""
    return read_mat(path) if path.suffix == ".mat" else read_arrays(path, "", "check the path; give an .npz or a .mat file")


def parameters(folder: Path) -> dict[str, Any]:
    """Returns what params.json holds; nothing where there is none."""
    path = folder / PARAMETERS
    if not (folder.is_dir() and path.exists()):
        return {}
    found = read_json(path)
    return found if isinstance(found, dict) else {}


def write_pair(folder: Path, pair: Pair, arrays: dict[str, np.ndarray], frequency_hz: float) -> None:
    """Writes the arrays of a transmitter and its users, and notes both in params.json."""
    for name, values in arrays.items():
        one: dict[str, Any] = {name: values}
        with atomic_write(folder / f"{name}_t{pair.tx_set:03}_tx{pair.tx:03}_r{pair.rx_set:03}.npz") as stream:
            np.savez_compressed(stream, **one)
    known = parameters(folder)
    sets = known.get("txrx_sets", {})
    before = sets.get(f"txrx_set_{pair.tx_set}", {}).get("num_points", 0)
    active = int(np.isfinite(arrays["power"]).any(1).sum())
    sets |= {
        f"txrx_set_{pair.tx_set}": _set(pair.tx_set, "transmitters", max(before, pair.tx + 1), max(before, pair.tx + 1), True),
        f"txrx_set_{pair.rx_set}": _set(pair.rx_set, "users", len(arrays["rx_pos"]), active, False),
    }
    codes = np.nan_to_num(arrays["inter"]).astype(np.int64).ravel()
    digits = [[int(digit) for digit in str(code) if digit != "0"] for code in np.unique(codes)]
    most = {digit: max((one.count(digit) for one in digits), default=0) for digit in (1, 2, 3, 4)}
    tracing = {
        "raytracer_name": "wbgs-jax",
        "raytracer_version": "",
        "frequency": float(frequency_hz),
        "max_path_depth": max(map(len, digits), default=0),
        **dict(zip(("max_reflections", "max_diffractions", "max_scattering", "max_transmissions"), most.values(), strict=True)),
    }
    write_json(
        folder / PARAMETERS,
        {"version": VERSION, "rt_params": tracing, "scene": {"num_scenes": 1}, "materials": {}, "txrx_sets": sets},
    )


def _set(number: int, name: str, points: int, active: int, sends: bool) -> dict[str, Any]:
    places = {"num_points": points, "num_active_points": active, "num_ant": 1, "dual_pol": False}
    facing = {"ant_rel_positions": [[0, 0, 0]], "array_orientation": [0, 0, 0]}
    return {"name": name, "id_orig": number, "id": number, "is_tx": sends, "is_rx": not sends} | places | facing


def _matches(folder: Path) -> list[re.Match[str]]:
    return [match for entry in sorted(folder.iterdir()) if (match := FILE.fullmatch(entry.name))]


def _sends(folder: Path, number: int, every: set[Pair]) -> bool:
    """Returns whether a set of users is one of transmitters too."""
    sets = parameters(folder).get("txrx_sets", {})
    known = sets.get(f"txrx_set_{number}") if isinstance(sets, dict) else None
    return bool(known.get("is_tx")) if isinstance(known, dict) else number in {pair.tx_set for pair in every}


def _size(folder: Path, pair: Pair) -> int:
    """Returns how many users there are."""
    return len(read_pair(folder, pair).get("rx_pos", ()))
