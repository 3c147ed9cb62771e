"""Hooks: what is done to a field between jitted epochs. All are alike to the loop.

A field asks for hooks by name (`Field.hooks`); the settings section of that name, if there is one, switches it on or off. A
hook may watch every step (`statistics`, `probe` and `accumulate` are pure and run inside the epoch) and change parameters
between epochs (`apply` runs on the host). It says how whatever is stored beside the parameters, such as optimiser moments,
follows.

What an optimiser stores beside the parameters, when these change their shapes.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
import optax

from wbgs_jax._util.pytree import replaced
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params
from wbgs_jax.training.batches import TrainingData
from wbgs_jax.types import Batch

Say = Callable[[str], None]
"""Told what long work turns to next; raises where it is to stop."""


def silent(stage: str) -> None:
    """Tells nobody."""


class Edit(NamedTuple):
    """What a hook did."""

    params: Params
    statistics: Any
    """What the hook has watched, from here on."""
    moments: Callable[[Any], Any] | None
    """From a tree like the old parameters to one like the new ones; None: whatever was stored starts anew."""
    report: dict[str, Any]
    """For metrics.jsonl; nothing is written if it is empty."""
    field: Field | None = None
    """The field where it is another one now, ..."""
    prepared: Any = None
    """... and what it knows of the links."""
    growth: float = 1.0
    """How much more room the field needs than before."""


class Context(NamedTuple):
    """What a hook may look at."""

    data: TrainingData
    prepared: Any
    """Of the field's `prepare`."""
    train: np.ndarray
    """Indices of the training links."""
    say: Say = silent
    validation: Callable[[], list[Batch]] = list
    """Returns batches of validation links, each of one receiver."""


class Hook(ABC):
    """A hook: a frozen, hashable object. By default it watches no step."""

    stream: int
    """Number of its stream of random numbers."""

    def statistics(self, params: Params) -> Any:
        """Returns zeros, to be accumulated over steps; () if it watches nothing."""
        return ()

    def probe(self, params: Params) -> Any:
        """Returns zeros that the field's loss is to add where the hook wants to know the gradient; None: nowhere."""
        return None

    def accumulate(self, statistics: Any, gradients: Any, probe: Any) -> Any:
        """Returns the statistics after a step, from the gradients of the parameters and of the probe (pure)."""
        return statistics

    @abstractmethod
    def due(self, step: int, steps: int) -> bool:
        """Returns whether something is to be done after this step of so many."""

    @abstractmethod
    def apply(
        self, field: Field, params: Params, statistics: Any, context: Context, step: int, rng: np.random.Generator
    ) -> Edit:
        """Returns the changed parameters."""

    def next_size(self, params: Params, step: int, steps: int) -> tuple[Any, float] | None:
        """Returns parameters of the shapes that the hook may soon change to, as `jax.ShapeDtypeStruct`s, and that growth;
        None where nothing is near after this step of so many."""
        return None


def probe_of(hooks: Sequence[Hook], params: Params) -> Any:
    """Returns the probe of the first hook that has one; None if none has."""
    return next((probe for hook in hooks if (probe := hook.probe(params)) is not None), None)


@dataclass(frozen=True)
class OfPart(Hook):
    """A hook of one component of a field: of its field and parameters of that name."""

    part: str
    inner: Hook

    @property
    def stream(self) -> int:  # type: ignore[override]
        """Number of its stream of random numbers."""
        return self.inner.stream

    def statistics(self, params: Params) -> Any:
        """Returns zeros, to be accumulated over steps; () where there is no such component."""
        own = getattr(params, self.part)
        return () if own is None else self.inner.statistics(own)

    def probe(self, params: Params) -> Any:
        """Returns that of the component."""
        own = getattr(params, self.part)
        return None if own is None else self.inner.probe(own)

    def accumulate(self, statistics: Any, gradients: Any, probe: Any) -> Any:
        """Returns the statistics after a step."""
        own = getattr(gradients, self.part)
        return () if own is None else self.inner.accumulate(statistics, own, probe)

    def due(self, step: int, steps: int) -> bool:
        """Returns whether something is to be done after this step of so many."""
        return self.inner.due(step, steps)

    def apply(
        self, field: Field, params: Params, statistics: Any, context: Context, step: int, rng: np.random.Generator
    ) -> Edit:
        """Returns all parameters, those of the component changed."""
        own = getattr(params, self.part)
        if own is None:
            return Edit(params, statistics, lambda tree: tree, {})
        edit = self.inner.apply(getattr(field, self.part), own, statistics, context, step, rng)

        def put(tree: Any, value: Any) -> Any:
            return replaced(tree, **{self.part: value})

        follow = edit.moments
        moments = None if follow is None else lambda tree: put(tree, follow(getattr(tree, self.part)))
        whole = None if edit.field is None else put(field, edit.field)
        return edit._replace(params=put(params, edit.params), moments=moments, field=whole)

    def next_size(self, params: Params, step: int, steps: int) -> tuple[Any, float] | None:
        """Returns the shapes of all parameters that the hook may soon change to, and that growth."""
        own = getattr(params, self.part)
        found = None if own is None else self.inner.next_size(own, step, steps)
        if found is None:
            return None
        return replaced(jax.eval_shape(lambda tree: tree, params), **{self.part: found[0]}), found[1]


def map_moments(moments: Any, params: Params, function: Callable[[Any], Any]) -> Any:
    """Returns the optimiser's state with every tree in it that is like the parameters transformed. In the tree of a group the
    leaves of all others are masked."""
    leaves, structure = jax.tree.flatten(params)
    known: Any = structure

    def alike(value: Any) -> bool:
        own, found = jax.tree.flatten(value, is_leaf=_is_masked)
        same = (_is_masked(a) or (a.shape, a.dtype) == (b.shape, b.dtype) for a, b in zip(own, leaves, strict=False))
        return bool(found == known) and not _is_masked(value) and all(same)

    return jax.tree.map(lambda leaf: function(leaf) if alike(leaf) else leaf, moments, is_leaf=alike)


def _is_masked(node: Any) -> bool:
    return isinstance(node, optax.MaskedNode)
