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

    def init(self, key):
        return {"level": 0.1 * jax.random.normal(key, (4,)), "tilt": jnp.zeros(3)}

    def plan(self, params, receiver, limits=None, cache=None):
        return receiver.position

    def render(self, params, plan, query):
        ripples = jnp.cos(jnp.arange(4)[:, None] * jnp.linspace(-jnp.pi, jnp.pi, 360))
        brightness = (query.tx_position - plan) @ params["tilt"]
        rows = jax.nn.sigmoid(params["level"] @ ripples + brightness[:, None])
        return Observation(jnp.broadcast_to(rows[:, None], (len(rows), 90, 360)))

    @classmethod
    def groups(cls, config):
        return {"all": Group(config.learning_rate)}


@pytree
class NoisyField(RippleField):
    """The same, trained on spectra under which noise has put a floor."""

    name: ClassVar[str] = "noisy ripple"

    def as_observed(self, params, pas):
        return jnp.sqrt((pas**2 + 0.3) / 1.3)


@dataclass(frozen=True)
class Room:
    """Limits of `SwellingField`."""

    size: int


@pytree
class SwellingField(RippleField):
    """Needs more room the further its levels are from zero."""

    name: ClassVar[str] = "swelling"

    @staticmethod
    def required(params):
        return jnp.ceil(20 * jnp.max(jnp.abs(params["level"]))).astype(jnp.int32)[None]

    def limits(self, params, receivers):
        return Room(int(self.required(params)[0]))

    def grow(self, limits, required):
        return Room(max(limits.size, int(required[0])) + 10)

    def loss(self, params, cache, batch, limits=None, probe=()):
        loss, aux = super().loss(params, cache, batch, limits, probe)
        required = self.required(params)
        return loss, aux._replace(required=required, overflow=required[0] > limits.size)


@pytree
class CuspField(RippleField):
    """sqrt at zero: its value is finite, its slope is not."""

    name: ClassVar[str] = "cusp"

    def render(self, params, plan, query):
        flat = jnp.sqrt(0 * params["level"][0])
        return Observation(jnp.full((query.frequency_hz.shape[0], 90, 360), 0.5) + flat)


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
    """As `synthetic.tiny_settings`, of a toy field without host controls."""
    loop = LoopConfig(epoch_steps=2, evaluate_every=8, evaluate_spectra=2, checkpoint_every=4, keep_checkpoints=2)
    return changed(Settings(RippleConfig(), OptimConfig(steps=8, batch=2, final_fraction=1.0, virtual=0.0), loop), changes)


def metrics_of(folder):
    """Curve entries without the wall-clock time."""
    entries = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in entry.items() if key != "seconds"} for entry in entries]
