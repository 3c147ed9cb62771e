"""Data in and out: scene files, the published folder layout, splits. `load_dataset` reads any of them."""

import os
from pathlib import Path

import numpy as np

from wbgs_jax.data.dataset import Dataset, Materials
from wbgs_jax.data.schema import TEST, TRAIN, SceneFile, load_scene
from wbgs_jax.data.splits import group_transmitters
from wbgs_jax.errors import UserError
from wbgs_jax.types import make_receiver

__all__ = ["Dataset", "SceneFile", "load_dataset", "load_scene", "scene_dataset"]

DATA_VARIABLE = "WBGS_DATA"
"""Environment variable: a folder of scene files to use instead of those released with the repository."""


def load_dataset(
    source: str | int | Path, frequency_hz: float | None = None, seed: int = 0, test_fraction: float = 0.2
) -> Dataset:
    """Load a data set from a scene number ("1": the released scene), a scene file (.npz) or a folder of the published layout.

    `frequency_hz`, `seed` and `test_fraction` are for folders that do not say (`wbgs_jax.data.layout.load_layout`); scene
    files know their frequencies and their split.

    Raises:
        UserError: there is no such scene, or its files are missing or damaged.
    """
    from wbgs_jax.data.layout import load_layout  # here: `python -m wbgs_jax.data.layout` must not find itself imported

    if (path := released_scenes().get(str(source))) is not None:
        return scene_dataset(load_scene(path))
    path = Path(str(source))
    if path.is_dir():
        return load_layout(path, frequency_hz=frequency_hz, seed=seed, test_fraction=test_fraction)
    if path.suffix == ".npz":
        return scene_dataset(load_scene(path))
    known = ", ".join(released_scenes()) or f"none in {_scene_folder()} (make them with `make data`)"
    raise UserError(f"there is no scene {str(source)!r}; give a released one ({known}), an .npz scene file or a folder")


def scene_dataset(scene: SceneFile) -> Dataset:
    """The spectra of a scene file in TX-major order, frequency fastest, with the file's own split."""
    n_tx, n_freq, n_elements = scene.snapshots.shape
    split = np.repeat(scene.split, n_freq)
    return Dataset(
        name=scene.name,
        receiver=make_receiver(scene.rx_position, scene.rx_orientation, scene.element_positions),
        tx_positions=np.repeat(scene.tx_positions, n_freq, axis=0),
        frequencies_hz=np.tile(scene.frequencies_hz, n_tx),
        tx_index=np.repeat(group_transmitters(scene.tx_positions), n_freq),
        train=np.flatnonzero(split == TRAIN),
        test=np.flatnonzero(split == TEST),
        snapshots=scene.snapshots.reshape(-1, n_elements),
        images=None,
        vertices=scene.vertices,
        faces=scene.faces,
        materials=_materials(scene),
        element_pattern=str(scene.meta.get("rx_array", {}).get("pattern", "")),
    )


def _materials(scene: SceneFile) -> Materials | None:
    """Parts of one material and thickness are one material. None if the file does not name its parts."""
    parts = scene.meta.get("parts", [])
    if len(parts) <= int(scene.face_part.max(initial=-1)):
        return None
    labels = [(str(part.get("material", part.get("name", i))), float(part.get("thickness", 0))) for i, part in enumerate(parts)]
    kinds = sorted(set(labels))
    cluster = np.array([kinds.index(label) for label in labels], np.int32)[scene.face_part]
    return Materials(cluster, tuple(f"{name} {thickness:g}" for name, thickness in kinds), np.array([t for _, t in kinds]))


def released_scenes() -> dict[str, Path]:
    """Scene numbers ("1", "2", ...) and the scene files that hold them."""
    files = {path.stem.removeprefix("scene"): path for path in _scene_folder().glob("scene*.npz")}
    return dict(sorted(files.items(), key=lambda item: (len(item[0]), item[0])))


def _scene_folder() -> Path:
    folder = os.environ.get(DATA_VARIABLE)
    return Path(folder) if folder else Path(__file__).parents[2] / "data_gen" / "released"
