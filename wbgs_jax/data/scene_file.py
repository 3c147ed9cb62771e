"""The scene file: one `.npz` a scene, the contract between the generator (`data_gen`) and the library (docs/formats.md).

Positions are float64 metres in one z-up world frame, frequencies hertz. Element positions are in the receiver's local frame,
in wavelengths or metres. Snapshots contain the carrier phase exp(-j 2 pi f tau). `meta` is a JSON object (generator and
versions, parts with their materials, seed, solver settings, sha256 of the meshes, ceilings).

Files are written in format 2. Format 1 knew snapshots of one receiver only; its files are read and look like one of format 2.
"""

import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Int, UInt8

from wbgs_jax._util.archives import read_arrays, told
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, safe_name
from wbgs_jax.data.scene_checks import ARRAYS, OBSERVATIONS, TEST, TEXTS, TRAIN, VALIDATION, check_arrays
from wbgs_jax.types import ElementUnit

__all__ = ["FORMAT", "TEST", "TRAIN", "VALIDATION", "SceneFile", "load_scene", "save_scene"]

FORMAT = 2
"""Of files that are written; older ones are read."""


@dataclass(frozen=True)
class SceneFile:
    """The content of a scene file; exactly one of `snapshots`, `pas` and `power_db` is not None."""

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
    """int8: 0 train, 1 test, 2 validation; one value a TX, shared by all receivers and frequencies."""
    snapshots: Complex[np.ndarray, "tx rx freq elements"] | None = None
    """complex64, carrier phase included."""
    pas: UInt8[np.ndarray, "tx rx freq 90 360"] | None = None
    """Power angular spectra times 255."""
    power_db: Float[np.ndarray, "tx rx freq"] | None = None
    """float32: received power relative to the transmitted power, dB; NaN where a receiver does not hear a transmitter."""
    element_unit: ElementUnit = "wavelengths"
    """Of `element_positions`: "metres" is an array of fixed size."""
    element_pattern: str | tuple[str, ...] = ""
    """Element pattern such as "tr38901" or "iso", one name for all receivers or one for each; empty where it is not known."""
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def observations(self) -> np.ndarray:
        """Returns what was observed, of whichever kind: (tx, rx, freq, ...)."""
        (observed,) = (values for values in (self.snapshots, self.pas, self.power_db) if values is not None)
        return observed


def save_scene(path: Path | str, scene: SceneFile) -> None:
    """Checks and writes a scene file; equal scenes give equal bytes."""
    arrays = {key: getattr(scene, key) for key in (*ARRAYS, *OBSERVATIONS, *TEXTS)}
    arrays = {key: np.asarray(value) for key, value in arrays.items() if value is not None}
    arrays = check_arrays(arrays, str(path))
    meta = json.dumps(scene.meta | {"format": FORMAT, "name": scene.name}, sort_keys=True)
    with atomic_write(path) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for key, value in (arrays | {"meta": np.array(meta)}).items():
            # A fixed date: numpy.savez stamps the time, and two equal scenes would differ in their checksum.
            info = zipfile.ZipInfo(f"{key}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w") as member:
                np.lib.format.write_array(member, np.asarray(value, order="C"), allow_pickle=False)


def load_scene(path: Path | str) -> SceneFile:
    """Reads and checks a scene file of this format or an older one.

    Raises:
        UserError: the file is missing, truncated, of another format, or its content is not a scene.
    """
    path = Path(path)
    advice = "check the path, copy it again, or make it again (docs/formats.md)"
    arrays = read_arrays(path, "scene file", advice, {"meta", *ARRAYS, *OBSERVATIONS, *TEXTS})
    if "meta" not in arrays:
        raise UserError(f"{path} is not a scene file: it lacks meta; make one with `save_scene` (docs/formats.md)")
    with told(f"meta of scene file {path}", advice):
        meta = json.loads(str(arrays.pop("meta")))
    found = meta.get("format") if isinstance(meta, dict) else None
    if found not in (1, FORMAT):
        raise UserError(f"{path} has scene format {str(found)[:20]}, this version reads 1 and {FORMAT}; update wbgs-jax")
    if found == 1:
        arrays = _from_format_1(arrays, meta)
    arrays = check_arrays(arrays, str(path))
    texts = {"element_unit": str(arrays.pop("element_unit")), "element_pattern": _text(arrays.pop("element_pattern"))}
    return SceneFile(name=safe_name(str(meta.get("name", path.stem))), meta=meta, **texts, **arrays)  # type: ignore[arg-type]


def _from_format_1(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> dict[str, np.ndarray]:
    """Returns the arrays of format 1, one receiver without an axis of its own and an array in wavelengths, as format 2."""
    array = meta.get("rx_array", {})
    texts = {"element_unit": "wavelengths", "element_pattern": array.get("pattern", "") if isinstance(array, dict) else ""}
    axis = {"snapshots": 1, "rx_position": 0, "rx_orientation": 0, "element_positions": 0}
    lifted = {key: np.expand_dims(value, axis[key]) if key in axis and value.ndim else value for key, value in arrays.items()}
    return lifted | {key: np.array(str(value)) for key, value in texts.items()}


def _text(value: np.ndarray) -> str | tuple[str, ...]:
    return str(value) if value.ndim == 0 else tuple(map(str, value))
