"""A run folder without its training: initial parameters, shaken so that every query gets another answer."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from synthetic import tiny_dataset, tiny_scene, tiny_settings

from wbgs_jax import checkpoint
from wbgs_jax.data.schema import save_scene
from wbgs_jax.data.surface import make_surface
from wbgs_jax.fields import wideband
from wbgs_jax.pytree import pytree
from wbgs_jax.runs import RunConfig, TrainedField, write_config

SETTINGS = tiny_settings()
STEP = 5


@pytree
class State:
    """The part of a training state that a trained field is read from."""

    params: Any


def make_params() -> wideband.WidebandParams:
    """60 Gaussians in the room of `tiny_scene`."""
    surface = jax.tree.map(jnp.asarray, make_surface(tiny_dataset(), SETTINGS.wideband.gaussians, seed=0))
    params = wideband.init(jax.random.key(0), surface, SETTINGS.wideband, SETTINGS.wideband.gaussians)
    rng = np.random.default_rng(0)
    shaken = jax.tree.map(lambda a: jnp.asarray(a + rng.normal(0, 0.2, a.shape), jnp.float32), params.networks)
    return dataclasses.replace(params, networks=shaken)


def make_run(folder: Path) -> Path:
    """Write the run folder, and the scene it was "trained" on beside it."""
    scene = folder.with_suffix(".npz")
    save_scene(scene, tiny_scene())
    write_config(folder, run_config(scene))
    metadata = {"sizes": {"gaussians": SETTINGS.wideband.gaussians}, "seconds": 1.0}
    checkpoint.save(folder / "checkpoints", STEP, State(make_params()), metadata, keep=1)
    return folder


def run_config(scene: Path) -> RunConfig:
    return RunConfig(str(scene), "wideband", "smoke", 0, None, SETTINGS)


def make_trained(folder: Path) -> TrainedField:
    """As `load_trained(make_run(...))`, without files but the scene's."""
    scene = folder / "box.npz"
    save_scene(scene, tiny_scene())
    return TrainedField(run_config(scene), wideband, make_params(), STEP, 1.0)
