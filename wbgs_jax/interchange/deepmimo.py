"""Import and export of DeepMIMO channels (version 4) without its package: one transmitter, N users, up to K paths each.

Arrays by name: `power` (dB) and `phase` (degrees) of every path, `delay` (seconds), `aod_az`, `aod_el`, `aoa_az`, `aoa_el`
(degrees, el from +z), `inter` (the interactions as the digits of a number, starting at the transmitter: 1 reflection,
2 diffraction, 3 scattering, 4 transmission, 0 none), `inter_pos`, `rx_pos` (N, 3), `tx_pos` (1, 3); NaN where a user has fewer
paths.

The channel at the carrier is the sum of sqrt(power) exp(j phase): phases include the propagation. They do not in DeepMIMO's
conversions of Sionna RT, as in Sionna's own coefficients; lines of sight reveal which is the case.

A scenario is a folder with one file per array, such as power_t001_tx000_r000.npz (or .mat), named by the set and number of the
transmitter and the set of users; params.json has the frequency and the sets. A set of users that are also base stations is used
only if there is no other.
"""

import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, read_json, write_json
from wbgs_jax.interchange.matlab import read_mat_or_npz
from wbgs_jax.interchange.ray_paths import (
    DIFFRACTION,
    DIFFUSE,
    NONE,
    REFRACTION,
    SAME_FREQUENCY,
    SPECULAR,
    RayPaths,
    carrier,
    frequency_of,
)

FILE = re.compile(r"(?P<name>[a-z_]+?)_t(?P<set>\d+)_tx(?P<tx>\d+)_r(?P<rx>\d+)\.(npz|mat)")
PARAMETERS = "params.json"


class Pair(NamedTuple):
    """A transmitter and a set of users."""

    tx_set: int
    tx: int
    rx_set: int


def pairs_of(folder: Path, tx_set: int | None = None, tx: int | None = None, rx_set: int | None = None) -> list[Pair]:
    """Returns the transmitters of one set of users, in order.

    Args:
        folder: of the scenario.
        tx_set, tx, rx_set: numbers to choose; None for any.

    Raises:
        UserError: there is none.
    """
    every = {_pair(match) for match in _matches(folder)}
    wanted = (tx_set, tx, rx_set)
    found = [pair for pair in sorted(every) if all(want in (None, have) for want, have in zip(wanted, pair, strict=True))]
    if not found:
        there = ", ".join(f"t{s:03}_tx{t:03}_r{r:03}" for s, t, r in sorted(every)[:4])
        raise UserError(
            f"{folder} has no such transmitter and users; it has {there}" if every else
            f"{folder} has no files such as power_t001_tx000_r000.npz; give the folder of a DeepMIMO scenario"
        )  # fmt: skip
    first = {pair.rx_set: pair for pair in reversed(found)}
    users = sorted(first)
    if len(users) > 1:  # their sizes have to be read from files
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
        if _pair(match) == pair:
            content = read_file(folder / match.string)
            arrays[match["name"]] = content.get(match["name"], next(iter(content.values()), np.zeros(0)))
    return arrays


def read_file(path: Path) -> dict[str, np.ndarray]:
    """Returns the numeric arrays of an .npz or .mat file by name."""
    return read_mat_or_npz(path, "check the path; give an .npz or a .mat file")


def parameters(folder: Path) -> dict[str, Any]:
    """Returns the content of params.json; empty if there is none."""
    path = folder / PARAMETERS
    if not (folder.is_dir() and path.exists()):
        return {}
    found = read_json(path)
    return found if isinstance(found, dict) else {}


def write_pair(folder: Path, pair: Pair, arrays: dict[str, np.ndarray], frequency_hz: float) -> None:
    """Writes the arrays of a transmitter and its users, and records both in params.json.

    Raises:
        UserError: params.json is damaged, or the scenario has other transmitters or users at another frequency.
    """
    recorded = parameters(folder)
    sets = recorded.get("txrx_sets", {})
    own = sets.get(f"txrx_set_{pair.tx_set}", {}) if isinstance(sets, dict) else None
    before = own.get("num_points", 0) if isinstance(own, dict) else None
    if not isinstance(before, int):
        raise UserError(f"{folder / PARAMETERS} has no valid txrx_sets; remove it, or choose another folder")
    frequency = _traced(recorded)[1]
    others = {_pair(match) for match in _matches(folder)} - {pair} if folder.is_dir() else ()
    if others and frequency is not None and not np.isclose(frequency, frequency_hz, rtol=SAME_FREQUENCY, atol=0):
        raise UserError(
            f"{folder} has other transmitters or users at {frequency / 1e9:g} GHz, not {frequency_hz / 1e9:g}; choose another "
            "folder"
        )
    for name, values in arrays.items():
        one: dict[str, Any] = {name: values}
        with atomic_write(folder / f"{name}_t{pair.tx_set:03}_tx{pair.tx:03}_r{pair.rx_set:03}.npz") as stream:
            np.savez_compressed(stream, **one)
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
    version = "4.0.0"  # version of DeepMIMO that defines this format
    write_json(
        folder / PARAMETERS,
        {"version": version, "rt_params": tracing, "scene": {"num_scenes": 1}, "materials": {}, "txrx_sets": sets},
    )


def _traced(recorded: dict[str, Any]) -> tuple[str, float | None]:
    """Returns the name of the ray tracer and the frequency (hertz) in the content of params.json; None if it has none."""
    entry = recorded.get("rt_params")
    tracing = entry if isinstance(entry, dict) else {}
    frequency = tracing.get("frequency")
    return str(tracing.get("raytracer_name", "")), float(frequency) if isinstance(frequency, int | float) else None


def _set(number: int, name: str, points: int, active: int, sends: bool) -> dict[str, Any]:
    places = {"num_points": points, "num_active_points": active, "num_ant": 1, "dual_pol": False}
    facing = {"ant_rel_positions": [[0, 0, 0]], "array_orientation": [0, 0, 0]}
    return {"name": name, "id_orig": number, "id": number, "is_tx": sends, "is_rx": not sends} | places | facing


def _matches(folder: Path) -> list[re.Match[str]]:
    return [match for entry in sorted(folder.iterdir()) if (match := FILE.fullmatch(entry.name))]


def _pair(match: re.Match[str]) -> Pair:
    """Returns the transmitter and users in the name of a file."""
    return Pair(int(match["set"]), int(match["tx"]), int(match["rx"]))


def _sends(folder: Path, number: int, every: set[Pair]) -> bool:
    """Returns whether a set of users is also one of transmitters."""
    sets = parameters(folder).get("txrx_sets", {})
    entry = sets.get(f"txrx_set_{number}") if isinstance(sets, dict) else None
    return bool(entry.get("is_tx")) if isinstance(entry, dict) else number in {pair.tx_set for pair in every}


def _size(folder: Path, pair: Pair) -> int:
    """Returns the number of users."""
    return len(read_pair(folder, pair).get("rx_pos", ()))


PATHS = ("power", "phase", "delay", "aod_az", "aod_el", "aoa_az", "aoa_el")
NEEDED = (*PATHS, "rx_pos", "tx_pos")
ANGLES = {"theta_t": "aod_el", "phi_t": "aod_az", "theta_r": "aoa_el", "phi_r": "aoa_az"}
DIGITS = {SPECULAR: 1, DIFFRACTION: 2, DIFFUSE: 3, REFRACTION: 4}


def read_deepmimo(
    path: Path | str, tx_set: int | None = None, tx: int | None = None, rx_set: int | None = None
) -> dict[str, np.ndarray]:
    """Returns the arrays of a scenario by name: of a folder with one file per array, or of a single .npz or .mat file.

    Args:
        path: folder or file.
        tx_set, tx, rx_set: choice among several pairs of a transmitter and a set of users; by default the first transmitter,
            and the largest set of users that are not transmitters.

    Returns:
        The arrays in the scenario's units: degrees, seconds, dB.

    Raises:
        UserError: the scenario does not exist, or an array is missing.
    """
    path = Path(path)
    return _complete(path, read_pair(path, pairs_of(path, tx_set, tx, rx_set)[0]) if path.is_dir() else read_file(path))


def load_deepmimo(
    path: Path | str,
    frequency_hz: float | None = None,
    tx_set: int | None = None,
    tx: int | None = None,
    rx_set: int | None = None,
) -> RayPaths:
    """Returns the paths from all transmitters of a scenario's set (or from a chosen one) to its users.

    Args:
        path: folder or file.
        frequency_hz: needed if no params.json records it.
        tx_set, tx, rx_set: as in `read_deepmimo`.

    Returns:
        The paths, in radians and seconds.

    Raises:
        UserError: the scenario does not exist, an array is missing, or the frequency is unknown or contradicts the recorded
            one.
    """
    path = Path(path)
    if not path.exists():
        raise UserError(f"cannot read {path}: the scenario does not exist; check the path")
    tracer, recorded_hz = _traced(parameters(path))
    pairs = pairs_of(path, tx_set, tx, rx_set) if path.is_dir() else []
    found_arrays = [read_pair(path, pair) for pair in pairs] if pairs else [read_file(path)]
    every = [_complete(path, arrays) for arrays in found_arrays]
    if any(not np.array_equal(one["rx_pos"], every[0]["rx_pos"], equal_nan=True) for one in every[1:]):
        choices = ", ".join(str(pair.tx) for pair in pairs)
        raise UserError(f"{path}: its {len(every)} transmitters have different users; choose one, --tx-index {choices}")
    without_propagation = ("sionna",)  # ray tracers whose phases DeepMIMO's converters copy without the propagation
    lacks = any(name in tracer.lower() for name in without_propagation)
    frequency = frequency_of(recorded_hz, frequency_hz, str(path))
    return joined([from_deepmimo(one, frequency, not lacks) for one in every])


def joined(every: list[RayPaths]) -> RayPaths:
    """Returns the paths from several transmitters to the same receivers."""
    depth, count = (max(one.interactions.shape[axis] for one in every) for axis in (0, 3))

    def together(name: str, fill: Any) -> np.ndarray:
        axis = int(name in ("interactions", "vertices"))
        padded = []
        for one in every:
            values = getattr(one, name)
            widths = [(0, 0)] * values.ndim
            widths[axis + 2] = (0, count - values.shape[axis + 2])
            if axis:
                widths[0] = (0, depth - values.shape[0])
            padded.append(np.pad(values, widths, constant_values=fill))
        return np.concatenate(padded, axis + 1)

    fills = {"a": 0, "tau": -1, "theta_t": 0, "phi_t": 0, "theta_r": 0, "phi_r": 0, "valid": False}
    arrays: dict[str, Any] = {name: together(name, fill) for name, fill in fills.items()}
    arrays |= {"interactions": together("interactions", NONE), "vertices": together("vertices", np.nan)}
    sources = np.concatenate([one.sources for one in every])
    return RayPaths(**arrays, sources=sources, targets=every[0].targets, frequency_hz=every[0].frequency_hz)


def _complete(path: Path, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    if missing := [name for name in NEEDED if name not in arrays]:
        raise UserError(f"{path} has no {missing[0]}; a DeepMIMO scenario needs {', '.join(NEEDED)}")
    _check_shapes(path, arrays)
    _check_finite(path, arrays)
    _check_units(path, arrays)
    return arrays


def _check_shapes(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raises a `UserError` for arrays that are not numeric or whose shapes do not match."""
    shape = np.shape(arrays["power"])
    users, paths = (*shape, 0, 0)[:2]
    of_paths = dict.fromkeys((*PATHS, "inter"), ((users, paths),))
    places = {"rx_pos": ((users, 3),), "tx_pos": ((1, 3), (3,)), "inter_pos": ((users, paths, _depth(arrays), 3),)}
    for name, allowed in (of_paths | places).items():
        if name not in arrays:
            continue
        found = arrays[name]
        if found.dtype.kind not in "fiu":
            raise UserError(f"{name} in {path} is not numeric but {found.dtype}; write the scenario again")
        if len(shape) != 2 or found.shape not in allowed:
            expected = " or ".join(map(str, allowed))
            raise UserError(f"{name} in {path} has shape {found.shape}; expected {expected}: users, paths, ...")


def _check_finite(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raises a `UserError` for infinite powers, and for paths with a power but without phase, delay or directions."""
    power = np.asarray(arrays["power"], np.float64)
    if np.isposinf(power).any():
        raise UserError(f"power in {path} is infinite; give decibels, and NaN where a user has fewer paths")
    for name in PATHS[1:]:
        if not np.isfinite(arrays[name][np.isfinite(power)]).all():
            raise UserError(f"{name} in {path} is not finite for a path with a power; write the scenario again")


def _check_units(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raises a `UserError` for powers that are not decibels, and for phases or elevations that are probably radians."""
    # Arrays whose values are not confined to three degrees, and how many different values are needed to test this.
    in_degrees, many = ("phase", "aod_el", "aoa_el"), 8
    finite = {name: np.asarray(arrays[name], np.float64) for name in ("power", *in_degrees)}
    finite = {name: values[np.isfinite(values)] for name, values in finite.items()}
    if len(finite["power"]) and finite["power"].min() >= 0:
        low, high = finite["power"].min(), finite["power"].max()
        raise UserError(f"power in {path} is {low:.3g} to {high:.3g}; give decibels, 10 log10 of the power")
    for name in in_degrees:
        if len(np.unique(finite[name])) >= many and np.abs(finite[name]).max() <= np.pi + 1e-3:
            raise UserError(
                f"{name} in {path} is {finite[name].min():.3g} to {finite[name].max():.3g}; give degrees, not radians"
            )


def _depth(arrays: dict[str, np.ndarray]) -> int:
    """Returns the number of interactions whose positions a scenario stores."""
    places = arrays.get("inter_pos")
    return places.shape[2] if places is not None and places.ndim == 4 else 0


def is_deepmimo(path: Path) -> bool:
    """Returns whether a path is a DeepMIMO scenario rather than a file of Sionna's arrays."""
    return not path.is_file() or bool(set(NEEDED) & set(read_file(path)))


def write_deepmimo(
    folder: Path | str, arrays: dict[str, np.ndarray], frequency_hz: float, tx_set: int = 1, tx: int = 0, rx_set: int = 0
) -> None:
    """Writes arrays as the .npz files of a scenario into a folder, which DeepMIMO loads; further transmitters of the same users
    may be added.

    Args:
        folder: of the scenario; made if it does not exist.
        arrays: from `as_deepmimo`.
        frequency_hz: of the carrier.
        tx_set, tx, rx_set: numbers in the names of the files.

    Raises:
        UserError: params.json is damaged, or the scenario has other transmitters or users at another frequency.
    """
    write_pair(Path(folder), Pair(tx_set, tx, rx_set), arrays, frequency_hz)


def from_deepmimo(arrays: dict[str, np.ndarray], frequency_hz: float, propagation: bool = True) -> RayPaths:
    """Returns the paths from a scenario's transmitter to its users.

    Args:
        arrays: of `read_deepmimo`.
        frequency_hz: of the carrier, recorded in the scenario's parameters.
        propagation: whether phases include the propagation, if lines of sight do not reveal it.

    Returns:
        The paths, in radians and seconds.

    Raises:
        UserError: the phases of lines of sight have the opposite sign.
    """
    power = np.asarray(arrays["power"], np.float64)
    valid = np.isfinite(power)
    amplitude = np.where(valid, 10 ** (np.where(valid, power, 0) / 20), 0)
    phase, tau = np.radians(_filled(arrays["phase"], valid)), _filled(arrays["delay"], valid)
    turns = 2 * np.pi * np.mod(frequency_hz * tau, 1)
    if _includes_propagation(phase, turns, valid & (_filled(arrays.get("inter", power), valid) == 0), propagation):
        phase = phase + turns
    angles = {own: np.radians(_filled(arrays[name], valid))[:, None] for own, name in ANGLES.items()}
    met = _digits(_filled(arrays["inter"], valid)) if "inter" in arrays else np.zeros((0, *power.shape), np.int32)
    places = np.full((*met.shape, 3), np.nan)
    if "inter_pos" in arrays:
        given = np.moveaxis(np.asarray(arrays["inter_pos"], np.float64), -2, 0)[: len(met)]
        places[: len(given)] = given
    return RayPaths(
        a=(amplitude * np.exp(1j * phase))[:, None],
        tau=np.where(valid, tau, -1)[:, None],
        **angles,
        interactions=met[:, :, None],
        vertices=places[:, :, None],
        valid=valid[:, None],
        sources=np.asarray(arrays["tx_pos"], np.float64).reshape(-1, 3)[:1],
        targets=np.asarray(arrays["rx_pos"], np.float64).reshape(-1, 3),
        frequency_hz=frequency_hz,
    )


def _includes_propagation(
    phase: Float[np.ndarray, "n k"], turns: Float[np.ndarray, "n k"], direct: Bool[np.ndarray, "n k"], otherwise: bool
) -> bool:
    """Returns whether phases include the propagation; without it, those of lines of sight are all equal.

    Raises:
        UserError: they include it with the opposite sign.
    """
    # Length of the mean phasor of lines of sight above which their phases agree and below which they differ; and how many are
    # needed.
    alike, different, fewest = 0.99, 0.6, 5
    if direct.sum() < fewest:
        return otherwise
    without, with_it, negated = (abs(np.exp(1j * own[direct]).mean()) for own in (phase, phase + turns, phase - turns))
    if without > alike and with_it < different:
        return False
    if negated > alike and max(without, with_it) < different:
        raise UserError("the phases of this scenario's lines of sight grow with their delays; give the opposite sign")
    if max(without, with_it) < different:
        how = "include" if otherwise else "exclude"
        warnings.warn(
            "the phases of this scenario's lines of sight neither agree nor follow their delays; they are taken to "
            f"{how} the propagation: check the frequency",
            stacklevel=3,
        )
    return True if with_it > alike and without < different else otherwise


def as_deepmimo(paths: RayPaths, transmitter: int = 0) -> dict[str, np.ndarray]:
    """Returns the paths of one transmitter to all receivers as a scenario's arrays, for each receiver the strongest first.

    Args:
        paths: from one or more transmitters.
        transmitter: index of the one that is exported.

    Returns:
        Arrays by the names that DeepMIMO gives them: degrees, seconds, dB.
    """
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
    arrived = a * carrier(paths.frequency_hz, paths.tau[:, transmitter])
    columns = {"power": power, "phase": np.degrees(np.angle(arrived)), "delay": paths.tau[:, transmitter], **angles}
    code = sum((np.where(met == kind, digit, 0) for kind, digit in DIGITS.items()), np.zeros(met.shape, np.int64))
    return {
        **{name: sorted_values(values) for name, values in columns.items()},
        "inter": np.where(valid, _number(code), np.nan).astype(np.float32),
        "inter_pos": np.moveaxis(places, 0, -2).astype(np.float32),
        "rx_pos": paths.targets.astype(np.float32),
        "tx_pos": paths.sources[[transmitter]].astype(np.float32),
    }


def _filled(values: Any, valid: np.ndarray) -> np.ndarray:
    return np.where(valid, np.nan_to_num(np.asarray(values, np.float64)), 0)


def _digits(codes: np.ndarray) -> np.ndarray:
    """Returns Sionna's interactions along a leading axis from numbers whose digits are DeepMIMO's."""
    kinds = np.zeros(10, np.int32)
    for kind, digit in DIGITS.items():
        kinds[digit] = kind
    text = np.round(codes).astype(np.int64)
    depth = max((len(str(number)) for number in np.unique(text)), default=0)
    met = np.zeros((min(depth, 10), *codes.shape), np.int32)
    length = np.where(text > 0, np.floor(np.log10(np.maximum(text, 1))).astype(int) + 1, 0)
    for i in range(len(met)):
        digit = text // 10 ** np.maximum(length - 1 - i, 0) % 10
        met[i] = np.where(i < length, kinds[np.minimum(digit, 9)], NONE)
    return met


def _number(digits: np.ndarray) -> np.ndarray:
    """Returns numbers from their digits (leading axis); digits of 0 are skipped."""
    total = np.zeros(digits.shape[1:], np.int64)
    for digit in digits:
        total = np.where(digit > 0, 10 * total + digit, total)
    return total
