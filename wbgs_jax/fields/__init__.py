"""The models, one file each, with a common interface (`base.Field`). docs/new_field.md shows how to write another."""

from wbgs_jax.fields import coherent as wave
from wbgs_jax.fields import hybrid, nerf2, wideband, wrfgs
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

__all__ = [
    "Aux",
    "Field",
    "Group",
    "Observation",
    "default_field",
    "field_names",
    "get_field",
    "hybrid",
    "nerf2",
    "pas",
    "register",
    "wave",
    "wideband",
    "wrfgs",
]
