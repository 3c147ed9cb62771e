"""Predictions of a trained field: as a pure function of transmitter and frequency, for the links of a dataset, or
for lists and maps of transmitters, in blocks of one compiled shape."""

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
from wbgs_jax.data.dataset import Dataset, group_transmitters
from wbgs_jax.fields import Field, Observation, base
from wbgs_jax.fields.base import Params, Prepared, outputs_of
from wbgs_jax.inference.kriging import Beside, correct, for_receiver
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.radio.array import PAS_SHAPE
from wbgs_jax.types import Links, Query, Receiver, Transmitter, check_query

BLOCK = 16
"""Queries rendered at a time, with common footprints; larger blocks need more memory and are not faster on a CPU."""

PREPARED = 8192
"""Queries whose paths are kept in memory at a time."""

Predictor = Callable[[Any, Any], Array]
"""(tx_position (*b, 3) metres, frequency_hz (*b,)) -> PAS (*b, 90, 360) or power (*b,); leading axes broadcast like NumPy's."""


def make_predictor(trained: TrainedField, receiver: Receiver | None = None) -> Predictor:
    """Returns a trained field as a pure function (tx_position, frequency_hz) -> PAS, which supports `jit`, `vmap` and one
    reverse-mode `grad`.

    The part of the computation that does not depend on the query is done here, once for the receiver. The default is the first
    receiver of the training data, which are read to obtain it; for a receiver that is not in the training data, call
    `at_receiver` first. The function is compiled for every new number of queries; `predict_many` keeps that number
    fixed.

    Args:
        trained: a trained field.
        receiver: by default the first one of the training data.

    Returns:
        The function; for positions (b, 3) or (3,) in metres and frequencies in hertz it returns spectra (b, 90, 360) or (90,
        360).

    Example:
        >>> predict = make_predictor(load_trained("runs/try"))  # doctest: +SKIP
        >>> predict([1.0, 0.5, 1.5], [2.4e9, 28e9]).shape  # doctest: +SKIP
        (2, 90, 360)
    """
    receiver = trained.dataset().receiver() if receiver is None else receiver
    plan, neighbours = trained.field.plan(trained.params, receiver), for_receiver(trained.correction, receiver)
    return OnAnyShape(_Shared("pas", (trained.field, trained.params, plan), (neighbours,)))


def make_power_predictor(trained: TrainedField, receiver: Receiver | None = None) -> Predictor:
    """Returns a trained field as a pure function (tx_position, frequency_hz) -> received power relative to the transmitted
    power (dB); otherwise as `make_predictor`.

    Args:
        trained: a trained field.
        receiver: by default the first one of the training data.

    Returns:
        The function; powers (b,) in decibels for positions (b, 3) in metres and frequencies in hertz, or () for one position.
        The received power in dBm is the sum of this and the transmitted power in dBm.

    Raises:
        UserError: the field does not predict power, or was trained on spectra, which have no scale.
    """
    dataset = trained.dataset()
    check_power(trained.field, dataset)
    plan = trained.field.plan(trained.params, dataset.receiver() if receiver is None else receiver)
    return OnAnyShape(_Shared("power_db", (trained.field, trained.params, plan)))


def check_spectra(field: Field, dataset: Dataset) -> None:
    """Raises a `UserError` if a field could not learn spectra from the data."""
    if not dataset.has_spectra and "paths" not in outputs_of(field):
        raise UserError(
            f"{dataset.name} contains {dataset.observed.words}, from which the {field.name} field learned no spectra; "
            "use --what power"
        )


def check_power(field: Field, dataset: Dataset) -> None:
    """Raises a `UserError` if a field cannot predict received power."""
    if "power" not in outputs_of(field):
        raise UserError(f"the {field.name} field does not predict power, only spectra; train another field")
    if not dataset.has_scale and "paths" not in outputs_of(field):
        raise UserError(
            f"the spectra of {dataset.name} have no scale, so the {field.name} field could not learn power from them"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Shared:
    """One of the functions of `RENDER` with all arguments except the query bound. More than `BLOCK` queries are divided among
    several devices if the division is even and the call is not being differentiated, transformed or compiled. Unlike closures
    and compiled functions, it can be pickled."""

    quantity: str
    before: tuple[Any, ...]
    after: tuple[Any, ...] = ()

    def __call__(self, query: Query) -> Any:
        devices, render = own_devices(), RENDER[self.quantity]
        count, traced = query.frequency_hz.shape[0], isinstance(query.tx_position, jax.core.Tracer)
        if devices.count == 1 or count <= BLOCK or count % devices.count or traced:
            return render(*self.before, query, *self.after)
        *first, last = devices.kept(*self.before, self.after)
        return _divided(*first, query, last, render, devices.mesh)


@partial(jax.jit, static_argnums=(5, 6))
def _divided(
    field: Field, params: Params, plan: Any, query: Query, beside: tuple[Any, ...], render: Callable[..., Any], mesh: Mesh
) -> Any:
    def own(query: Query, field: Field, params: Params, plan: Any, beside: tuple[Any, ...]) -> Any:
        return render(field, params, plan, query, *beside)

    return spread(own, mesh, divided=0)(query, field, params, plan, beside)


@jax.jit
def _render_power(field: Field, params: Params, plan: Any, query: Query) -> Float[Array, " b"]:
    power = field.render(params, plan, query).power_db
    assert power is not None  # `check_power`
    return power


@jax.jit
def render_pas(field: Field, params: Params, plan: Any, query: Query, neighbours: Beside = None) -> Float[Array, "b 90 360"]:
    """Returns the spectra of B queries; fields of equal shapes share one compilation."""
    return correct(neighbours, field.render(params, plan, query).pas, query)


RENDER: dict[str, Callable[..., Any]] = {"pas": render_pas, "power_db": _render_power}
"""Compiled functions of field, parameters, plan and query, by the quantity that they return."""


@partial(jax.jit, static_argnames=("quantity", "mesh"))
def _observe(
    field: Field,
    params: Params,
    plan: Any,
    neighbours: Beside,
    links: Links,
    quantity: str | None,
    mesh: Mesh | None,
) -> Any:
    def own(links: Links, field: Field, params: Params, plan: Any, neighbours: Beside) -> Any:
        seen = field.render(params, plan, links)
        seen = seen._replace(pas=correct(neighbours, seen.pas, links), paths=None)
        return getattr(seen, quantity) if quantity else seen

    return spread(own, mesh, divided=0)(links, field, params, plan, neighbours)


@dataclasses.dataclass(frozen=True, eq=False)
class OnAnyShape:
    """Wraps a function of a flat batch of queries, which returns a tree of arrays with a leading axis of queries, so that it
    accepts positions (*b, 3) and frequencies (*b,) whose leading axes broadcast."""

    render: Callable[[Query], Any]

    def __call__(self, tx_position: Any, frequency_hz: Any) -> Any:
        position, frequency = jnp.asarray(tx_position, jnp.float32), jnp.asarray(frequency_hz, jnp.float32)
        if position.shape[-1:] != (3,):
            raise ValueError(f"tx_position has shape {position.shape}; expected (3,) or (..., 3)")
        shape = jnp.broadcast_shapes(position.shape[:-1], frequency.shape)
        position, frequency = jnp.broadcast_to(position, (*shape, 3)), jnp.broadcast_to(frequency, shape)
        query = Query(Transmitter(position.reshape(-1, 3)), frequency.reshape(-1))
        check_query(query)
        if 0 in shape:
            one = Query(Transmitter(jnp.zeros((1, 3), jnp.float32)), jnp.ones(1, jnp.float32))
            return jax.tree.map(lambda leaf: jnp.zeros((*shape, *leaf.shape[1:]), leaf.dtype), jax.eval_shape(self.render, one))
        return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), self.render(query))


Advance = Callable[[int], None]
"""Called with the number of links of every finished block."""


def _unwatched(count: int) -> None:
    """Ignores the progress."""


def observe_links(
    field: Field, params: Params, dataset: Dataset, index: Int[np.ndarray, " n"], advance: Advance = _unwatched
) -> Observation:
    """Returns the predictions of a field for links of a dataset, as NumPy arrays in their order.

    The field prepares the links once (`Field.prepare`); they are rendered in blocks of one shape, receiver by receiver. Every
    block is divided among the devices.
    """
    links, devices = dataset.links(index), _devices(len(index))
    prepared = field.prepare(links, dataset.receivers)

    def answers() -> Iterator[tuple[Int[np.ndarray, " k"], Observation]]:
        for number in np.unique(dataset.receiver_index[index]):
            plan = field.plan(params, dataset.receiver(int(number)), prepared)
            of_receiver = np.flatnonzero(dataset.receiver_index[index] == number)
            known = devices.replicated((field, params))
            for block, filled in _blocks(of_receiver, BLOCK * devices.count):
                some = _taken(links, filled)
                of_block = devices.replicated(_plan_of_block(plan, prepared, some))
                yield block, _observe(*known, of_block, None, some, None, devices.mesh)
                advance(len(block))

    return _gathered(answers(), len(index))


def observe_queries(trained: TrainedField, receiver: Receiver, query: Query, quantity: str | None = None) -> Any:
    """Returns the predictions of a trained field for any number of queries, as NumPy arrays in their order: an `Observation`
    with corrected spectra (`kriging.correct`), or one of its quantities by name (the others are not computed then).

    The preparation for a transmitter is shared by all of its frequencies. Powers have no scale if the training data had none
    (`check_power`). The queries are divided among the devices.
    """
    field, params, neighbours = trained.field, trained.params, for_receiver(trained.correction, receiver)
    count = len(query.frequency_hz)
    devices = _devices(count)
    tx_index = jnp.asarray(group_transmitters(np.asarray(query.tx_position)), jnp.int32)
    links = query.with_indices(jnp.zeros(count, jnp.int32), tx_index)

    def answers() -> Iterator[tuple[Int[np.ndarray, " k"], Any]]:
        for start in range(0, count, PREPARED):
            some = np.arange(start, min(start + PREPARED, count))
            prepared = field.prepare(_taken(links, some), jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], receiver))
            plan = field.plan(params, receiver, prepared)
            known = devices.replicated((field, params))
            for block, filled in _blocks(some, min(BLOCK, count) * devices.count):
                taken = _taken(links, filled)
                of_block = devices.replicated((_plan_of_block(plan, prepared, taken), neighbours))
                yield block, _observe(*known, *of_block, taken, quantity, devices.mesh)

    return _gathered(answers(), count)


def _plan_of_block(plan: Any, prepared: Any, links: Links) -> Any:
    """Returns a plan that carries only what is prepared for the links of a block: its shapes, and with them the compiled
    program, do not depend on the number of prepared links."""
    if prepared is None:
        return plan
    own = _subset(prepared, links)
    return jax.tree.map(lambda node: own if node is prepared else node, plan, is_leaf=lambda node: node is prepared)


@jax.jit
def _subset(prepared: Prepared, links: Links) -> Any:
    return prepared.subset(links)


def _devices(count: int) -> Devices:
    """Returns the devices among which `count` queries are divided; a single block is not divided."""
    return own_devices() if count > BLOCK else Devices()


def _gathered(answers: Iterator[tuple[Int[np.ndarray, " k"], Any]], count: int) -> Any:
    """Returns blocks of predictions, each with its indices and possibly padded, as arrays in order; without queries, an
    `Observation` of zero spectra."""
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
    """Yields blocks of numbers, each also padded to the same size with its last number, so that one compilation suffices."""
    for start in range(0, len(numbers), max(size, 1)):
        block = numbers[start : start + size]
        yield block, np.concatenate([block, np.repeat(block[-1:], size - len(block))])


def observe(
    trained: TrainedField, dataset: Dataset, index: Int[np.ndarray, " n"], advance: Advance = _unwatched
) -> Observation:
    """Returns the same as `observe_links`, with spectra corrected by residual kriging or a mixture (one receiver only)."""
    seen = observe_links(trained.field, trained.params, dataset, index, advance)
    if dataset.n_receivers > 1:
        return seen
    neighbours = for_receiver(trained.correction, dataset.receiver())
    return seen._replace(pas=jnp.asarray(corrected(neighbours, np.asarray(seen.pas), dataset, index)))


def corrected(
    neighbours: Beside, pas: Float[np.ndarray, "n 90 360"], dataset: Dataset, index: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 90 360"]:
    """Returns the corrected spectra (`kriging.correct`) of links of a dataset, from the predicted ones."""
    if neighbours is None:
        return pas
    return np.concatenate([_correct(neighbours, pas[block], dataset.query(index[block])) for block in _slices(len(index))])


_correct = jax.jit(correct)


def predict_spectra(
    field: Field, params: Params, dataset: Dataset, index: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 90 360"]:
    """Returns the predicted spectra (float32) of links of a dataset."""
    return np.asarray(observe_links(field, params, dataset, index).pas)


def as_observed(field: Field, params: Params, pas: Float[np.ndarray, "n 90 360"]) -> Float[np.ndarray, "n 90 360"]:
    """Returns predicted spectra as they would appear in the training data (host), so that noise does not count as an error."""
    seen = [np.asarray(base.as_observed(field, params, jnp.asarray(pas[block]))) for block in _slices(len(pas))]
    return np.concatenate(seen or [pas])


def _slices(count: int) -> list[slice]:
    """Returns slices of `BLOCK` rows that cover `count` rows."""
    return [slice(start, start + BLOCK) for start in range(0, count, BLOCK)]


def trained_band(dataset: Dataset) -> tuple[float, float]:
    """Returns the lowest and the highest frequency (hertz) of the training links."""
    frequencies = dataset.frequencies_hz[dataset.train]
    return float(frequencies.min()), float(frequencies.max())


def predict_blocks(
    predict: Predictor, tx_positions: Any, frequencies_hz: Any, block: int = BLOCK
) -> Iterator[Float[np.ndarray, " k *answer"]]:
    """Yields the spectra or powers (float32) of n queries in order, in blocks, so that the results need not fit in memory.

    Positions are (n, 3) in metres; frequencies are (n,) or a single one in hertz. All blocks are evaluated with the same shape,
    so that one compilation suffices. A block has `block` queries per device; `make_predictor` divides it among the devices.

    Args:
        predict: from `make_predictor`, `make_power_predictor` or `load_exported`.
        tx_positions: (n, 3), world frame, metres.
        frequencies_hz: (n,) or one, hertz.
        block: queries per device that are evaluated at once.

    Yields:
        Arrays (k, 90, 360) or (k,), at most `block` queries per device in each.

    Raises:
        ValueError: the shapes of positions and frequencies do not match, or `block` is less than 1.
    """
    if block < 1:
        raise ValueError(f"block is {block}; give at least 1 query per device")
    positions = _positions(tx_positions)
    frequencies = np.broadcast_to(np.asarray(frequencies_hz, np.float32), len(positions))
    n, block = len(positions), block * own_devices().count

    def part(start: int) -> Float[np.ndarray, " k *answer"]:
        index = np.minimum(np.arange(start, start + block), n - 1)  # the last block is filled up with copies of the last query
        return np.asarray(predict(positions[index], frequencies[index]))[: n - start]

    return map(part, range(0, n, block))  # lazy, but invalid arguments raise an error here


def predict_many(
    predict: Predictor, tx_positions: Any, frequencies_hz: Any, block: int = BLOCK
) -> Float[np.ndarray, " n *answer"]:
    """Returns the blocks of `predict_blocks` as one array.

    Args:
        predict, tx_positions, frequencies_hz, block: as in `predict_blocks`.

    Returns:
        Spectra (n, 90, 360), or powers (n,) in dB, float32.

    Raises:
        ValueError: as in `predict_blocks`.
    """
    n, done = len(_positions(tx_positions)), 0
    answers = None
    for part in predict_blocks(predict, tx_positions, frequencies_hz, block):
        answers = np.empty((n, *part.shape[1:]), np.float32) if answers is None else answers
        answers[done : done + len(part)] = part
        done += len(part)
    return np.asarray(predict(np.zeros((0, 3), np.float32), np.zeros(0, np.float32))) if answers is None else answers


def _positions(tx_positions: Any) -> Float[np.ndarray, "n d"]:
    """Returns positions, of which there may be one or none."""
    positions = np.asarray(tx_positions, np.float32)
    positions = np.atleast_2d(positions) if positions.size else np.zeros((0, 3), np.float32)
    if positions.ndim != 2:
        raise ValueError(f"tx_positions have shape {positions.shape}; expected (n, 3)")
    return positions


def map_queries(
    xs: Any, ys: Any, height: float, frequencies_hz: Any
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Returns the positions (metres) and frequencies (hertz) of a map at one height, with x fastest, then y, then frequency.

    The results of the n = frequencies * ys * xs queries can be reshaped to (frequencies, ys, xs, ...).

    Args:
        xs, ys: coordinates of the columns and of the rows, world frame, metres.
        height: of the transmitters, metres.
        frequencies_hz: one or several, hertz.

    Returns:
        Positions (n, 3) and frequencies (n,).

    Example:
        >>> positions, frequencies = map_queries([0.0, 1.0], [5.0], 1.5, 2.4e9)
        >>> positions.tolist(), frequencies.tolist()
        ([[0.0, 5.0, 1.5], [1.0, 5.0, 1.5]], [2400000000.0, 2400000000.0])
    """
    frequency, y, x = np.meshgrid(np.atleast_1d(frequencies_hz), np.atleast_1d(ys), np.atleast_1d(xs), indexing="ij")
    return np.stack([x, y, np.full(x.shape, height)], -1).reshape(-1, 3).astype(float), frequency.reshape(-1).astype(float)


def predict_map(
    predict: Predictor, xs: Any, ys: Any, height: float, frequencies_hz: Any, block: int = BLOCK
) -> Float[np.ndarray, " n *answer"]:
    """Returns the spectra (float32, 130 kB each) or powers for a map of transmitters, in the order of `map_queries`.

    Args:
        predict, block: as in `predict_blocks`.
        xs, ys, height, frequencies_hz: as in `map_queries`.

    Returns:
        Spectra (frequencies * ys * xs, 90, 360), or powers, float32.
    """
    return predict_many(predict, *map_queries(xs, ys, height, frequencies_hz), block)
