"""The scene file: one `.npz` a scene, the contract between the generator (`data_gen`) and the library.

Positions are float64 metres in one z-up world frame; frequencies Hz; element positions wavelengths in the receiver's local
frame (`wbgs_jax.array`). Snapshots are complex64 and contain the carrier phase exp(-j 2 pi f tau). The PAS is computed from
the snapshot, never stored. `meta` is a JSON object (generator and versions, materials by part, seed, solver settings,
sha256 of the meshes, ceilings).
"""

import json
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Int

from wbgs_jax.errors import UserError
from wbgs_jax.files import atomic_write

FORMAT = 1
TRAIN, TEST = 0, 1


@dataclass(frozen=True)
class SceneFile:
    """The content of a scene file."""

    name: str
    snapshots: Complex[np.ndarray, "tx freq elements"]
    """complex64, carrier phase included."""
    tx_positions: Float[np.ndarray, "tx 3"]
    frequencies_hz: Float[np.ndarray, "freq"]
    rx_position: Float[np.ndarray, "3"]
    rx_orientation: Float[np.ndarray, "4"]
    """Unit quaternion, wxyz, local to world."""
    element_positions: Float[np.ndarray, "elements 3"]
    vertices: Float[np.ndarray, "vertices 3"]
    """float32."""
    faces: Int[np.ndarray, "faces 3"]
    """int32."""
    face_part: Int[np.ndarray, "faces"]
    """int32 index into meta["parts"], a list of {"name", "material", "thickness"}."""
    split: Int[np.ndarray, "tx"]
    """int8: 0 train, 1 test; one value a TX, shared by all frequencies."""
    meta: dict[str, Any] = field(default_factory=dict)


_ARRAYS: dict[str, tuple[type, int]] = {
    "snapshots": (np.complex64, 3),
    "tx_positions": (np.float64, 2),
    "frequencies_hz": (np.float64, 1),
    "rx_position": (np.float64, 1),
    "rx_orientation": (np.float64, 1),
    "element_positions": (np.float64, 2),
    "vertices": (np.float32, 2),
    "faces": (np.int32, 2),
    "face_part": (np.int32, 1),
    "split": (np.int8, 1),
}


# What NumPy, zipfile and zlib raise on damaged bytes; TypeError is a plain .npy array, RuntimeError an unknown compression.
_DAMAGED = (ValueError, TypeError, EOFError, RuntimeError, SyntaxError, MemoryError, zipfile.BadZipFile, zlib.error)


def save_scene(path: Path | str, scene: SceneFile) -> None:
    """Check and write a scene file; equal scenes give equal bytes."""
    arrays: dict[str, np.ndarray] = {key: np.asarray(getattr(scene, key), dtype) for key, (dtype, _) in _ARRAYS.items()}
    meta = json.dumps(scene.meta | {"format": FORMAT, "name": scene.name}, sort_keys=True)
    _check(arrays, str(path))
    with atomic_write(path) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for key, value in (arrays | {"meta": np.array(meta)}).items():
            # A fixed date: numpy.savez stamps the time, and two equal scenes would differ in their checksum.
            info = zipfile.ZipInfo(f"{key}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w") as member:
                np.lib.format.write_array(member, np.asarray(value, order="C"), allow_pickle=False)


def load_scene(path: Path | str) -> SceneFile:
    """Read and check a scene file.

    Raises:
        UserError: the file is missing, truncated, of another format, or its content is not a scene.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            missing = [key for key in (*_ARRAYS, "meta") if key not in archive]
            if missing:
                raise UserError(f"{path} is not a scene file: it lacks {', '.join(missing)}")
            arrays = {key: archive[key] for key in _ARRAYS}
            meta = json.loads(str(archive["meta"]))
    except OSError as error:
        reason = error.strerror or "not an .npz archive"
        raise UserError(f"cannot read scene file {path}: {reason}; check the path or make it again with `make data`") from error
    except _DAMAGED as error:
        raise UserError(f"scene file {path} is damaged or not a scene file ({error}); copy it or make it again") from error
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        found = meta.get("format") if isinstance(meta, dict) else None
        raise UserError(f"{path} has scene format {found}, this version reads {FORMAT}; update wbgs-jax")
    _check(arrays, str(path))
    arrays = {key: value.astype(_ARRAYS[key][0], copy=False) for key, value in arrays.items()}
    return SceneFile(name=str(meta.get("name", path.stem)), meta=meta, **arrays)


def _check(arrays: dict[str, np.ndarray], where: str) -> None:
    def demand(ok: bool, what: str) -> None:
        if not ok:
            raise UserError(f"{where}: {what}")

    for key, (dtype, ndim) in _ARRAYS.items():
        value = arrays[key]
        castable = np.can_cast(value.dtype, dtype, "same_kind")
        demand(value.ndim == ndim and castable, f"{key} must be a {ndim}-D {dtype.__name__} array")
        demand(bool(np.isfinite(value).all()), f"{key} contains NaN or infinity")
    n_tx, n_freq, n_elements = arrays["snapshots"].shape
    faces, n_vertices = arrays["faces"], len(arrays["vertices"])
    shapes = {
        "tx_positions": (n_tx, 3), "frequencies_hz": (n_freq,), "rx_position": (3,), "rx_orientation": (4,),
        "element_positions": (n_elements, 3), "vertices": (n_vertices, 3), "faces": (len(faces), 3),
        "face_part": (len(faces),), "split": (n_tx,),
    }  # fmt: skip
    for key, shape in shapes.items():
        demand(arrays[key].shape == shape, f"{key} has shape {arrays[key].shape}, expected {shape} from the snapshots")
    demand(n_tx > 0 and n_freq > 0, "there is no spectrum in it")
    demand(bool((arrays["frequencies_hz"] > 0).all()), "frequencies_hz must be positive")
    demand(bool(np.isin(arrays["split"], (TRAIN, TEST)).all()), "split must hold 0 (train) and 1 (test) only")
    demand(bool(((faces >= 0) & (faces < n_vertices)).all()), "faces point at vertices that do not exist")
    demand(abs(float(np.linalg.norm(arrays["rx_orientation"])) - 1) < 1e-3, "rx_orientation must be a unit quaternion (wxyz)")
