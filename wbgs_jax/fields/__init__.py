"""The models, one file each, behind one small interface.

A field is a module of pure functions

    init(key, surface, config, capacity=None)                  -> params  a pytree with `gaussians` (density control)
    plan(params, receiver, capacity=None, means2d_offset=None) -> plan    with `geometry.jobs` (overflow); query-independent
    render(params, plan, query)                            -> PAS (b, 90, 360)

Trainer, evaluation and experiments know nothing else about a model.
"""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Float, Key

from wbgs_jax.errors import UserError
from wbgs_jax.fields import wideband
from wbgs_jax.splat import Capacity
from wbgs_jax.types import Query, Receiver, Surface


@runtime_checkable
class Field(Protocol):
    """The seam between models and everything else."""

    def init(self, key: Key[Array, ""], surface: Surface, config: Any, capacity: int | None = None) -> Any: ...

    def plan(
        self,
        params: Any,
        receiver: Receiver,
        capacity: Capacity | None = None,
        means2d_offset: Float[Array, "n 2"] | None = None,
    ) -> Any: ...

    def render(self, params: Any, plan: Any, query: Query) -> Float[Array, "b 90 360"]: ...


FIELDS: dict[str, Field] = {"wideband": wideband}


def get_field(name: str) -> Field:
    """The field of a name; an unknown one is a `UserError`."""
    if name not in FIELDS:
        raise UserError(f"unknown field {name!r}; choose one of: {', '.join(FIELDS)}")
    return FIELDS[name]
