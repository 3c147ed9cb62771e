"""Data sets by name: a released scene by its number, a scene file, a folder of the published layout, or several of them."""

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.conventions import ConventionName
from wbgs_jax.data.dataset import Dataset, Materials
from wbgs_jax.data.join import join
from wbgs_jax.data.other_files import check_kind
from wbgs_jax.data.room_file import Room
from wbgs_jax.data.scene_file import TEST, TRAIN, VALIDATION, SceneFile, load_scene
from wbgs_jax.data.splits import group_transmitters, note_shared_transmitters
from wbgs_jax.radio.channel import NOT_HEARD_DB
from wbgs_jax.types import LARGEST_COORDINATE_M, Receiver, make_receiver, stack_receivers

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
    from several of one scene, with commas between them, as one data set of several receivers (`wbgs_jax.data.join`).

    The other arguments are for folders that do not record them (`wbgs_jax.data.layout.load_layout`); scene files do.

    Raises:
        UserError: there is no such scene, or its files are missing or damaged.
    """
    from wbgs_jax.data.layout import load_layout  # here: `python -m wbgs_jax.data.layout` must not find itself imported

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
    observed = {"snapshots": scene.snapshots, "images": scene.pas, "power_db": scene.power_db}
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
        **{key: None if values is None else values[links] for key, values in observed.items()},
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
    if scene.power_db is not None:
        return scene.power_db > NOT_HEARD_DB  # nor is what is no number
    return np.ones(scene.observations.shape[:3], bool) if scene.snapshots is None else ~np.isnan(scene.snapshots).all(-1)


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
