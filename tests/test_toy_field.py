"""A model is one file and its settings: a toy field, defined here and nowhere else, goes through everything that a field goes
through, by the command lines and as a library."""

import contextlib
import dataclasses
import json
import shutil
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import call
from jaxtyping import Array, Float
from synthetic import FREQUENCIES_HZ, tiny_dataset, tiny_scene

import wbgs_jax as wb
from wbgs_jax import eval as eval_command
from wbgs_jax import predict as predict_command
from wbgs_jax import train as train_command
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree, static
from wbgs_jax.config import PRESETS
from wbgs_jax.data.scene_file import save_scene
from wbgs_jax.data.splits import hold_out_validation
from wbgs_jax.evaluation.score import evaluate
from wbgs_jax.fields import base
from wbgs_jax.fields.base import with_field
from wbgs_jax.training.checkpoint import checkpoint_steps
from wbgs_jax.training.loop import Run, train
from wbgs_jax.training.run_folder import TrainedField


@dataclasses.dataclass(frozen=True)
class ToyConfig:
    """Settings of the toy."""

    brightness: float = 0.5
    """Of all pixels, at the start."""


@pytree
class ToyField(wb.Field):
    """An image and a received power for every receiver, whatever is asked."""

    positions: Float[Array, "r 3"]
    config: ToyConfig = static()

    name: ClassVar[str] = "toy"
    presets: ClassVar = with_field(PRESETS, dict.fromkeys(PRESETS, ToyConfig()))

    @classmethod
    def make(cls, config, scene, seed):
        return cls(scene.receivers.position, config)

    def init(self, key):
        receivers = len(self.positions)
        noise = 0.01 * jax.random.normal(key, (receivers, 90, 360))
        return {"image": self.config.brightness + noise, "power_db": jnp.zeros(receivers)}

    def plan(self, params, receiver, limits=None, cache=None):
        nearest = jnp.argmin(jnp.sum((self.positions - receiver.position) ** 2, -1))
        return jax.tree.map(lambda leaf: leaf[nearest], params)

    def render(self, params, plan, query):
        n = query.frequency_hz.shape[0]
        return wb.Observation(jnp.tile(plan["image"], (n, 1, 1)), power_db=jnp.tile(plan["power_db"], n))
