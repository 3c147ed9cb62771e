"""What tests of training share: fields that compile in no time, which know nothing and learn a little, and settings."""

import contextlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from builders.synthetic import tiny_settings
from wbgs_jax._util.pytree import pytree, static
from wbgs_jax.config import PRESETS, LoopConfig, OptimConfig, Settings, changed
from wbgs_jax.fields import Field, Group, Observation, base, register
from wbgs_jax.fields.base import with_field
from wbgs_jax.inference.trained_field import RunConfig, TrainedField

GROWING = tiny_settings(
    field={"network_lr": 1.5e-2, "means_lr": 1e-2, "log_scales_lr": 3e-2, "opacity_lr": 0.1},
    density={"every": 4, "start": 4, "stop_fraction": 0.5, "gradient_threshold": 0.0, "max_gaussians": 90, "reset_every": 4},
)
"""Of the wideband field: half way, its 60 Gaussians outgrow their 64 slots. All tests that train it do so with these settings,
to compile them once."""


@dataclass(frozen=True)
class RippleConfig:
    """Settings of a toy field."""

    learning_rate: float = 0.1


@pytree
class RippleField(Field):
    """Cosines over azimuth under a brightness that depends on where the transmitter is."""

    config: RippleConfig = static()

    name: ClassVar[str] = "ripple"
    presets: ClassVar = with_field(PRESETS, dict.fromkeys(PRESETS, RippleConfig()))

    @classmethod
    def build(cls, config, scene, seed):
        return cls(config)

    def init(self, key):
        return {"level": 0.1 * jax.random.normal(key, (4,)), "tilt": jnp.zeros(3)}

    def plan(self, params, receiver, prepared=None, capacity=None):
        return receiver.position

    def render(self, params, plan, links):
        ripples = jnp.cos(jnp.arange(4)[:, None] * jnp.linspace(-jnp.pi, jnp.pi, 360))
        brightness = (links.tx_position - plan) @ params["tilt"]
        rows = jax.nn.sigmoid(params["level"] @ ripples + brightness[:, None])
        return Observation(jnp.broadcast_to(rows[:, None], (len(rows), 90, 360)))

    @classmethod
    def param_groups(cls, config, params=None):
        return {"all": Group(config.learning_rate)}, super().param_groups(config, params)[1]


@pytree
class NoisyField(RippleField):
    """The same, trained on spectra under which noise has put a floor."""

    name: ClassVar[str] = "noisy ripple"

    def as_observed(self, params, pas):
        return jnp.sqrt((pas**2 + 0.3) / 1.3)


@dataclass(frozen=True)
class Room:
    """Capacity of `SwellingField`."""

    size: int

    def grown_to(self, others):
        return Room(max(self.size, others.size) + 10)


@pytree
class SwellingField(RippleField):
    """Needs more room the further its levels are from zero."""

    name: ClassVar[str] = "swelling"

    @staticmethod
    def required(params):
        return jnp.ceil(20 * jnp.max(jnp.abs(params["level"]))).astype(jnp.int32)[None]

    def capacity(self, params, receivers, required=None):
        return Room(int((self.required(params) if required is None else required)[0]))

    def loss(self, params, prepared, batch, capacity=None, probe=None):
        loss, aux = super().loss(params, prepared, batch, capacity, probe)
        required = self.required(params)
        return loss, aux._replace(required=required, overflow=required[0] > capacity.size)


@pytree
class CuspField(RippleField):
    """sqrt at zero: its value is finite, its slope is not."""

    name: ClassVar[str] = "cusp"

    def render(self, params, plan, links):
        flat = jnp.sqrt(0 * params["level"][0])
        return Observation(jnp.full((links.frequency_hz.shape[0], 90, 360), 0.5) + flat)


@contextlib.contextmanager
def registered(*fields: type[Field]) -> Iterator[None]:
    """Makes fields known for a while."""
    for field in fields:
        register(field)
    try:
        yield
    finally:
        for field in fields:
            del base._FIELDS[field.name]


def toy_settings(**changes: Any) -> Settings:
    """As `synthetic.tiny_settings`, of a toy field without hooks."""
    loop = LoopConfig(epoch_steps=2, evaluate_every=8, evaluate_spectra=2, checkpoint_every=4, keep_checkpoints=2)
    return changed(Settings(RippleConfig(), OptimConfig(steps=8, batch=2, final_fraction=1.0, virtual=0.0), loop), changes)


def as_trained(field: Any, params: Any, kind: type[TrainedField] = TrainedField) -> TrainedField:
    """A field as a trained one, without a run folder; `kind` may be a subclass that has the data."""
    return kind(RunConfig("gone", field.name, "none", 0, None, toy_settings()), field, params, 3, 0.0)


def metrics_of(folder):
    """Curve entries without the wall-clock time."""
    entries = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in entry.items() if key != "seconds"} for entry in entries]
