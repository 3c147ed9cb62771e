"""A field whose answers are known in closed form and compile in no time: mirror images of a transmitter, their powers added."""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from synthetic import tiny_dataset

from wbgs_jax._util.pytree import pytree, static
from wbgs_jax.fields import Field, Observation
from wbgs_jax.radio.array import beams_of, covariance_to_pas, planar_array, steering_vector
from wbgs_jax.radio.channel import decibels

BEAMS = beams_of(planar_array())


@pytree
class MirrorsField(Field):
    """Powers from a transmitter and its images in a floor, a ceiling and two walls; no fringes."""

    config: Any = static(default=None)
    images: int = static(default=5)

    name: ClassVar[str] = "mirrors"
    gives: ClassVar = ("pas", "snapshots", "power")

    def init(self, key):
        return {"loss": jnp.float32(0.5)}

    def plan(self, params, receiver, limits=None, cache=None):
        return receiver

    def anywhere(self, params):
        return self, params

    def render(self, params, plan, query):
        sign = jnp.array([[1, 1, 1], [1, 1, -1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]], jnp.float32)
        offset = jnp.array([[0, 0, 0], [0, 0, 0], [0, 0, 5.6], [0, 5.0, 0], [6.0, 0, 0]], jnp.float32)
        away = query.tx_position[:, None] * sign + offset - plan.position
        away, strength = away[:, : self.images], jnp.array([1.0, *[params["loss"]] * 4])[: self.images]
        distance = jnp.linalg.norm(away, axis=-1)
        power = (strength / distance) ** 2 / query.frequency_hz[:, None] * 1e9
        waves = steering_vector(jnp.asarray(planar_array(), jnp.float32), away / distance[..., None])
        weighted = waves * (power / power.sum(-1, keepdims=True))[..., None] / 16
        covariance = jnp.einsum("bke,bkf->bef", weighted, waves.conj())
        pas = covariance_to_pas(covariance, BEAMS)
        return Observation(pas, waves[:, 0], decibels(power.sum(-1)), covariance)


@dataclass(frozen=True)
class Trained:
    """A field and its data."""

    field: Field
    params: Any

    def dataset(self):
        return tiny_dataset()

    def origin(self):
        return {}

    neighbours = confidence = power_confidence = None


def trained(images=5) -> Trained:
    field = MirrorsField(images=images)
    return Trained(field, field.init(jax.random.key(0)))
