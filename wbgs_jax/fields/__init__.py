"""The models, one file each, behind one small interface.

A field is a module of pure functions. What users of a trained field need:

    plan(params, receiver, ...)        -> plan    what is independent of the query
    render(params, plan, query)        -> PAS (b, 90, 360)

What training needs besides:

    STARTS_FROM                        "points" (types.Surface), "mesh" (types.Mesh) or "box" (2, 3)
    init(key, start, config, capacity) -> params  a pytree of floats; with `gaussians` if density control applies
    remember(params, receiver, tx)     -> memory  what can be computed once for all training steps, on the host
    observe(params, memory, ...)       -> Observation of the spectra of a batch
    sizes(params), skeleton(config, sizes)        the shapes of a checkpoint

and of a field that is trained on some directions of every spectrum (`SampledField`), instead of `observe`,

    choose_pixels(params, key)         -> pixels (r,)  which ones
    observe_pixels(params, ...)        -> (b, r)

Trainer, evaluation and experiments know nothing else about a model.
"""

from types import ModuleType
from typing import Any, Literal, Protocol, cast, runtime_checkable

from jaxtyping import Array, Float, Int, Key

from wbgs_jax.errors import UserError
from wbgs_jax.fields import nerf2, wave, wideband, wrfgs
from wbgs_jax.fields.observation import Observation
from wbgs_jax.splat import Capacity
from wbgs_jax.types import Query, Receiver

__all__ = ["FIELDS", "Field", "Observation", "SampledField", "get_field"]


@runtime_checkable
class Field(Protocol):
    """The seam between models and everything else."""

    STARTS_FROM: Literal["points", "mesh", "box"]

    def init(self, key: Key[Array, ""], start: Any, config: Any, capacity: int | None = None) -> Any: ...

    def plan(
        self,
        params: Any,
        receiver: Receiver,
        capacity: Capacity | None = None,
        means2d_offset: Float[Array, "n 2"] | None = None,
    ) -> Any: ...

    def render(self, params: Any, plan: Any, query: Query) -> Float[Array, "b 90 360"]: ...

    def remember(self, params: Any, receiver: Receiver, tx_positions: Float[Array, "tx 3"]) -> Any: ...

    def observe(
        self,
        params: Any,
        memory: Any,
        receiver: Receiver,
        query: Query,
        tx_index: Int[Array, "b"],
        capacity: Capacity | None,
        means2d_offset: Float[Array, "n 2"] | None,
    ) -> Observation: ...

    def sizes(self, params: Any) -> dict[str, int]: ...

    def skeleton(self, config: Any, sizes: dict[str, int]) -> Any: ...


@runtime_checkable
class SampledField(Field, Protocol):
    """A field too slow to train on whole images: a step looks at some pixels (flat indices), the same ones in all spectra."""

    def choose_pixels(self, params: Any, key: Key[Array, ""]) -> Int[Array, "r"]: ...

    def observe_pixels(self, params: Any, receiver: Receiver, query: Query, pixels: Int[Array, "r"]) -> Float[Array, "b r"]: ...


FIELDS: dict[str, ModuleType] = {"wideband": wideband, "wave": wave, "wrfgs": wrfgs, "nerf2": nerf2}


def get_field(name: str) -> Field:
    """The field of a name; an unknown one is a `UserError`."""
    if name not in FIELDS:
        raise UserError(f"unknown field {name!r}; choose one of: {', '.join(FIELDS)}")
    return cast(Field, FIELDS[name])
