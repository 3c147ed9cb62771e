"""Asking a trained field: as a pure function of (transmitter, frequency), or about the links of a dataset."""

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int

from wbgs_jax._util.devices import Devices, own_devices, spread
from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.splits import group_transmitters
from wbgs_jax.fields import Field, Observation, base
from wbgs_jax.fields.base import outputs_of
from wbgs_jax.inference.kriging import Beside, correct, for_receiver
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.radio.array import PAS_SHAPE
from wbgs_jax.types import Links, Query, Receiver, check_query

BLOCK = 16
"""Queries rendered at a time: they share the footprints; more cost memory and, on a CPU, gain nothing."""

PREPARED = 8192
"""Queries whose transmitters' paths are in memory at a time."""

Predictor = Callable[[Any, Any], Array]
"""(tx_position (*b, 3) metres, frequency_hz (*b,)) -> PAS (*b, 90, 360) or power (*b,); leading axes broadcast like NumPy's."""


def predictor(trained: TrainedField, receiver: Receiver | None = None) -> Predictor:
    """Returns a trained field as a pure function (tx_position, frequency_hz) -> PAS, for `jit`, `vmap` and one reverse-mode
    `grad`.

    What does not depend on the query is planned here, once, for the receiver (default: the first of the data the field was
    trained on, which are read for it; for one that it was not trained on, `at_receiver` comes first). Compiles for every new
    number of queries; `batching.predict_many` keeps that number fixed.
    """
    receiver = trained.dataset().receiver() if receiver is None else receiver
    plan, neighbours = trained.field.plan(trained.params, receiver), for_receiver(trained.neighbours, receiver)
    return OnAnyShape(_Shared("pas", (trained.field, trained.params, plan), (neighbours,)))


def power_predictor(trained: TrainedField, receiver: Receiver | None = None) -> Predictor:
    """Returns a trained field as a pure function (tx_position, frequency_hz) -> received power relative to the transmitted
    power (dB); otherwise as `predictor`.

    Raises:
        UserError: the field knows nothing of power, or its data were spectra without a scale.
    """
    dataset = trained.dataset()
    check_power(trained.field, dataset)
    plan = trained.field.plan(trained.params, dataset.receiver() if receiver is None else receiver)
    return OnAnyShape(_Shared("power_db", (trained.field, trained.params, plan)))


def check_spectra(field: Field, dataset: Dataset) -> None:
    """Raises a `UserError` where a field learned nothing of spectra."""
    if not dataset.has_spectra and "paths" not in outputs_of(field):
        raise UserError(
            f"{dataset.name} holds {dataset.observed.words}, from which the {field.name} field learned no spectra; "
            "ask for --what power"
        )


def check_power(field: Field, dataset: Dataset) -> None:
    """Raises a `UserError` where a field cannot say what power a receiver gets."""
    if "power" not in outputs_of(field):
        raise UserError(f"the {field.name} field has no power, only spectra; train another field")
    if not dataset.has_scale and "paths" not in outputs_of(field):
        raise UserError(
            f"the spectra of {dataset.name} have no scale, so that the {field.name} field learned no power from them"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Shared:
    """A function of a query, which stands between other arguments of one of `RENDER`. Several devices divide more than `BLOCK`
    queries, if that goes evenly and nobody differentiates, transforms or compiles them. It can be pickled, which neither
    closures nor compiled functions can be."""

    quantity: str
    before: tuple[Any, ...]
    after: tuple[Any, ...] = ()

    def __call__(self, query: Query) -> Any:
        devices, render = own_devices(), RENDER[self.quantity]
        count, traced = query.frequency_hz.shape[0], isinstance(query.tx_position, jax.core.Tracer)
        if devices.count == 1 or count <= BLOCK or count % devices.count or traced:
            return render(*self.before, query, *self.after)
        *known, beside = devices.kept(*self.before, self.after)
        return _divided(*known, query, beside, render, devices.mesh)


@partial(jax.jit, static_argnums=(5, 6))
def _divided(
    field: Field, params: Any, plan: Any, query: Query, beside: tuple[Any, ...], render: Callable[..., Any], mesh: Mesh
) -> Any:
    def own(query: Query, field: Field, params: Any, plan: Any, beside: tuple[Any, ...]) -> Any:
        return render(field, params, plan, query, *beside)

    return spread(own, mesh, divided=0)(query, field, params, plan, beside)


@jax.jit
def _render_power(field: Field, params: Any, plan: Any, query: Query) -> Float[Array, " b"]:
    power = field.render(params, plan, query).power_db
    assert power is not None  # `check_power`
    return power


@jax.jit
def render_pas(field: Field, params: Any, plan: Any, query: Query, neighbours: Beside = None) -> Float[Array, "b 90 360"]:
    """Returns the spectra of B queries; fields of equal shapes share one compilation."""
    return correct(neighbours, field.render(params, plan, query).pas, query)


RENDER: dict[str, Callable[..., Any]] = {"pas": render_pas, "power_db": _render_power}
"""Compiled functions of field, parameters, plan and query, by what they return."""


@partial(jax.jit, static_argnames=("quantity", "mesh"))
def _observe(
    field: Field,
    params: Any,
    plan: Any,
    neighbours: Beside,
    links: Links,
    quantity: str | None,
    mesh: Mesh | None,
) -> Any:
    def own(links: Links, field: Field, params: Any, plan: Any, neighbours: Beside) -> Any:
        seen = field.render(params, plan, links)
        seen = seen._replace(pas=correct(neighbours, seen.pas, links.query), paths=None)
        return getattr(seen, quantity) if quantity else seen

    return spread(own, mesh, divided=0)(links, field, params, plan, neighbours)


@dataclasses.dataclass(frozen=True, eq=False)
class OnAnyShape:
    """Lets a function of a flat batch of queries, to a tree of arrays with a leading axis for them, take positions (*b, 3) and
    frequencies (*b,) whose leading axes broadcast."""

    render: Callable[[Query], Any]

    def __call__(self, tx_position: Any, frequency_hz: Any) -> Any:
        position, frequency = jnp.asarray(tx_position, jnp.float32), jnp.asarray(frequency_hz, jnp.float32)
        if position.shape[-1:] != (3,):
            raise ValueError(f"tx_position has shape {position.shape}; expected (3,) or (..., 3)")
        shape = jnp.broadcast_shapes(position.shape[:-1], frequency.shape)
        position, frequency = jnp.broadcast_to(position, (*shape, 3)), jnp.broadcast_to(frequency, shape)
        query = Query(position.reshape(-1, 3), frequency.reshape(-1))
        check_query(query)
        if 0 in shape:
            one = Query(jnp.zeros((1, 3)), jnp.ones(1))
            return jax.tree.map(lambda leaf: jnp.zeros((*shape, *leaf.shape[1:]), leaf.dtype), jax.eval_shape(self.render, one))
        return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), self.render(query))


def observe_links(field: Field, params: Any, dataset: Dataset, index: Int[np.ndarray, " n"]) -> Observation:
    """Returns what a field says of some of a dataset's links, as NumPy arrays in their order.

    What it can know of links beforehand is prepared once; links are rendered in blocks of one shape, receiver by receiver.
    Several devices divide every block.
    """
    links, devices = dataset.links(index), _devices(len(index))
    prepared = field.prepare(links, dataset.receivers)

    def answers() -> Iterator[tuple[Int[np.ndarray, " k"], Observation]]:
        for number in np.unique(dataset.receiver_index[index]):
            plan = field.plan(params, dataset.receiver(int(number)), prepared)
            of_receiver = np.flatnonzero(dataset.receiver_index[index] == number)
            known = devices.replicated((field, params, plan))
            for block, filled in _blocks(of_receiver, BLOCK * devices.count):
                yield block, _observe(*known, None, _taken(links, filled), None, devices.mesh)

    return _gathered(answers(), len(index))


def observe_queries(trained: TrainedField, receiver: Receiver, query: Query, quantity: str | None = None) -> Any:
    """Returns what a trained field says of any number of queries, as NumPy arrays in their order: an `Observation`, its spectra
    with what the neighbours say, or one of its quantities by name (nothing else is computed then).

    What is known of a transmitter serves all of its frequencies. Powers have no scale where the data had none (`check_power`).
    Several devices divide the queries.
    """
    field, params, neighbours = trained.field, trained.params, for_receiver(trained.neighbours, receiver)
    count = len(query.frequency_hz)
    devices = _devices(count)
    tx_index = jnp.asarray(group_transmitters(np.asarray(query.tx_position)), jnp.int32)
    links = Links(query, jnp.zeros(count, jnp.int32), tx_index)

    def answers() -> Iterator[tuple[Int[np.ndarray, " k"], Any]]:
        for start in range(0, count, PREPARED):
            some = np.arange(start, min(start + PREPARED, count))
            prepared = field.prepare(_taken(links, some), jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], receiver))
            plan = field.plan(params, receiver, prepared)
            known = devices.replicated((field, params, plan, neighbours))
            for block, filled in _blocks(some, min(BLOCK, count) * devices.count):
                yield block, _observe(*known, _taken(links, filled), quantity, devices.mesh)

    return _gathered(answers(), count)


def _devices(count: int) -> Devices:
    """Returns the devices that divide so many queries: of a block's worth there is nothing to divide."""
    return own_devices() if count > BLOCK else Devices()


def _gathered(answers: Iterator[tuple[Int[np.ndarray, " k"], Any]], count: int) -> Any:
    """Returns blocks of answers, each with the places they belong to and perhaps filled beyond, as arrays in order; of no
    queries, no spectra."""
    total: Any = None
    for place, seen in answers:
        if total is None:
            total = jax.tree.map(lambda leaf: np.empty((count, *leaf.shape[1:]), leaf.dtype), seen)
        for own, new in zip(jax.tree.leaves(total), jax.tree.leaves(seen), strict=True):
            own[place] = np.asarray(new)[: len(place)]
    return Observation(jnp.zeros((0, *PAS_SHAPE))) if total is None else total


def _taken(links: Links, index: Int[np.ndarray, " k"]) -> Links:
    return jax.tree.map(lambda leaf: leaf[index], links)


def _blocks(numbers: Int[np.ndarray, " n"], size: int) -> Iterator[tuple[Int[np.ndarray, " k"], Int[np.ndarray, " size"]]]:
    """Gives numbers block by block, and each filled up to one size with its last one: one compilation."""
    for start in range(0, len(numbers), max(size, 1)):
        block = numbers[start : start + size]
        yield block, np.concatenate([block, np.repeat(block[-1:], size - len(block))])


def observe(trained: TrainedField, dataset: Dataset, index: Int[np.ndarray, " n"]) -> Observation:
    """Returns what `observe_links` does, the spectra with what the neighbours say."""
    seen = observe_links(trained.field, trained.params, dataset, index)
    if dataset.n_receivers > 1:
        return seen
    neighbours = for_receiver(trained.neighbours, dataset.receiver())
    return seen._replace(pas=jnp.asarray(corrected(neighbours, np.asarray(seen.pas), dataset, index)))


def corrected(
    neighbours: Beside, pas: Float[np.ndarray, "n 90 360"], dataset: Dataset, index: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 90 360"]:
    """Returns predicted spectra of some of a dataset's links with what the neighbours say."""
    if neighbours is None:
        return pas
    return np.concatenate([_correct(neighbours, pas[block], dataset.query(index[block])) for block in _slices(len(index))])


_correct = jax.jit(correct)


def predict_spectra(field: Field, params: Any, dataset: Dataset, index: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 90 360"]:
    """Returns the predicted spectra (float32) of some of a dataset's links."""
    return np.asarray(observe_links(field, params, dataset, index).pas)


def as_observed(field: Field, params: Any, pas: Float[np.ndarray, "n 90 360"]) -> Float[np.ndarray, "n 90 360"]:
    """Returns what a field says as it would appear in its training data (host): what noise adds is no error of the field."""
    seen = [np.asarray(base.as_observed(field, params, jnp.asarray(pas[block]))) for block in _slices(len(pas))]
    return np.concatenate(seen or [pas])


def _slices(count: int) -> list[slice]:
    """Returns blocks of so many spectra that are there already."""
    return [slice(start, start + BLOCK) for start in range(0, count, BLOCK)]


def trained_band(dataset: Dataset) -> tuple[float, float]:
    """Returns the lowest and the highest frequency (hertz) of the training links."""
    frequencies = dataset.frequencies_hz[dataset.train]
    return float(frequencies.min()), float(frequencies.max())
