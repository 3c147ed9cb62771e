"""Channels of DeepMIMO (version 4), in and out, without its package: one transmitter, N users, up to K paths each.

Arrays by name: `power` (dB) and `phase` (degrees) of every path, `delay` (seconds), `aod_az`, `aod_el`, `aoa_az`, `aoa_el`
(degrees, el from +z), `inter` (the interactions as the digits of a number, from the transmitter on: 1 reflection,
2 diffraction, 3 scattering, 4 transmission, 0 none), `inter_pos`, `rx_pos` (N, 3), `tx_pos` (1, 3); NaN where a user has fewer
paths. A scenario is a folder with a file each, such as power_t001_tx000_r000.npz (or .mat).
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from wbgs_jax._util.archives import read_arrays
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write
from wbgs_jax.interchange.matlab import read_mat
from wbgs_jax.interchange.ray_paths import DIFFRACTION, DIFFUSE, NONE, REFRACTION, SPECULAR, RayPaths

PATHS = ("power", "phase", "delay", "aod_az", "aod_el", "aoa_az", "aoa_el")
NEEDED = (*PATHS, "rx_pos", "tx_pos")
ANGLES = {"theta_t": "aod_el", "phi_t": "aod_az", "theta_r": "aoa_el", "phi_r": "aoa_az"}
DIGITS = {SPECULAR: 1, DIFFRACTION: 2, DIFFUSE: 3, REFRACTION: 4}
FILE = re.compile(r"(?P<name>[a-z_]+?)_t(?P<set>\d+)_tx(?P<tx>\d+)_r(?P<rx>\d+)\.(npz|mat)")
MOST_INTERACTIONS = 10


def read_deepmimo(
    path: Path | str, tx_set: int | None = None, tx: int | None = None, rx_set: int | None = None
) -> dict[str, np.ndarray]:
    """Returns the arrays of a scenario by name: of a folder with a file each, or of one .npz or .mat file that holds all.

    Args:
        path: folder or file.
        tx_set, tx, rx_set: which of several pairs of a transmitter and a grid of users; by default the first that is there.

    Raises:
        UserError: nothing is there, or an array is missing.
    """
    path = Path(path)
    arrays = _of_folder(path, (tx_set, tx, rx_set)) if path.is_dir() else _read(path)
    if missing := [name for name in NEEDED if name not in arrays]:
        raise UserError(f"{path} has no {missing[0]}; it must hold a DeepMIMO scenario: {', '.join(NEEDED)}")
    _check_shapes(path, arrays)
    return arrays


def _check_shapes(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raises a `UserError` for arrays that are no numbers, or do not fit each other."""
    shape = np.shape(arrays["power"])
    users, paths = (*shape, 0, 0)[:2]
    of_paths = dict.fromkeys((*PATHS, "inter"), ((users, paths),))
    places = {"rx_pos": ((users, 3),), "tx_pos": ((1, 3), (3,)), "inter_pos": ((users, paths, _depth(arrays), 3),)}
    for name, allowed in (of_paths | places).items():
        if name not in arrays:
            continue
        found = arrays[name]
        if found.dtype.kind not in "fiu":
            raise UserError(f"{name} in {path} holds no numbers but {found.dtype}; write the scenario again")
        if len(shape) != 2 or found.shape not in allowed:
            expected = " or ".join(map(str, allowed))
            raise UserError(f"{name} in {path} has shape {found.shape}; expected {expected}: users, paths, ...")


def _depth(arrays: dict[str, np.ndarray]) -> int:
    """Returns how many interactions a scenario keeps the places of."""
    places = arrays.get("inter_pos")
    return places.shape[2] if places is not None and places.ndim == 4 else 0


def is_deepmimo(path: Path) -> bool:
    """Returns whether a path is a scenario, and not an archive of Sionna's arrays."""
    if path.suffix != ".npz":
        return True
    return bool({"power", "phase"} & set(_read(path)))


def write_deepmimo(folder: Path | str, arrays: dict[str, np.ndarray], tx_set: int = 1, tx: int = 0, rx_set: int = 0) -> None:
    """Writes arrays as a scenario's files, an .npz each, into a folder."""
    for name, values in arrays.items():
        one: dict[str, Any] = {name: values}
        with atomic_write(Path(folder) / f"{name}_t{tx_set:03}_tx{tx:03}_r{rx_set:03}.npz") as stream:
            np.savez_compressed(stream, **one)


def from_deepmimo(arrays: dict[str, np.ndarray], frequency_hz: float) -> RayPaths:
    """Returns the paths from a scenario's transmitter to its users; the frequency stands in the scenario's parameters."""
    power = np.asarray(arrays["power"], np.float64)
    valid = np.isfinite(power)
    amplitude = np.where(valid, 10 ** (np.where(valid, power, 0) / 20), 0)
    phase = np.radians(_filled(arrays["phase"], valid))
    angles = {own: np.radians(_filled(arrays[name], valid))[:, None] for own, name in ANGLES.items()}
    met = _digits(_filled(arrays["inter"], valid)) if "inter" in arrays else np.zeros((0, *power.shape), np.int32)
    places = np.full((*met.shape, 3), np.nan)
    if "inter_pos" in arrays:
        given = np.moveaxis(np.asarray(arrays["inter_pos"], np.float64), -2, 0)[: len(met)]
        places[: len(given)] = given
    return RayPaths(
        a=(amplitude * np.exp(1j * phase))[:, None],
        tau=np.where(valid, _filled(arrays["delay"], valid), -1)[:, None],
        **angles,
        interactions=met[:, :, None],
        vertices=places[:, :, None],
        valid=valid[:, None],
        sources=np.asarray(arrays["tx_pos"], np.float64).reshape(-1, 3)[:1],
        targets=np.asarray(arrays["rx_pos"], np.float64).reshape(-1, 3),
        frequency_hz=frequency_hz,
    )


def as_deepmimo(paths: RayPaths, transmitter: int = 0) -> dict[str, np.ndarray]:
    """Returns the paths of one transmitter to all receivers as a scenario's arrays, of each receiver the strongest first."""
    a = np.where(paths.valid, paths.a, 0)[:, transmitter]
    order = np.argsort(-np.abs(a), -1, kind="stable")
    valid = np.take_along_axis(paths.valid[:, transmitter], order, -1)

    def sorted_values(values: np.ndarray) -> np.ndarray:
        taken = np.take_along_axis(values, order, -1)
        return np.where(valid, taken, np.nan).astype(np.float32)

    met = np.take_along_axis(paths.interactions[:, :, transmitter], order[None], -1)
    places = np.take_along_axis(paths.vertices[:, :, transmitter], order[None, ..., None], -2)
    with np.errstate(divide="ignore"):
        power = 20 * np.log10(np.abs(a))
    angles = {name: np.degrees(getattr(paths, own)[:, transmitter]) for own, name in ANGLES.items()}
    columns = {"power": power, "phase": np.degrees(np.angle(a)), "delay": paths.tau[:, transmitter], **angles}
    code = sum((np.where(met == kind, digit, 0) for kind, digit in DIGITS.items()), np.zeros(met.shape, np.int64))
    return {
        **{name: sorted_values(values) for name, values in columns.items()},
        "inter": np.where(valid, _number(code), np.nan).astype(np.float32),
        "inter_pos": np.moveaxis(places, 0, -2).astype(np.float32),
        "rx_pos": paths.targets.astype(np.float32),
        "tx_pos": paths.sources[[transmitter]].astype(np.float32),
    }


def _of_folder(folder: Path, wanted: tuple[int | None, ...]) -> dict[str, np.ndarray]:
    found: dict[tuple[int, ...], dict[str, Path]] = {}
    for entry in sorted(folder.iterdir()):
        if match := FILE.fullmatch(entry.name):
            key = tuple(int(match[part]) for part in ("set", "tx", "rx"))
            if all(want in (None, have) for want, have in zip(wanted, key, strict=True)):
                found.setdefault(key, {})[match["name"]] = entry
    if not found:
        raise UserError(f"{folder} holds no files such as power_t001_tx000_r000.npz; give the folder of a DeepMIMO scenario")
    arrays: dict[str, np.ndarray] = {}
    for name, path in found[min(found)].items():
        if name in (*NEEDED, "inter", "inter_pos"):
            content = _read(path)
            arrays[name] = content.get(name, next(iter(content.values()), np.zeros(0)))
    return arrays


def _read(path: Path) -> dict[str, np.ndarray]:
    """Returns the numbers of an .npz or .mat file by name."""
    return read_mat(path) if path.suffix == ".mat" else read_arrays(path, "", "check the path; give an .npz or a .mat file")


def _filled(values: Any, valid: np.ndarray) -> np.ndarray:
    return np.where(valid, np.nan_to_num(np.asarray(values, np.float64)), 0)


def _digits(codes: np.ndarray) -> np.ndarray:
    """Returns Sionna's interactions, a leading axis, of numbers whose digits are DeepMIMO's."""
    kinds = np.zeros(10, np.int32)
    for kind, digit in DIGITS.items():
        kinds[digit] = kind
    text = np.round(codes).astype(np.int64)
    depth = max((len(str(number)) for number in np.unique(text)), default=0)
    met = np.zeros((min(depth, MOST_INTERACTIONS), *codes.shape), np.int32)
    length = np.where(text > 0, np.floor(np.log10(np.maximum(text, 1))).astype(int) + 1, 0)
    for i in range(len(met)):
        digit = text // 10 ** np.maximum(length - 1 - i, 0) % 10
        met[i] = np.where(i < length, kinds[np.minimum(digit, 9)], NONE)
    return met


def _number(digits: np.ndarray) -> np.ndarray:
    """Returns numbers of their digits, leading axis; 0 stands for nothing."""
    total = np.zeros(digits.shape[1:], np.int64)
    for digit in digits:
        total = np.where(digit > 0, 10 * total + digit, total)
    return total
