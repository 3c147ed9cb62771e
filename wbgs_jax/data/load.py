"""Data sets by name: a released scene by its number, a scene file, a folder of the published layout, or several of them.

Several data sets of one scene, each seen from receivers of its own, as one.

What files and folders of other programs are, and the way from there.
"""

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
from wbgs_jax.data.dataset import Dataset, Materials
from wbgs_jax.data.room_file import Room
from wbgs_jax.data.scene_file import TEST, TRAIN, VALIDATION, SceneFile, load_scene
from wbgs_jax.data.splits import group_transmitters, note_shared_transmitters
from wbgs_jax.observation_kinds import only_kind
from wbgs_jax.types import LARGEST_COORDINATE_M, Receiver, make_receiver, stack_receivers

SURFACES = ("vertices", "faces", "face_part")


def join(datasets: Sequence[Dataset]) -> Dataset:
    """Returns the links of all data sets in their order.

    Receivers are numbered on, and a place where several data sets have a transmitter is one transmitter. It is of the test if
    one of them tests it, and else of the validation if one of them validates it: its other receivers would give it away. Links
    that are in no part of their data set are in none here.

    Raises:
        UserError: they are not of one scene, or of different kinds or arrays.
    """
    first, *others = datasets
    for other in others:
        _check_alike(first, other)
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
        materials=first.materials,
    )


def _check_alike(first: Dataset, other: Dataset) -> None:
    where = f"{first.name} and {other.name} cannot be joined"
    if first.observed != other.observed:
        raise UserError(f"{where}: one holds {first.observed.words} and the other {other.observed.words}")
    arrays = [(one.receivers.unit, one.receivers.element_positions.shape[1:]) for one in (first, other)]
    if arrays[0] != arrays[1]:
        raise UserError(f"{where}: their arrays differ in the number or the unit of their elements")
    if not all(np.array_equal(getattr(first, name), getattr(other, name)) for name in SURFACES):
        raise UserError(f"{where}: their surfaces differ; give data sets of one scene")


def _numbered_on(datasets: Sequence[Dataset], receivers: Int[np.ndarray, " sets"]) -> Int[np.ndarray, " n"]:
    return np.concatenate([one.receiver_index + start for one, start in zip(datasets, receivers, strict=False)])


SNAPSHOTS = "read it with its own library and hand the arrays to `wb.scene_of_snapshots` (docs/formats.md)"
PATHS = "export its paths as DeepMIMO's converters do, or as the arrays of sionna.rt.Paths (docs/interchange.md)"
ROOM = "`wbgs-jax convert` makes a room of it beside measured data, data_gen makes spectra for it (docs/own_scene.md)"
MODELS = (".usd", ".usda", ".usdc", ".usdz", ".stl", ".dae", ".fbx", ".blend", ".3ds", ".off", ".3mf", ".abc", ".vtk", ".vtp")
KINDS = {
    ".h5": ("of HDF5", SNAPSHOTS),
    ".hdf5": ("of HDF5", SNAPSHOTS),
    ".parquet": ("of Parquet", PATHS),
    ".mat": (
        "of MATLAB",
        "give DeepMIMO's to `wbgs-jax convert --paths`, other arrays to `wb.scene_of_snapshots` (docs/formats.md)",
    ),
    ".npy": (
        "a single array of NumPy",
        "make a folder of images, or a scene file of snapshots, with places and receiver (docs/formats.md)",
    ),
    ".pkl": ("a pickle, which can run any program", "save its arrays as .npz"),
    ".pt": ("a pickle of PyTorch, which can run any program", "save its arrays as .npz"),
    ".p2m": ("of Wireless InSite", PATHS),
    ".uan": ("an antenna pattern of Wireless InSite", "patterns are named: tr38901, iso, dipole, hw_dipole (docs/formats.md)"),
    ".ffd": ("an antenna pattern of HFSS", "patterns are named: tr38901, iso, dipole, hw_dipole (docs/formats.md)"),
    ".csv": ("a table", "readings of powers go to `wbgs-jax measure --data FOLDER` (docs/measured.md)"),
    ".geojson": ("a map", "walls go into walls.csv (docs/measured.md)"),
    ".ifc": ("a building model", "export it as glTF or OBJ; then " + ROOM),
    ".dxf": ("a drawing", "export meshes as OBJ; then " + ROOM),
    ".svg": ("a drawing", "walls go into walls.csv (docs/measured.md)"),
    **dict.fromkeys((".xls", ".xlsx", ".ods"), ("a workbook", "save its sheets as .csv (docs/measured.md)")),
    **dict.fromkeys((".glb", ".gltf", ".obj", ".ply", ".xml"), ("a model of a room", ROOM)),
    **dict.fromkeys(MODELS, ("a model", "export it as glTF or OBJ; then " + ROOM)),
}
"""Of files by their suffix: what they are, and what to do with them."""
COLMAP = ("sparse", "cameras.bin", "cameras.txt", "transforms_train.json")
"""Of a folder of RF-3DGS: the cameras of its images."""


def check_kind(path: Path) -> None:
    """Raises a `UserError` for a file of another program, or a folder of another layout, that says what is missing."""
    kind = KINDS.get(path.suffix.lower())
    if path.is_file() and kind is not None:
        raise UserError(f"{path} is {kind[0]}, not a scene file; {kind[1]}")
    if not path.is_dir() or (path / "spectrum").exists():
        return
    if any((path / name).exists() for name in COLMAP):
        raise UserError(
            f"{path} is a folder of RF-3DGS: pictures by cameras of COLMAP, without the places of transmitters; give "
            "spectrum/, tx_pos.csv and gateway_info.yml (docs/formats.md)"
        )
    if any(path.glob("*.npy")):
        raise UserError(
            f"{path} holds arrays of NumPy; make a folder of images of them, spectrum/00001.png ..., with tx_pos.csv and "
            "gateway_info.yml, or a scene file of snapshots (docs/formats.md)"
        )


DATA_VARIABLE = "WBGS_DATA"
"""Environment variable: a folder of scene files to use instead of those released with the package."""
RELEASED = Path(__file__).parent / "released"
"""Folder of the released scene files."""

MOST_MATERIALS, REST = 64, "others"
"""Materials of a scene that are told apart, and what the rest of them is called."""
PARTS = {"train": TRAIN, "validation": VALIDATION, "test": TEST}
"""Of a split, as scene files number them."""


def load_dataset(
    source: str | int | Path,
    frequency_hz: float | None = None,
    seed: int = 0,
    test_fraction: float = 0.2,
    convention: ConventionName | None = None,
) -> Dataset:
    """Loads a data set from a scene number ("1": the released scene), a scene file (.npz) or a folder of the published layout;
    from several of one scene, with commas between them, as one data set of several receivers (`wbgs_jax.data.load`).

    The other arguments are for folders that do not record them (`wbgs_jax.data.image_folder.load_layout`); scene files do.

    Raises:
        UserError: there is no such scene, or its files are missing or damaged.
    """
    from wbgs_jax.data.image_folder import load_layout  # here: it needs `scene_dataset`

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
        raise UserError(f"{path} is of no known kind; give a scene file (.npz) or a folder of spectra (docs/formats.md)")
    known = ", ".join(released_scenes()) or f"none in {_scene_folder()} (make them with `make data`)"
    raise UserError(f"there is no scene {str(source)!r}; give a released one ({known}), an .npz scene file or a folder")


def source_names(source: str | int | Path) -> list[str]:
    """Returns the names of the data sets that a name with commas stands for; a file or folder may have commas in its own."""
    word = str(source)
    return [word] if Path(word).exists() else [name for name in word.split(",") if name]


def source_paths(source: str) -> list[Path]:
    """Returns the files and folders that a data set is read from."""
    released = released_scenes()
    return [released.get(name, Path(name)) for name in source_names(source)]


def scene_dataset(scene: SceneFile) -> Dataset:
    """Returns the links of a scene file, transmitter by transmitter, then receiver by receiver, frequency fastest.

    The split is the file's own. Links that nobody observed are left out: those whose power is NaN, where a receiver does not
    hear a transmitter, or whose snapshot is NaN, where nobody measured.
    """
    links = _observed(scene)
    tx, rx, freq = np.nonzero(links)
    split = scene.split[tx]
    tx_index = group_transmitters(scene.tx_positions[tx])
    parts = {name: np.flatnonzero(split == code) for name, code in PARTS.items()}
    note_shared_transmitters(scene.name, tx_index, parts)
    return Dataset(
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


def released_scenes() -> dict[str, Path]:
    """Returns scene numbers ("1", "2", ...) or names ("cabin") and the scene files that hold them."""
    files = {path.stem.removeprefix("scene"): path for path in _scene_folder().glob("*.npz")}
    return dict(sorted(files.items(), key=lambda item: (len(item[0]), item[0])))


def _label(part: Any, number: int, name: str) -> tuple[str, float]:
    """Returns the material of a part and its thickness (metres; 0: not known)."""
    try:
        thickness = float(part.get("thickness", 0))
        material = str(part.get("material", part.get("name", number)))
    except (AttributeError, TypeError, ValueError):
        thickness, material = np.nan, ""
    if not 0 <= thickness <= LARGEST_COORDINATE_M:
        raise UserError(f'part {number} of {name} must be {{"name", "material", "thickness"}}, its thickness metres from 0 on')
    return material, thickness


def _scene_folder() -> Path:
    folder = os.environ.get(DATA_VARIABLE)
    return Path(folder) if folder else RELEASED


def _observed(scene: SceneFile) -> Bool[np.ndarray, "tx rx freq"]:
    """Returns which links of a scene file were observed."""
    kind = only_kind(scene.observations, scene.name)
    return np.ones(scene.shape, bool) if kind.measured is None else kind.measured(scene.observations[kind.name])


def _common(labels: list[tuple[str, float]], room: Room, name: str) -> list[tuple[str, float]]:
    """Returns the labels of parts with at most `MOST_MATERIALS` of them, the largest by area, and one for the others of every
    thickness: where each object is of a material of its own, searching them all takes hours."""
    kinds = sorted(set(labels))
    if len(kinds) <= MOST_MATERIALS:
        return labels
    a, b, c = np.moveaxis(room.vertices[room.faces].astype(np.float64), 1, 0)
    of_face = np.array([kinds.index(label) for label in labels])[room.face_part]
    area = np.bincount(of_face, np.linalg.norm(np.cross(b - a, c - a), axis=-1), len(kinds))
    largest = {kinds[i] for i in np.argsort(-area, kind="stable")[:MOST_MATERIALS]}
    warnings.warn(
        f"{name} names {len(kinds)} materials: all but the {MOST_MATERIALS} of the largest area are taken for one",
        stacklevel=3,
    )
    return [label if label in largest else (REST, label[1]) for label in labels]


def _receivers(scene: SceneFile) -> list[Receiver]:
    named = scene.element_pattern
    patterns = (named,) * len(scene.rx_position) if isinstance(named, str) else named
    columns = zip(scene.rx_position, scene.rx_orientation, scene.element_positions, patterns, strict=True)
    return [
        make_receiver(position, orientation, elements, scene.element_unit, pattern)
        for position, orientation, elements, pattern in columns
    ]


def materials_of(room: Room, name: str) -> Materials | None:
    """Returns what triangles are made of: objects of one material and thickness share a material, and of very many materials
    the smaller ones do. None if not all objects are named; what is no object is a `UserError` that names `name`."""
    parts = room.parts
    if not isinstance(parts, list) or len(parts) <= int(room.face_part.max(initial=-1)):
        if parts:
            warnings.warn(f"{name} does not name all of its parts: they are taken to be of one material", stacklevel=2)
        return None
    labels = _common([_label(part, i, name) for i, part in enumerate(parts)], room, name)
    kinds = sorted(set(labels))
    material = np.array([kinds.index(label) for label in labels], np.int32)[room.face_part]
    return Materials(material, tuple(f"{label} {thickness:g}" for label, thickness in kinds), np.array([t for _, t in kinds]))
