"""A field whose answers are known in closed form and compile in no time: mirror images of a transmitter, their powers added."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from builders.synthetic import tiny_dataset
from builders.toys import as_trained
from wbgs_jax._util.pytree import pytree, static
from wbgs_jax.fields import Field, Observation
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.propagation.paths import REFLECTED
from wbgs_jax.radio.array import covariance_to_pas, make_lag_basis, planar_array, steering_vector
from wbgs_jax.radio.channel import Paths, decibels

BEAMS = make_lag_basis(planar_array())


@pytree
class MirrorsField(Field):
    """Powers from a transmitter and its images in a floor, a ceiling and two walls; no fringes."""

    config: Any = static(default=None)
    images: int = static(default=5)

    name: ClassVar[str] = "mirrors"
    outputs: ClassVar = ("pas", "snapshots", "power", "paths")

    @classmethod
    def build(cls, config, scene, seed):
        return cls(config)

    def init(self, key):
        return {"loss": jnp.float32(0.5)}

    def plan(self, params, receiver, prepared=None, capacity=None):
        return receiver

    def receiver_independent(self, params):
        return self, params

    def waves(self, params, plan, query):
        """Ways to the images, (b, images, 3), and powers."""
        sign = jnp.array([[1, 1, 1], [1, 1, -1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]], jnp.float32)
        offset = jnp.array([[0, 0, 0], [0, 0, 0], [0, 0, 5.6], [0, 5.0, 0], [6.0, 0, 0]], jnp.float32)
        away = query.tx_position[:, None] * sign + offset - plan.position
        away, strength = away[:, : self.images], jnp.array([1.0, *[params["loss"]] * 4])[: self.images]
        distance = jnp.linalg.norm(away, axis=-1)
        return away, (strength / distance) ** 2 / query.frequency_hz[:, None] * 1e9

    def render(self, params, plan, query):
        away, power = self.waves(params, plan, query)
        distance = jnp.linalg.norm(away, axis=-1)
        waves = steering_vector(jnp.asarray(planar_array(), jnp.float32), away / distance[..., None])
        weighted = waves * (power / power.sum(-1, keepdims=True))[..., None] / 16
        covariance = jnp.einsum("bke,bkf->bef", weighted, waves.conj())
        pas = covariance_to_pas(covariance, BEAMS)
        amplitude = jnp.sqrt(power).astype(jnp.complex64)
        polarised = jnp.stack([amplitude, 0 * amplitude], -1)
        met = jnp.zeros((*distance.shape, 5), jnp.int32).at[:, 1:, 0].set(REFLECTED)
        paths = Paths(amplitude, away / distance[..., None], distance, polarised=polarised, interaction=met)
        return Observation(pas, waves[:, 0], decibels(power.sum(-1)), covariance, paths)


class Mirrored(TrainedField):
    """A field of mirrors and its data."""

    def dataset(self):
        return tiny_dataset()


def trained_field(field: Field, params: Any) -> TrainedField:
    """Returns a field of mirrors as a trained one."""
    return as_trained(field, params, Mirrored)


def trained(images=5) -> TrainedField:
    field = MirrorsField(images=images)
    return trained_field(field, field.init(jax.random.key(0)))


class Blind(MirrorsField):
    """One that knows no paths."""

    outputs: ClassVar = ("pas", "snapshots", "power")
