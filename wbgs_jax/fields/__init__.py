"""The models, one file each, with a common interface (`base.Field`). docs/new_field.md shows how to write another."""

from wbgs_jax.fields import coherent, hybrid, nerf2, wideband, wrfgs
from wbgs_jax.fields.base import (
    Aux,
    Field,
    Group,
    Observation,
    default_field,
    field_names,
    get_field,
    pas,
    register,
)
from wbgs_jax.fields.losses import image_loss
from wbgs_jax.fields.networks import frequency_encoding, positional_encoding

__all__ = [
    "Aux",
    "Field",
    "Group",
    "Observation",
    "coherent",
    "default_field",
    "field_names",
    "frequency_encoding",
    "get_field",
    "hybrid",
    "image_loss",
    "nerf2",
    "pas",
    "positional_encoding",
    "register",
    "wideband",
    "wrfgs",
]
