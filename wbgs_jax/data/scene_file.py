"""The scene file: one `.npz` per scene, the interface between the generator (`data_gen`) and the library (docs/formats.md).

Positions are float64 metres in one z-up world frame, frequencies hertz. Element positions are in the receiver's local frame,
in wavelengths or metres. Snapshots contain the carrier phase exp(-j 2 pi f tau). `meta` is a JSON object (generator and
versions, parts with their materials, seed, solver settings, sha256 of the meshes, ceilings).

Files are written in format 2. Format 1 had only snapshots of a single receiver; its files are read and converted to format 2.
Arrays that violate the format raise an error of one line.

A room is a file of its own for data measured in it: one `.npz` with the arrays `vertices` (metres, world frame), `faces`,
`face_part` and `meta`, JSON with `parts`: name, material and thickness (metres; 0 if unknown) of every object, as in a scene
file.
"""

import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import Complex, Float, Int, UInt8

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, read_arrays, reported, safe_name
from wbgs_jax.observation_kinds import KINDS, HostObservations, Kind, only_kind
from wbgs_jax.types import LARGEST_COORDINATE_M, LOWEST_OF_PATHS_HZ, MAX_FREQUENCY_HZ, ElementUnit

TRAIN, TEST, VALIDATION = 0, 1, 2
"""Values of `split`."""

Spec = tuple[type[np.generic], tuple[str | int, ...]]
"""dtype and axes: a name stands for the same length everywhere."""
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
"""All of these are in a file, ..."""
MESH = ("vertices", "faces", "face_part")
"""Arrays of the surfaces."""
TEXTS = ("element_unit", "element_pattern")
"""... these, arrays of text, and the observations of exactly one kind (`observation_kinds.KINDS`)."""
BY_KEYWORD = ("snapshots", "pas", "power_db")
"""Kinds of observation that are fields of a `SceneFile`."""


def check_arrays(arrays: dict[str, np.ndarray], where: str) -> dict[str, np.ndarray]:
    """Returns the arrays of a scene file, converted to their dtypes.

    Raises:
        UserError: an array is missing or invalid; the message starts with `where`.
    """
    try:
        kind = _kind(arrays)
        specs = {kind.name: (kind.dtype, ("tx", "rx", "freq", *kind.axes)), **ARRAYS}
        sizes = _sizes(arrays, specs)
        _demand(all(sizes[axis] > 0 for axis in ("tx", "rx", "freq", "elements")), "it contains no links")
        _check_values(arrays, kind, sizes["vertices"])
        _check_texts(arrays, sizes["rx"])
        cast = _cast(arrays, specs)
        _check_values(cast, kind, sizes["vertices"])
    except _Wrong as error:
        raise UserError(f"{where}: {error}; correct the scene or create it again (docs/formats.md)") from None
    return cast | {key: arrays[key] for key in TEXTS}


def check_mesh(arrays: dict[str, np.ndarray], where: str) -> dict[str, np.ndarray]:
    """Returns the arrays of surfaces (`MESH`), converted to their dtypes.

    Raises:
        UserError: an array is missing or invalid; the message starts with `where`.
    """
    specs = {key: ARRAYS[key] for key in MESH}
    try:
        count = _sizes(arrays, specs)["vertices"]
        _check_surfaces(arrays, count)
        cast = _cast(arrays, specs)
        _check_surfaces(cast, count)
    except _Wrong as error:
        raise UserError(f"{where}: {error}; correct the mesh or create it again (docs/formats.md)") from None
    return cast


def _cast(arrays: dict[str, np.ndarray], specs: dict[str, Spec]) -> dict[str, np.ndarray]:
    with np.errstate(over="ignore", invalid="ignore"):  # values that become infinite are detected afterwards
        cast = {key: arrays[key].astype(dtype, copy=False) for key, (dtype, _) in specs.items()}
    for key, values in cast.items():
        kept = values.dtype.kind not in "iu" or np.array_equal(values, arrays[key])
        _demand(kept, f"{key} contains numbers beyond the range of {values.dtype}")
    return cast


class _Wrong(Exception):
    """Describes what is wrong, without the location."""


def _demand(ok: bool | np.bool_, what: str) -> None:
    if not ok:
        raise _Wrong(what)


def _kind(arrays: dict[str, np.ndarray]) -> Kind:
    """Returns the kind of the observations, after checking that all required arrays exist."""
    missing = [key for key in (*ARRAYS, *TEXTS) if key not in arrays]
    _demand(not missing, f"it is not a scene: it lacks {', '.join(missing)}")
    try:
        return only_kind(arrays, "it")
    except ValueError as error:
        raise _Wrong(str(error)) from None


def _sizes(arrays: dict[str, np.ndarray], specs: dict[str, Spec]) -> dict[str, int]:
    """Returns the lengths of the named axes, which must be the same in all arrays."""
    sizes: dict[str, int] = {}
    for key, (dtype, axes) in specs.items():
        value = arrays[key]
        phased = np.iscomplexobj(value) or not issubclass(dtype, np.complexfloating)  # real numbers would have phases of 0
        castable = phased and np.can_cast(value.dtype, dtype, "same_kind")
        is_now = f"{value.ndim}-D {value.dtype.name}"
        _demand(value.ndim == len(axes) and castable, f"{key} must be a {len(axes)}-D {dtype.__name__} array, not {is_now}")
        lengths = list(zip(axes, value.shape, strict=True))
        expected = tuple(sizes.get(axis, n) if isinstance(axis, str) else axis for axis, n in lengths)
        _demand(value.shape == expected, f"{key} has shape {value.shape}, expected {expected} to match the other arrays")
        sizes |= {axis: n for axis, n in lengths if isinstance(axis, str)}
    return sizes


def _check_surfaces(arrays: dict[str, np.ndarray], n_vertices: int) -> None:
    _check_positions(arrays, "vertices")
    faces = arrays["faces"]
    _demand((arrays["face_part"] >= 0).all(), "face_part must not be negative")
    _demand(((faces >= 0) & (faces < n_vertices)).all(), "faces refer to vertices that do not exist")


def _check_positions(arrays: dict[str, np.ndarray], key: str) -> None:
    _demand(np.isfinite(arrays[key]).all(), f"{key} contains NaN or infinity")
    largest = np.abs(arrays[key]).max(initial=0)
    _demand(
        largest <= LARGEST_COORDINATE_M, f"{key} contains {largest:g}; positions are in metres, relative to a point on the site"
    )


def _check_values(arrays: dict[str, np.ndarray], kind: Kind, n_vertices: int) -> None:
    for key in ("tx_positions", "rx_position", "element_positions"):
        _check_positions(arrays, key)
    for key in ("rx_orientation", "frequencies_hz"):
        _demand(np.isfinite(arrays[key]).all(), f"{key} contains NaN or infinity")
    _check_surfaces(arrays, n_vertices)
    fault = kind.fault(arrays[kind.name])
    _demand(not fault, f"{kind.name} contains {fault}")
    lowest, highest = arrays["frequencies_hz"].min(), arrays["frequencies_hz"].max()
    band = f"the valid range is {LOWEST_OF_PATHS_HZ:g} to {MAX_FREQUENCY_HZ:g} Hz"
    _demand(lowest > 0, "frequencies_hz must be positive")
    _demand(
        lowest >= LOWEST_OF_PATHS_HZ, f"frequencies_hz contains {lowest:g}; values are in hertz, 28e9 for 28 GHz, and {band}"
    )
    _demand(highest <= MAX_FREQUENCY_HZ, f"frequencies_hz contains {highest:g}; values are in hertz, and {band}")
    split = np.isin(arrays["split"], (TRAIN, TEST, VALIDATION))
    _demand(split.all(), "split must contain only 0 (train), 1 (test) and 2 (validation)")
    lengths = np.linalg.norm(arrays["rx_orientation"], axis=-1)
    _demand((np.abs(lengths - 1) < 1e-3).all(), "rx_orientation must contain unit quaternions (wxyz)")


def _check_texts(arrays: dict[str, np.ndarray], n_receivers: int) -> None:
    unit, pattern = (arrays[key] for key in TEXTS)
    units, shape = get_args(ElementUnit), pattern.shape
    _demand(unit.shape == () and str(unit) in units, f"element_unit must be {' or '.join(units)}")
    _demand(pattern.dtype.kind == "U" and shape in ((), (n_receivers,)), "element_pattern must be a name, or one per receiver")


FORMAT = 2
"""Format of files that are written; older ones can be read."""


@dataclass(frozen=True)
class SceneFile:
    """The content of a scene file. It has observations of one kind: `snapshots`, `pas`, `power_db`, or one of `others`."""

    name: str
    tx_positions: Float[np.ndarray, "tx 3"]
    frequencies_hz: Float[np.ndarray, " freq"]
    rx_position: Float[np.ndarray, "rx 3"]
    rx_orientation: Float[np.ndarray, "rx 4"]
    """Unit quaternions, wxyz, local to world."""
    element_positions: Float[np.ndarray, "rx elements 3"]
    """Local frame, in `element_unit`."""
    vertices: Float[np.ndarray, "vertices 3"]
    """float32."""
    faces: Int[np.ndarray, "faces 3"]
    """int32."""
    face_part: Int[np.ndarray, " faces"]
    """int32 index into meta["parts"], a list of {"name", "material", "thickness"}."""
    split: Int[np.ndarray, " tx"]
    """int8: 0 train, 1 test, 2 validation; one value per TX, shared by all receivers and frequencies."""
    snapshots: Complex[np.ndarray, "tx rx freq elements"] | None = None
    """complex64, including the carrier phase."""
    pas: UInt8[np.ndarray, "tx rx freq 90 360"] | None = None
    """Power angular spectra times 255."""
    power_db: Float[np.ndarray, "tx rx freq"] | None = None
    """float32: received power relative to the transmitted power, dB; NaN if nothing was received."""
    others: HostObservations = field(default_factory=dict)
    """Observations (tx, rx, freq, ...) of a kind without an attribute here, by its name."""
    element_unit: ElementUnit = "wavelengths"
    """Unit of `element_positions`: "metres" for an array of fixed size."""
    element_pattern: str | tuple[str, ...] = ""
    """Element pattern such as "tr38901" or "iso": one name for all receivers or one for each; empty if unknown."""
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def observations(self) -> HostObservations:
        """Observations by kind: arrays (tx, rx, freq, ...)."""
        named = {name: getattr(self, name) for name in BY_KEYWORD}
        return {name: values for name, values in named.items() if values is not None} | self.others

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of transmitters, receivers and frequencies."""
        return len(self.tx_positions), len(self.rx_position), len(self.frequencies_hz)


def save_scene(path: Path | str, scene: SceneFile) -> None:
    """Checks and writes a scene file; equal scenes give equal bytes.

    Args:
        path: of the file; an existing one is replaced at once, never left half-written.
        scene: its content.

    Raises:
        UserError: the scene is invalid, or the file cannot be written.
    """
    arrays = {key: getattr(scene, key) for key in (*ARRAYS, *TEXTS)} | scene.observations
    arrays = check_arrays({key: np.asarray(value) for key, value in arrays.items()}, str(path))
    meta = _to_json(scene.meta | {"format": FORMAT, "name": scene.name}, str(path))
    with atomic_write(path) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for key, value in (arrays | {"meta": np.array(meta)}).items():
            # A fixed date: numpy.savez stores the time, so that equal scenes would have different checksums.
            info = zipfile.ZipInfo(f"{key}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w") as member:
                np.lib.format.write_array(member, np.asarray(value, order="C"), allow_pickle=False)


def _to_json(meta: dict[str, Any], where: str) -> str:
    """Returns metadata as JSON, in which numbers and arrays of NumPy are plain ones."""

    def plain(value: Any) -> Any:
        if isinstance(value, np.generic | np.ndarray):
            return value.tolist()
        raise TypeError(f"a {type(value).__name__}")

    try:
        return json.dumps(meta, sort_keys=True, default=plain)
    except (TypeError, ValueError) as error:
        raise UserError(f"{where}: meta contains what JSON cannot represent ({error}); give texts, numbers and lists") from None


def load_scene(path: Path | str) -> SceneFile:
    """Reads and checks a scene file of this format or an older one.

    Args:
        path: of the file (.npz).

    Returns:
        The content of the file, in SI units (docs/formats.md).

    Raises:
        UserError: the file is missing, truncated, in another format, or does not contain a valid scene.
    """
    path = Path(path)
    advice = "check the path, copy it again, or make it again (docs/formats.md)"
    arrays = read_arrays(path, "scene file", advice, {"meta", *ARRAYS, *KINDS, *TEXTS})
    if "meta" not in arrays:
        raise UserError(f"{path} is not a scene file: it lacks meta; create one with `save_scene` (docs/formats.md)")
    with reported(f"meta of scene file {path}", advice):
        meta = json.loads(str(arrays.pop("meta")))
    found = meta.get("format") if isinstance(meta, dict) else None
    if found not in (1, FORMAT):
        raise UserError(f"{path} has scene format {str(found)[:20]}, but this version reads 1 and {FORMAT}; update wbgs-jax")
    if found == 1:
        arrays = _from_format_1(arrays, meta)
    arrays = check_arrays(arrays, str(path))
    others = {key: arrays.pop(key) for key in KINDS if key in arrays and key not in BY_KEYWORD}
    texts = {"element_unit": str(arrays.pop("element_unit")), "element_pattern": _text(arrays.pop("element_pattern"))}
    name = safe_name(str(meta.get("name", path.stem)))
    return SceneFile(name=name, meta=meta, others=others, **texts, **arrays)  # type: ignore[arg-type]


def _from_format_1(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> dict[str, np.ndarray]:
    """Returns the arrays of format 1 (one receiver without its own axis, array in wavelengths) converted to format 2."""
    array = meta.get("rx_array", {})
    texts = {"element_unit": "wavelengths", "element_pattern": array.get("pattern", "") if isinstance(array, dict) else ""}
    axis = {"snapshots": 1, "rx_position": 0, "rx_orientation": 0, "element_positions": 0}
    lifted = {key: np.expand_dims(value, axis[key]) if key in axis and value.ndim else value for key, value in arrays.items()}
    return lifted | {key: np.array(str(value)) for key, value in texts.items()}


def _text(value: np.ndarray) -> str | tuple[str, ...]:
    return str(value) if value.ndim == 0 else tuple(map(str, value))


@dataclass(frozen=True)
class Room:
    """Surfaces of a room."""

    vertices: Float[np.ndarray, "vertices 3"]
    """World frame, metres, float32."""
    faces: Int[np.ndarray, "faces 3"]
    """int32."""
    face_part: Int[np.ndarray, " faces"]
    """int32: index of the object that every triangle belongs to."""
    parts: Any = field(default_factory=list)
    """List of mappings with "name", "material" and "thickness" (metres; 0: unknown) of every object, as in the file;
    `materials_of` checks them."""


def save_room(path: Path | str, room: Room) -> None:
    """Checks and writes a room file.

    Args:
        path: of the file (.npz).
        room: its content.

    Raises:
        UserError: the room is invalid, or the file cannot be written.
    """
    arrays: dict[str, Any] = check_mesh({name: np.asarray(getattr(room, name)) for name in MESH}, str(path))
    meta = _to_json({"format": "room 1", "parts": room.parts}, str(path))
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **arrays, meta=np.array(meta))


def load_room(path: Path | str) -> Room:
    """Reads a room from a room file, or from a scene file that has a mesh.

    Args:
        path: of the file (.npz).

    Returns:
        Vertices (metres, world frame), triangles, and objects and materials if the file names them.

    Raises:
        UserError: the file is missing, damaged or of another kind, or has no triangles.
    """
    path, advice = Path(path), "create it with `wbgs-jax convert room.glb --out room.npz`"
    arrays = read_arrays(path, "room file", advice, {*MESH, "meta"})
    if missing := [name for name in (*MESH, "meta") if name not in arrays]:
        raise UserError(f"{path} is not a room file: it lacks {', '.join(missing)}; {advice}")
    with reported(f"meta of room file {path}", advice):
        meta = json.loads(str(arrays.pop("meta")))
        parts = meta.get("parts", [])
    room = Room(**check_mesh(arrays, str(path)), parts=parts)
    if not len(room.faces):
        raise UserError(f"{path} has no triangles; {advice}")
    return room
