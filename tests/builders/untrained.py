"""A run folder without its training: initial parameters, shaken so that every query gets another answer."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from builders.synthetic import tiny_dataset, tiny_scene, tiny_settings
from wbgs_jax._util.pytree import pytree
from wbgs_jax.data.scene import DatasetScene
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.fields import Field
from wbgs_jax.fields.coherent import WaveField
from wbgs_jax.fields.wideband import WidebandField, WidebandParams
from wbgs_jax.inference.trained_field import RunConfig, TrainedField
from wbgs_jax.training import checkpoint
from wbgs_jax.training.run_folder import write_config

SETTINGS = tiny_settings()
STEP = 5


@pytree
class State:
    """The part of a training state that a trained field is read from."""

    params: Any


def make_field() -> Field:
    """60 Gaussians in the room of `tiny_scene`."""
    return WidebandField.build(SETTINGS.field, DatasetScene(tiny_dataset()), 0)


def make_params() -> WidebandParams:
    params = make_field().init(jax.random.key(0))
    rng = np.random.default_rng(0)
    shaken = jax.tree.map(lambda a: jnp.asarray(a + rng.normal(0, 0.2, a.shape), jnp.float32), params.networks)
    return dataclasses.replace(params, networks=shaken)


def make_run(folder: Path) -> Path:
    """Write the run folder, and the scene it was "trained" on beside it."""
    scene = folder.with_suffix(".npz")
    save_scene(scene, tiny_scene())
    write_config(folder, run_config(scene))
    metadata = {"limits": None, "seconds": 1.0}
    checkpoint.save(folder / "checkpoints", STEP, State(make_params()), make_field(), metadata, keep=1)
    return folder


def make_coherent_run(folder: Path, source: str = "") -> Path:
    """The same of the coherent field, of other data if their names are given."""
    scene = source or folder.with_suffix(".npz")
    if not source:
        save_scene(scene, tiny_scene())
    settings = tiny_settings("wave", field={"specular_kept": 16, "diffracted_tried": 32, "diffracted_kept": 8})
    config = RunConfig(str(scene), "wave", "smoke", 0, None, settings)
    write_config(folder, config)
    field = WaveField.build(settings.field, DatasetScene(config.dataset()), 0)
    state = State(field.init(jax.random.key(0)))
    checkpoint.save(folder / "checkpoints", STEP, state, field, {"limits": None, "seconds": 1.0}, keep=1)
    return folder


def run_config(scene: Path) -> RunConfig:
    return RunConfig(str(scene), "wideband", "smoke", 0, None, SETTINGS)


def make_trained(folder: Path) -> TrainedField:
    """As `load_trained(make_run(...))`, without files but the scene's."""
    scene = folder / "box.npz"
    save_scene(scene, tiny_scene())
    return TrainedField(run_config(scene), make_field(), make_params(), STEP, 1.0)
