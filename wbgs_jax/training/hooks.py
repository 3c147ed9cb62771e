"""Hooks change a field between jitted epochs; the loop treats all of them in the same way.

A field lists its hooks by name (`Field.hooks`); the section of the settings with that name, if there is one, enables or
disables a hook. A hook can accumulate statistics in every step (`statistics`, `probe` and `accumulate` are pure and run inside
the epoch) and change parameters between epochs (`apply` runs on the host). Its `Edit` also defines how values that are stored
for each parameter, such as optimiser moments, are transformed (`map_moments`), since shapes may change.

`ExpertWeights` is the hook that fits mixture weights of the experts of a field to validation links, after the last step.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
import optax
from jaxtyping import Array, Float

from wbgs_jax._util.pytree import replaced
from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params, components_of
from wbgs_jax.fields.losses import COARSE
from wbgs_jax.fields.mixture import (
    ExpertPredictions,
    Mixing,
    coherent_alone,
    floor_of,
    learn_shares,
    nearness,
    observed_predictions,
    reported,
    similarity,
)
from wbgs_jax.radio.channel import NO_PATH_DB
from wbgs_jax.training.batches import TrainingData
from wbgs_jax.types import Batch

Say = Callable[[str], None]
"""Called with a description of every stage of long work; it raises an exception to stop the work."""


def silent(stage: str) -> None:
    """Ignores the description of a stage."""


class Edit(NamedTuple):
    """Result of a hook."""

    params: Params
    statistics: Any
    """The hook's statistics from here on."""
    moments: Callable[[Any], Any] | None
    """Function from a tree like the old parameters to one like the new parameters; None to initialise the optimiser's state
    again."""
    report: dict[str, Any]
    """Entry for metrics.jsonl; nothing is written if it is empty."""
    field: Field | None = None
    """The new field, if the hook has changed it."""
    prepared: Any = None
    """Result of `prepare` of the new field."""
    growth: float = 1.0
    """Factor by which the field needs more capacity than before."""


class Context(NamedTuple):
    """Data that are available to a hook."""

    data: TrainingData
    prepared: Any
    """Result of the field's `prepare`."""
    train: np.ndarray
    """Indices of the training links."""
    say: Say = silent
    validation: Callable[[], list[Batch]] = list
    """Function that returns batches of validation links, each of one receiver."""


class Hook(ABC):
    """A hook: a frozen, hashable object. By default it has no statistics."""

    stream: int
    """Number of its stream of random numbers."""

    def statistics(self, params: Params) -> Any:
        """Returns zeros that are then accumulated over steps; () without statistics."""
        return ()

    def probe(self, params: Params) -> Any:
        """Returns zeros that the field's loss adds to the quantity whose gradient the hook needs; None if it needs none."""
        return None

    def accumulate(self, statistics: Any, gradients: Any, probe: Any) -> Any:
        """Returns the statistics after a step, from the gradients of the parameters and of the probe (pure)."""
        return statistics

    @abstractmethod
    def due(self, step: int, steps: int) -> bool:
        """Returns whether the hook acts after step number `step` of `steps`."""

    @abstractmethod
    def apply(
        self, field: Field, params: Params, statistics: Any, context: Context, step: int, rng: np.random.Generator
    ) -> Edit:
        """Returns the changed parameters, and how stored values follow (host).

        Args:
            field: field.
            params: its parameters.
            statistics: statistics accumulated since the hook last acted.
            context: data.
            step: number of steps done.
            rng: random numbers.
        """

    def next_size(self, params: Params, step: int, steps: int) -> tuple[Any, float] | None:
        """Returns the shapes of parameters that the hook may soon change to (`jax.ShapeDtypeStruct`), and the growth of the
        capacity; None if no change is near after step number `step` of `steps`."""
        return None


def probe_of(hooks: Sequence[Hook], params: Params) -> Any:
    """Returns the probe of the first hook that has one, else None."""
    return next((probe for hook in hooks if (probe := hook.probe(params)) is not None), None)


@dataclass(frozen=True)
class OfPart(Hook):
    """A hook that acts on one component of a field: on the field and the parameters of that name."""

    part: str
    inner: Hook

    @property
    def stream(self) -> int:  # type: ignore[override]
        """Number of its stream of random numbers."""
        return self.inner.stream

    def statistics(self, params: Params) -> Any:
        """Returns the initial statistics of the component; () if the field lacks it."""
        own = getattr(params, self.part)
        return () if own is None else self.inner.statistics(own)

    def probe(self, params: Params) -> Any:
        """Returns the probe of the component; None if the field lacks it."""
        own = getattr(params, self.part)
        return None if own is None else self.inner.probe(own)

    def accumulate(self, statistics: Any, gradients: Any, probe: Any) -> Any:
        """Returns the statistics after a step."""
        own = getattr(gradients, self.part)
        return () if own is None else self.inner.accumulate(statistics, own, probe)

    def due(self, step: int, steps: int) -> bool:
        """Returns whether the hook acts after step number `step` of `steps`."""
        return self.inner.due(step, steps)

    def apply(
        self, field: Field, params: Params, statistics: Any, context: Context, step: int, rng: np.random.Generator
    ) -> Edit:
        """Returns all parameters, with those of the component changed."""
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
        """Returns the shapes of all parameters that the hook may soon change to, and the growth of the capacity, or None."""
        own = getattr(params, self.part)
        found = None if own is None else self.inner.next_size(own, step, steps)
        if found is None:
            return None
        return replaced(jax.eval_shape(lambda tree: tree, params), **{self.part: found[0]}), found[1]


def map_moments(moments: Any, params: Params, function: Callable[[Any], Any]) -> Any:
    """Returns the optimiser's state with a function applied to every tree in it that has the structure of the parameters. In
    the tree of a group, the leaves of all other groups are masked."""
    leaves, structure = jax.tree.flatten(params)
    known: Any = structure

    def alike(value: Any) -> bool:
        own, found = jax.tree.flatten(value, is_leaf=_is_masked)
        same = (_is_masked(a) or (a.shape, a.dtype) == (b.shape, b.dtype) for a, b in zip(own, leaves, strict=False))
        return bool(found == known) and not _is_masked(value) and all(same)

    return jax.tree.map(lambda leaf: function(leaf) if alike(leaf) else leaf, moments, is_leaf=alike)


def _is_masked(node: Any) -> bool:
    return isinstance(node, optax.MaskedNode)


class Seen(NamedTuple):
    """Predictions of the experts for B links, with observations."""

    spectra: ExpertPredictions
    power: ExpertPredictions
    features: Float[Array, "b features"]
    """Features that the mixture weights depend on."""
    pas: Float[Array, "b 90 360"] | None
    power_db: Float[Array, " b"] | None


@dataclass(frozen=True)
class ExpertWeights(Hook):
    """The hook of a `Mixing` field: fits the mixture weights to validation links, which none of its components was trained on.
    For spectra or powers without observations, and without validation links, the coherent field is used alone. The noise floor
    of spectra is estimated as well (`fields.mixture`)."""

    stream: int = 4

    def due(self, step: int, steps: int) -> bool:
        """Returns whether the last step is done."""
        return step >= steps

    def apply(
        self, field: Field, params: Params, statistics: tuple[()], context: Context, step: int, rng: np.random.Generator
    ) -> Edit:
        """Returns the parameters with fitted weights, or unchanged if a component is missing."""
        mixing, same = field.ability(Mixing), Edit(params, (), lambda tree: tree, {})
        if mixing is None or len(components_of(field)) < len(field.components):
            return same
        if not (batches := context.validation()):
            alone = mixing.field.with_shares(mixing.of(params), coherent_alone(), coherent_alone())
            return same._replace(params=mixing.put(params, alone))
        context.say("validation: weights of the coherent and the splatting half")
        raw = mixing.put(params, mixing.field.with_shares(mixing.of(params)))
        receivers = {_receiver_of(batch): batch.receiver for batch in batches}
        plans = {number: field.plan(raw, receiver, context.prepared) for number, receiver in receivers.items()}
        own = {number: mixing.of(plan) for number, plan in plans.items()}
        found = (expert_predictions_of(mixing.field, mixing.of(raw), own[_receiver_of(batch)], batch) for batch in batches)
        seen = [jax.tree.map(np.asarray, one) for one in found]
        predicted, powers, features, pas, measured_db = jax.tree.map(lambda *parts: np.concatenate(parts), *seen)
        tx_index = np.concatenate([np.asarray(batch.links.tx_index) for batch in batches])
        floor, spectra, power = 0.0, coherent_alone(), coherent_alone()
        if pas is not None:
            floor = floor_of(predicted, pas, tx_index)
            spectra = learn_shares(
                features, tx_index, observed_predictions(predicted, floor), partial(similarity, pas, stride=COARSE)
            )
        if measured_db is not None and np.any(measured_db > NO_PATH_DB):
            usual_spread_db = 1.0  # of the difference in error of two experts, over transmitters
            power = learn_shares(features, tx_index, powers, partial(nearness, measured_db), usual_spread_db)
        report = {name: reported(shares, features) for name, shares in (("spectra", spectra), ("power", power))}
        weighted = mixing.field.with_shares(mixing.of(params), spectra, power, floor)
        return same._replace(params=mixing.put(params, weighted), report={"shares": report, "noise_floor": floor})


def _receiver_of(batch: Batch) -> int:
    return int(batch.links.receiver_index[0])


@jax.jit
def expert_predictions_of(field: Mixing, params: Params, plan: Any, batch: Batch) -> Seen:
    """Returns the experts' spectra and received powers of links, the features of their weights, and the observations."""
    spectra, power, features = field.expert_predictions(params, plan, batch.links)
    return Seen(spectra, power, features, batch.pas, batch.received_db)
