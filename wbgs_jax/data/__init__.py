"""Import and export of data: scene files, the published folder layout, splits, surfaces. `load_dataset` reads all formats."""

from wbgs_jax.data.dataset import Dataset, Materials
from wbgs_jax.data.load import load_dataset, released_scenes, scene_dataset
from wbgs_jax.data.scene_file import SceneFile, load_scene, save_scene

__all__ = [
    "Dataset",
    "Materials",
    "SceneFile",
    "load_dataset",
    "load_scene",
    "released_scenes",
    "save_scene",
    "scene_dataset",
]
