"""Loads datasets by name: a released scene by its number, a scene file, a folder of the published layout, or several of them
with different receivers in one scene as a single dataset. For files and folders of other programs, the error explains how to
convert them.
"""

import dataclasses
import itertools
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.conventions import ConventionName
from wbgs_jax.data.dataset import Dataset, Materials, group_transmitters, note_shared_transmitters
from wbgs_jax.data.scene_file import TEST, TRAIN, VALIDATION, Room, SceneFile, load_scene
from wbgs_jax.data.snapshot_frames import other_convention
from wbgs_jax.observation_kinds import only_kind
from wbgs_jax.types import Receiver, make_receiver, stack_receivers


def join(datasets: Sequence[Dataset]) -> Dataset:
    """Returns the links of all datasets in order.

    Receivers are renumbered consecutively, and transmitters of several datasets at the same position become one transmitter. It
    is in the test if any dataset tests it, otherwise in the validation if any validates it, since links to other receivers
    would reveal it. Links that are in no part of their dataset are in none here.

    Raises:
        UserError: the datasets are from different scenes, or have different kinds of observations, arrays or conventions.
    """
    first = datasets[0]
    for one, other in itertools.combinations(datasets, 2):
        _check_compatible(one, other)
    tx_positions = np.concatenate([one.tx_positions for one in datasets])
    tx_index = group_transmitters(tx_positions)
    before = np.cumsum([0, *(len(one) for one in datasets)])
    receivers = np.cumsum([0, *(one.n_receivers for one in datasets)])
    named = {
        part: np.concatenate([getattr(one, part) + start for one, start in zip(datasets, before, strict=False)])
        for part in ("train", "validation", "test")
    }
    listed = np.isin(np.arange(len(tx_index)), np.concatenate(list(named.values())))
    tested, validated = (np.isin(tx_index, np.unique(tx_index[index])) for index in (named["test"], named["validation"]))
    return Dataset(
        name="+".join(one.name for one in datasets),
        receivers=jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *(one.receivers for one in datasets)),
        tx_positions=tx_positions,
        frequencies_hz=np.concatenate([one.frequencies_hz for one in datasets]),
        receiver_index=_numbered_on(datasets, receivers),
        tx_index=tx_index,
        train=np.flatnonzero(listed & ~tested & ~validated),
        validation=np.flatnonzero(listed & validated & ~tested),
        test=np.flatnonzero(listed & tested),
        observations={name: np.concatenate([one.observations[name] for one in datasets]) for name in first.observations},
        vertices=first.vertices,
        faces=first.faces,
        face_part=first.face_part,
        materials=next((one.materials for one in datasets if one.materials is not None), None),
        convention=next((one.convention for one in datasets if one.convention is not None), None),
    )


def _check_compatible(first: Dataset, other: Dataset) -> None:
    where = f"{first.name} and {other.name} cannot be joined"
    if first.observed != other.observed:
        raise UserError(f"{where}: one contains {first.observed.words}, the other {other.observed.words}")
    arrays = [(one.receivers.unit, one.receivers.element_positions.shape[1:]) for one in (first, other)]
    if arrays[0] != arrays[1]:
        raise UserError(f"{where}: their arrays differ in the number or unit of their elements")
    surfaces = ("vertices", "faces", "face_part")
    if not all(np.array_equal(getattr(first, name), getattr(other, name)) for name in surfaces):
        raise UserError(f"{where}: their surfaces differ; give datasets of one scene")
    if _differ(first.materials, other.materials):
        raise UserError(f"{where}: the materials or thicknesses of their surfaces differ; correct the parts of one of them")
    if len({first.convention, other.convention} - {None}) > 1:
        raise UserError(
            f"{where}: their images have the conventions {first.convention} and {other.convention}; give folders of one"
        )


def _differ(first: Materials | None, other: Materials | None) -> bool:
    """Returns whether two assignments of materials are known and different."""
    if first is None or other is None:
        return False
    return not all(map(np.array_equal, dataclasses.astuple(first), dataclasses.astuple(other)))


def _numbered_on(datasets: Sequence[Dataset], receivers: Int[np.ndarray, " sets"]) -> Int[np.ndarray, " n"]:
    return np.concatenate([one.receiver_index + start for one, start in zip(datasets, receivers, strict=False)])


SNAPSHOTS = "read it with its own library and hand the arrays to `wb.interchange.scene_of_snapshots` (docs/formats.md)"
PATHS = "export its paths as DeepMIMO's converters do, or as the arrays of sionna.rt.Paths (docs/interchange.md)"
ROOM = "`wbgs-jax convert` makes a room of it for measured data, data_gen computes spectra for it (docs/own_scene.md)"
MODELS = (".usd", ".usda", ".usdc", ".usdz", ".stl", ".dae", ".fbx", ".blend", ".3ds", ".off", ".3mf", ".abc", ".vtk", ".vtp")
KINDS = {
    ".h5": ("an HDF5 file", SNAPSHOTS),
    ".hdf5": ("an HDF5 file", SNAPSHOTS),
    ".parquet": ("a Parquet file", PATHS),
    ".mat": (
        "a MATLAB file",
        "pass DeepMIMO's to `wbgs-jax convert --paths`, other arrays to `wb.interchange.scene_of_snapshots` (docs/formats.md)",
    ),
    ".npy": (
        "a single NumPy array",
        "create a folder of images, or a scene file of snapshots, with positions and receiver (docs/formats.md)",
    ),
    ".pkl": ("a pickle, which can run any program", "save its arrays as .npz"),
    ".pt": ("a PyTorch pickle, which can run any program", "save its arrays as .npz"),
    ".p2m": ("a Wireless InSite file", PATHS),
    ".uan": ("an antenna pattern of Wireless InSite", "write it as .csv or .npz for wb.radio.read_antenna (docs/formats.md)"),
    ".ffd": ("an antenna pattern of HFSS", "write it as .csv or .npz for wb.radio.read_antenna (docs/formats.md)"),
    ".csv": ("a table", "readings of powers go to `wbgs-jax measure --data FOLDER` (docs/measured.md)"),
    ".geojson": ("a map", "walls go into walls.csv (docs/measured.md)"),
    ".ifc": ("a building model", "export it as glTF or OBJ; then " + ROOM),
    ".dxf": ("a drawing", "export meshes as OBJ; then " + ROOM),
    ".svg": ("a drawing", "walls go into walls.csv (docs/measured.md)"),
    **dict.fromkeys((".xls", ".xlsx", ".ods"), ("a workbook", "save its sheets as .csv (docs/measured.md)")),
    **dict.fromkeys((".glb", ".gltf", ".obj", ".ply", ".xml"), ("a model of a room", ROOM)),
    **dict.fromkeys(MODELS, ("a model", "export it as glTF or OBJ; then " + ROOM)),
}
"""Descriptions of other kinds of files by suffix, and how to use their content."""


def check_kind(path: Path) -> None:
    """Raises a `UserError` with advice for a file of another program or a folder of another layout."""
    kind = KINDS.get(path.suffix.lower())
    if path.is_file() and kind is not None:
        raise UserError(f"{path} is {kind[0]}, not a scene file; {kind[1]}")
    if not path.is_dir() or (path / "spectrum").exists():
        return
    # Files in a folder of RF-3DGS with the cameras of its images.
    colmap = ("sparse", "cameras.bin", "cameras.txt", "transforms_train.json")
    if any((path / name).exists() for name in colmap):
        raise UserError(
            f"{path} is a folder of RF-3DGS: images from COLMAP cameras, without positions of transmitters; give "
            "spectrum/, tx_pos.csv and gateway_info.yml (docs/formats.md)"
        )
    if any(path.glob("*.npy")):
        raise UserError(
            f"{path} contains NumPy arrays; create a folder of images from them, spectrum/00001.png ..., with tx_pos.csv and "
            "gateway_info.yml, or a scene file of snapshots (docs/formats.md)"
        )


RELEASED = Path(__file__).parent / "released"
"""Folder of the released scene files."""

PARTS = {"train": TRAIN, "validation": VALIDATION, "test": TEST}
"""Values of `split` in scene files by part."""


def load_dataset(
    source: str | int | Path,
    frequency_hz: float | None = None,
    seed: int = 0,
    test_fraction: float = 0.2,
    convention: ConventionName | None = None,
) -> Dataset:
    """Loads a dataset from a scene number ("1": the released scene), a scene file (.npz) or a folder of the published layout;
    or from several of one scene, separated by commas, as one dataset with several receivers.

    Args:
        source: number or name of a released scene, a file, a folder, or several of them separated by commas.
        frequency_hz: hertz, of a folder that does not record it.
        seed: of the split of a folder that has none.
        test_fraction: fraction of the transmitters for testing in that split.
        convention: order of the rows of a folder's images; by default the recorded one, or what the images suggest.

    Returns:
        The data set: positions in metres (world frame), frequencies in hertz, observations and splits.

    Raises:
        UserError: there is no such scene, or its files are missing or damaged.
    """
    from wbgs_jax.data.image_folder import load_layout  # imported here because that module imports `scene_dataset`

    if (path := released_scenes().get(str(source))) is not None:
        return scene_dataset(load_scene(path))
    path = Path(str(source))
    if len(names := source_names(source)) > 1:
        return join([load_dataset(name, frequency_hz, seed, test_fraction, convention) for name in names])
    check_kind(path)
    if path.is_dir():
        return load_layout(path, frequency_hz, seed, test_fraction, convention)
    if path.suffix == ".npz":
        return scene_dataset(load_scene(path))
    if path.is_file():
        raise UserError(f"{path} is of an unknown kind; give a scene file (.npz) or a folder of spectra (docs/formats.md)")
    released = ", ".join(released_scenes()) or f"none in {_scene_folder()} (create them with `make data`)"
    raise UserError(f"there is no scene {str(source)!r}; give a released one ({released}), an .npz scene file or a folder")


def source_names(source: str | int | Path) -> list[str]:
    """Returns the names of the datasets in a name with commas; the name of an existing file or folder may itself contain
    commas."""
    word = str(source)
    return [word] if Path(word).exists() else [name for name in word.split(",") if name]


def source_paths(source: str) -> list[Path]:
    """Returns the files and folders that a dataset is read from."""
    released = released_scenes()
    return [released.get(name, Path(name)) for name in source_names(source)]


def scene_dataset(scene: SceneFile) -> Dataset:
    """Returns the links of a scene file, ordered by transmitter, receiver, and frequency (fastest).

    The split is that of the file. Links without an observation are omitted: those with a power of NaN (not received) or a
    snapshot of NaN (not measured).
    """
    links = _observed(scene)
    tx, rx, freq = np.nonzero(links)
    split = scene.split[tx]
    tx_index = group_transmitters(scene.tx_positions[tx])
    parts = {name: np.flatnonzero(split == code) for name, code in PARTS.items()}
    note_shared_transmitters(scene.name, tx_index, parts, scene.tx_positions[tx])
    dataset = Dataset(
        name=scene.name,
        receivers=stack_receivers(_receivers(scene)),
        tx_positions=scene.tx_positions[tx],
        frequencies_hz=scene.frequencies_hz[freq],
        receiver_index=rx,
        tx_index=tx_index,
        train=parts["train"],
        validation=parts["validation"],
        test=parts["test"],
        observations={name: values[links] for name, values in scene.observations.items()},
        vertices=scene.vertices,
        faces=scene.faces,
        face_part=scene.face_part,
        materials=materials_of(Room(scene.vertices, scene.faces, scene.face_part, scene.meta.get("parts", [])), scene.name),
    )
    if reason := other_convention(dataset):
        warnings.warn(f"{scene.name}: {reason}", stacklevel=2)
    return check_surroundings(dataset)


def check_surroundings(dataset: Dataset) -> Dataset:
    """Returns the dataset, after a comparison of its surfaces with its transmitters and receivers; a warning reports
    transmitters, or receivers, most of which are beside the surfaces.

    Raises:
        UserError: all antennas are farther from the box of the surfaces than its longest side, or most transmitters or most
            receivers much farther, as with another unit or frame.
    """
    if not len(dataset.faces):
        return dataset
    used = dataset.vertices[dataset.faces].reshape(-1, 3).astype(np.float64)
    low, high = used.min(0), used.max(0)
    # Median distance in longest sides that is another unit, and those that are noted: receivers may be outdoors.
    farthest, beside = 10.0, {"transmitters": 0.1, "receivers": 1.0}
    positions = np.unique(dataset.tx_positions, axis=0), np.asarray(dataset.receivers.position)
    distances = [np.maximum(low - own, own - high).max(-1) / (high - low).max() for own in positions]
    for (antennas, noted), own in zip(beside.items(), distances, strict=True):
        box = f"the surfaces, which lie between {np.round(low, 2).tolist()} and {np.round(high, 2).tolist()}"
        if np.concatenate(distances).min() > 1 or np.median(own) > farthest:
            raise UserError(f"{dataset.name}: the {antennas} are not near {box}; give both in metres, in one frame")
        if np.median(own) > noted:
            warnings.warn(
                f"{dataset.name}: most {antennas} lie outside of {box}; unless this is so, give both in metres, in one frame",
                stacklevel=3,
            )
    return dataset


def released_scenes() -> dict[str, Path]:
    """Returns the scene files by number ("1", "2", ...) or name ("cabin")."""
    files = {path.stem.removeprefix("scene"): path for path in _scene_folder().glob("*.npz")}
    return dict(sorted(files.items(), key=lambda item: (len(item[0]), item[0])))


def _label(part: Any, number: int, name: str) -> tuple[str, float]:
    """Returns the material of a part and its thickness (metres; 0: unknown)."""
    try:
        thickness = float(part.get("thickness", 0))
        material = str(part.get("material", part.get("name", number)))
    except (AttributeError, TypeError, ValueError):
        thickness, material = np.nan, ""
    max_thickness = 2.0  # metres: a larger thickness was probably given in millimetres
    if not 0 <= thickness <= max_thickness:
        raise UserError(
            f'part {number} of {name} must be {{"name", "material", "thickness"}} with a thickness in metres, 0 to '
            f"{max_thickness:g}; correct it"
        )
    return material, thickness


def _scene_folder() -> Path:
    data_variable = "WBGS_DATA"  # environment variable: folder of scene files that replaces those released with the package
    folder = os.environ.get(data_variable)
    return Path(folder) if folder else RELEASED


def _observed(scene: SceneFile) -> Bool[np.ndarray, "tx rx freq"]:
    """Returns which links of a scene file were observed."""
    kind = only_kind(scene.observations, scene.name)
    return np.ones(scene.shape, bool) if kind.measured is None else kind.measured(scene.observations[kind.name])


def _common(labels: list[tuple[str, float]], room: Room, name: str) -> list[tuple[str, float]]:
    """Returns the labels of parts with at most `MOST_MATERIALS` distinct ones, those of the largest area; the others are
    combined by thickness. If every object has a material of its own, the calibration of all of them would take hours."""
    kinds = sorted(set(labels))
    most, rest = 64, "others"  # maximum number of distinct materials of a scene, and the label of the others
    if len(kinds) <= most:
        return labels
    a, b, c = np.moveaxis(room.vertices[room.faces].astype(np.float64), 1, 0)
    of_face = np.array([kinds.index(label) for label in labels])[room.face_part]
    area = np.bincount(of_face, np.linalg.norm(np.cross(b - a, c - a), axis=-1), len(kinds))
    largest = {kinds[i] for i in np.argsort(-area, kind="stable")[:most]}
    warnings.warn(
        f"{name} has {len(kinds)} materials: all except the {most} of the largest area are treated as one",
        stacklevel=3,
    )
    return [label if label in largest else (rest, label[1]) for label in labels]


def _receivers(scene: SceneFile) -> list[Receiver]:
    named = scene.element_pattern
    patterns = (named,) * len(scene.rx_position) if isinstance(named, str) else named
    columns = zip(scene.rx_position, scene.rx_orientation, scene.element_positions, patterns, strict=True)
    return [
        make_receiver(position, orientation, elements, scene.element_unit, pattern)
        for position, orientation, elements, pattern in columns
    ]


def materials_of(room: Room, name: str) -> Materials | None:
    """Returns the materials of triangles: objects with the same material and thickness share one; if there are very many, the
    smaller ones are combined. None if not all objects are named.

    Args:
        room: surfaces and parts.
        name: of the file, for messages.

    Raises:
        UserError: an entry of the parts is invalid.
    """
    parts = room.parts
    if not isinstance(parts, list) or len(parts) <= int(room.face_part.max(initial=-1)):
        if parts:
            warnings.warn(f"{name} does not name all of its parts: they are treated as one material", stacklevel=2)
        return None
    labels = _common([_label(part, i, name) for i, part in enumerate(parts)], room, name)
    kinds = sorted(set(labels))
    material = np.array([kinds.index(label) for label in labels], np.int32)[room.face_part]
    return Materials(material, tuple(f"{label} {thickness:g}" for label, thickness in kinds), np.array([t for _, t in kinds]))
