"""What the arrays of a scene file must be; whatever else they are is told in one line."""

from typing import get_args

import numpy as np

from wbgs_jax._util.errors import UserError
from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH
from wbgs_jax.types import HIGHEST_FREQUENCY_HZ, LARGEST_COORDINATE_M, LOWEST_FREQUENCY_HZ, ElementUnit

TRAIN, TEST, VALIDATION = 0, 1, 2
"""Values of `split`."""

Spec = tuple[type[np.generic], tuple[str | int, ...]]
"""dtype and axes: a name stands for the same length everywhere."""
OBSERVATIONS: dict[str, Spec] = {
    "snapshots": (np.complex64, ("tx", "rx", "freq", "elements")),
    "pas": (np.uint8, ("tx", "rx", "freq", PAS_HEIGHT, PAS_WIDTH)),
    "power_db": (np.float32, ("tx", "rx", "freq")),
}
"""Exactly one of these is in a file ..."""
ARRAYS: dict[str, Spec] = {
    "element_positions": (np.float64, ("rx", "elements", 3)),
    "tx_positions": (np.float64, ("tx", 3)),
    "frequencies_hz": (np.float64, ("freq",)),
    "rx_position": (np.float64, ("rx", 3)),
    "rx_orientation": (np.float64, ("rx", 4)),
    "vertices": (np.float32, ("vertices", 3)),
    "faces": (np.int32, ("faces", 3)),
    "face_part": (np.int32, ("faces",)),
    "split": (np.int8, ("tx",)),
}
"""... and all of these, ..."""
MESH = ("vertices", "faces", "face_part")
"""Those of the surfaces."""
TEXTS = ("element_unit", "element_pattern")
"""... and these, arrays of text."""


def check_arrays(arrays: dict[str, np.ndarray], where: str) -> dict[str, np.ndarray]:
    """Returns the arrays of a scene file in their dtypes.

    Raises:
        UserError: an array is missing, or they make no scene; the message starts with `where`.
    """
    try:
        kind = _kind(arrays)
        specs = {kind: OBSERVATIONS[kind], **ARRAYS}
        sizes = _sizes(arrays, specs)
        _demand(all(sizes[axis] > 0 for axis in ("tx", "rx", "freq", "elements")), "there is no link in it")
        _check_values(arrays, sizes["vertices"])
        _check_texts(arrays, sizes["rx"])
        cast = _cast(arrays, specs)
        _check_values(cast, sizes["vertices"])
    except _Wrong as error:
        raise UserError(f"{where}: {error}; mend the scene or make it again (docs/formats.md)") from None
    return cast | {key: arrays[key] for key in TEXTS}


def check_mesh(arrays: dict[str, np.ndarray], where: str) -> dict[str, np.ndarray]:
    """Returns the arrays of surfaces (`MESH`) in their dtypes, or raises a `UserError` that starts with `where`."""
    specs = {key: ARRAYS[key] for key in MESH}
    try:
        count = _sizes(arrays, specs)["vertices"]
        _check_surfaces(arrays, count)
        cast = _cast(arrays, specs)
        _check_surfaces(cast, count)
    except _Wrong as error:
        raise UserError(f"{where}: {error}; mend the mesh or make it again (docs/formats.md)") from None
    return cast


def _cast(arrays: dict[str, np.ndarray], specs: dict[str, Spec]) -> dict[str, np.ndarray]:
    with np.errstate(over="ignore", invalid="ignore"):  # what has become infinite is found afterwards
        return {key: arrays[key].astype(dtype, copy=False) for key, (dtype, _) in specs.items()}


class _Wrong(Exception):
    """What is wrong, without a place."""


def _demand(ok: bool | np.bool_, what: str) -> None:
    if not ok:
        raise _Wrong(what)


def _kind(arrays: dict[str, np.ndarray]) -> str:
    """Returns the name of the observations; nothing that a scene needs is missing."""
    missing = [key for key in (*ARRAYS, *TEXTS) if key not in arrays]
    observed = [key for key in OBSERVATIONS if key in arrays]
    _demand(not missing, f"it is no scene, it lacks {', '.join(missing)}")
    _demand(len(observed) == 1, f"it holds {' and '.join(observed) or 'none'} of {', '.join(OBSERVATIONS)}, and needs one")
    return observed[0]


def _sizes(arrays: dict[str, np.ndarray], specs: dict[str, Spec]) -> dict[str, int]:
    """Returns the lengths of the named axes, the same in all arrays."""
    sizes: dict[str, int] = {}
    for key, (dtype, axes) in specs.items():
        value = arrays[key]
        castable = np.can_cast(value.dtype, dtype, "same_kind")
        _demand(value.ndim == len(axes) and castable, f"{key} must be a {len(axes)}-D {dtype.__name__} array")
        lengths = list(zip(axes, value.shape, strict=True))
        expected = tuple(sizes.get(axis, n) if isinstance(axis, str) else axis for axis, n in lengths)
        _demand(value.shape == expected, f"{key} has shape {value.shape}, expected {expected} beside the other arrays")
        sizes |= {axis: n for axis, n in lengths if isinstance(axis, str)}
    return sizes


def _check_surfaces(arrays: dict[str, np.ndarray], n_vertices: int) -> None:
    _check_positions(arrays, "vertices")
    faces = arrays["faces"]
    _demand((arrays["face_part"] >= 0).all(), "face_part must not be negative")
    _demand(((faces >= 0) & (faces < n_vertices)).all(), "faces point at vertices that do not exist")


def _check_positions(arrays: dict[str, np.ndarray], key: str) -> None:
    _demand(np.isfinite(arrays[key]).all(), f"{key} contains NaN or infinity")
    largest = np.abs(arrays[key]).max(initial=0)
    _demand(largest <= LARGEST_COORDINATE_M, f"{key} holds {largest:g}; positions are in metres, from a place on the site")


def _check_values(arrays: dict[str, np.ndarray], n_vertices: int) -> None:
    for key in ("tx_positions", "rx_position", "element_positions"):
        _check_positions(arrays, key)
    for key in ("rx_orientation", "frequencies_hz"):
        _demand(np.isfinite(arrays[key]).all(), f"{key} contains NaN or infinity")
    _check_surfaces(arrays, n_vertices)
    if (snapshots := arrays.get("snapshots")) is not None:
        known, nothing = np.isfinite(snapshots).all(-1), np.isnan(snapshots).all(-1)
        _demand((known | nothing).all(), "snapshots contains infinity, or NaN in some elements of a link alone")
        _demand(known.any(), "snapshots contains NaN alone")
    if (power := arrays.get("power_db")) is not None:
        _demand(not np.isinf(power).any() and not np.isnan(power).all(), "power_db contains infinity, or NaN alone")
    lowest, highest = arrays["frequencies_hz"].min(), arrays["frequencies_hz"].max()
    band = f"the model knows {LOWEST_FREQUENCY_HZ:g} to {HIGHEST_FREQUENCY_HZ:g} Hz"
    _demand(lowest > 0, "frequencies_hz must be positive")
    _demand(lowest >= LOWEST_FREQUENCY_HZ, f"frequencies_hz holds {lowest:g}; they are in hertz, 28e9 for 28 GHz, and {band}")
    _demand(highest <= HIGHEST_FREQUENCY_HZ, f"frequencies_hz holds {highest:g}; they are in hertz, and {band}")
    split = np.isin(arrays["split"], (TRAIN, TEST, VALIDATION))
    _demand(split.all(), "split must hold 0 (train), 1 (test) and 2 (validation) only")
    lengths = np.linalg.norm(arrays["rx_orientation"], axis=-1)
    _demand((np.abs(lengths - 1) < 1e-3).all(), "rx_orientation must hold unit quaternions (wxyz)")


def _check_texts(arrays: dict[str, np.ndarray], n_receivers: int) -> None:
    unit, pattern = (arrays[key] for key in TEXTS)
    units, shape = get_args(ElementUnit), pattern.shape
    _demand(unit.shape == () and str(unit) in units, f"element_unit must be {' or '.join(units)}")
    _demand(pattern.dtype.kind == "U" and shape in ((), (n_receivers,)), "element_pattern must be a name, or one a receiver")
