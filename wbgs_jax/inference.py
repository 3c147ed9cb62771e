"""Asking a trained field: as a pure function of (transmitter, frequency), or on the host in blocks of one compiled shape."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Jaxpr, Literal
from jaxtyping import Array, Float, Int

from wbgs_jax.array import PAS_SHAPE
from wbgs_jax.checks import check_query
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.fields import Field, Observation
from wbgs_jax.runs import TrainedField
from wbgs_jax.types import Query, Receiver

BLOCK = 16
"""Queries rendered at a time: they share the footprints; more cost memory and, on a CPU, gain nothing."""

Predictor = Callable[[Any, Any], Array]
"""(tx_position (*b, 3) metres, frequency_hz (*b,)) -> PAS (*b, 90, 360); leading axes broadcast like NumPy's."""


def make_predictor(field: Field, params: Any, receiver: Receiver) -> Callable[[Query], Any]:
    """A jitted Query -> PAS with the receiver's geometry planned once. Fields of equal shapes share one compilation."""
    plan = field.plan(params, receiver)
    render = jax.jit(field.render)
    return lambda query: render(params, plan, query)


def predictor(trained: TrainedField, receiver: Receiver | None = None) -> Predictor:
    """A trained field as a pure function (tx_position, frequency_hz) -> PAS, for `jit`, `vmap` and one reverse-mode `grad`.

    The receiver (default: that of the data the field was trained on, which are read for it) is folded in: a query costs the
    networks and the compositing, and of the networks only what depends on the query. Compiles for every new number of queries;
    `predict_many` keeps that number fixed.
    """
    receiver = trained.config.dataset().receiver if receiver is None else receiver
    plan = trained.field.plan(trained.params, receiver)
    return on_any_shape(jax.jit(fold(lambda query: trained.field.render(trained.params, plan, query))))


def on_any_shape(render: Callable[[Query], Any]) -> Predictor:
    """Let a function of a flat batch of queries take positions (*b, 3) and frequencies (*b,) whose leading axes broadcast."""

    def predict(tx_position: Any, frequency_hz: Any) -> Float[Array, "*b 90 360"]:
        position, frequency = jnp.asarray(tx_position, jnp.float32), jnp.asarray(frequency_hz, jnp.float32)
        if position.shape[-1:] != (3,):
            raise ValueError(f"tx_position has shape {position.shape}; expected (3,) or (..., 3)")
        shape = jnp.broadcast_shapes(position.shape[:-1], frequency.shape)
        position, frequency = jnp.broadcast_to(position, (*shape, 3)), jnp.broadcast_to(frequency, shape)
        query = Query(position.reshape(-1, 3), frequency.reshape(-1))
        check_query(query)
        if 0 in shape:
            return jnp.zeros((*shape, *PAS_SHAPE), jnp.float32)
        return render(query).reshape(*shape, *PAS_SHAPE)

    return predict


def fold(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` with everything that does not depend on its arguments computed when it is traced, not when it is called.

    XLA folds small constants by itself, but not per-Gaussian encodings and layers.
    """

    def folded(*args: Any) -> Any:
        closed, result = jax.make_jaxpr(function, return_shape=True)(*args)
        early, late = _split(closed.jaxpr)
        with jax.ensure_compile_time_eval():
            values = jax.jit(partial(jax.core.eval_jaxpr, early, closed.consts))()
        leaves = jax.core.eval_jaxpr(late, [*closed.consts, *values], *jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(result), leaves)

    return folded


def _split(jaxpr: Jaxpr) -> tuple[Jaxpr, Jaxpr]:
    """A jaxpr in two: what depends on no argument, and the rest, which takes the results of the first as more constants."""
    dependent: set[Any] = set(jaxpr.invars)
    early: list[Any] = []
    late: list[Any] = []
    for equation in jaxpr.eqns:
        depends = not dependent.isdisjoint(_variables(equation.invars))
        (late if depends else early).append(equation)
        dependent.update(equation.outvars if depends else [])
    computed = {variable for equation in early for variable in equation.outvars}
    read = [variable for atoms in (*(e.invars for e in late), jaxpr.outvars) for variable in _variables(atoms)]
    results = [variable for variable in dict.fromkeys(read) if variable in computed]
    rest = jaxpr.replace(eqns=late, constvars=[*jaxpr.constvars, *results])
    return jaxpr.replace(eqns=early, invars=[], outvars=results), rest


def _variables(atoms: Any) -> list[Any]:
    return [atom for atom in atoms if not isinstance(atom, Literal)]


def predict_blocks(
    predict: Predictor, tx_positions: Any, frequencies_hz: Any, block: int = BLOCK
) -> Iterator[Float[np.ndarray, "k 90 360"]]:
    """Spectra (float32) of n queries, at most `block` at a time and in order: for more than memory holds.

    Positions (n, 3) in metres; frequencies (n,), or one, in hertz. All blocks have the same shape: one compilation.
    """
    positions = np.atleast_2d(np.asarray(tx_positions, np.float32))
    frequencies = np.broadcast_to(np.asarray(frequencies_hz, np.float32), len(positions))
    return _blocks(len(positions), block, lambda i: predict(positions[i], frequencies[i]))


def predict_many(
    predict: Predictor, tx_positions: Any, frequencies_hz: Any, block: int = BLOCK
) -> Float[np.ndarray, "n 90 360"]:
    """All blocks of `predict_blocks` in one array."""
    blocks = predict_blocks(predict, tx_positions, frequencies_hz, block)
    return _collect(len(np.atleast_2d(tx_positions)), blocks)


def map_queries(
    xs: Any, ys: Any, height: float, frequencies_hz: Any
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Positions and frequencies of a map at one height: the x of the grid runs fastest, then y, then the frequency.

    Metres and hertz; results of n = frequencies * ys * xs queries reshape to (frequencies, ys, xs, ...).
    """
    frequency, y, x = np.meshgrid(np.atleast_1d(frequencies_hz), np.atleast_1d(ys), np.atleast_1d(xs), indexing="ij")
    return np.stack([x, y, np.full(x.shape, height)], -1).reshape(-1, 3).astype(float), frequency.reshape(-1).astype(float)


def predict_map(
    predict: Predictor, xs: Any, ys: Any, height: float, frequencies_hz: Any, block: int = BLOCK
) -> Float[np.ndarray, "n 90 360"]:
    """Spectra (float32, 130 kB each) of a map of transmitters, in the order of `map_queries`."""
    return predict_many(predict, *map_queries(xs, ys, height, frequencies_hz), block)


def predict_spectra(field: Field, params: Any, dataset: Dataset, index: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 90 360"]:
    """Predicted spectra (float32) of some of a dataset's queries."""
    return _collect(len(index), (np.asarray(seen.pas) for seen in observations(field, params, dataset, index)))


def observations(field: Field, params: Any, dataset: Dataset, index: Int[np.ndarray, "n"]) -> Iterator[Observation]:
    """What a field shows of some of a dataset's queries, block by block. What it can remember of a transmitter is computed
    once for all frequencies."""
    _, first, place = np.unique(dataset.tx_index[index], return_index=True, return_inverse=True)
    positions = jnp.asarray(dataset.tx_positions[index[first]], jnp.float32)
    memory = field.remember(params, dataset.receiver, positions)
    if memory is None:
        predict = make_predictor(field, params, dataset.receiver)
        for images in _blocks(len(index), BLOCK, lambda i: predict(dataset.query(index[i]))):
            yield Observation(jnp.asarray(images))
        return
    observe = jax.jit(field.observe)
    for start in range(0, len(index), BLOCK):
        chosen = np.minimum(np.arange(start, start + BLOCK), len(index) - 1)  # the last query fills the last block up
        query, tx_index = dataset.query(index[chosen]), jnp.asarray(place[chosen], jnp.int32)
        seen = observe(params, memory, dataset.receiver, query, tx_index, None, None)
        left = len(index) - start
        yield Observation(seen.pas[:left], None if seen.snapshots is None else seen.snapshots[:left])


def scene_box(dataset: Dataset) -> Float[np.ndarray, "2 3"]:
    """Smallest and largest coordinates (metres) of a scene: of its surfaces where they are known, and of all transmitters and
    the receiver. What a field says about transmitters outside is made up."""
    points = (dataset.vertices, dataset.tx_positions, np.asarray(dataset.receiver.position)[None])
    everything = np.concatenate([np.asarray(p, np.float64).reshape(-1, 3) for p in points])
    return np.stack([everything.min(0), everything.max(0)])


def trained_band(dataset: Dataset) -> tuple[float, float]:
    """Lowest and highest frequency (hertz) of the training spectra."""
    frequencies = dataset.frequencies_hz[dataset.train]
    return float(frequencies.min()), float(frequencies.max())


def _blocks(n: int, block: int, render: Callable[[np.ndarray], Any]) -> Iterator[np.ndarray]:
    for start in range(0, n, block):
        index = np.minimum(np.arange(start, start + block), n - 1)  # the last query fills the last block up
        yield np.asarray(render(index))[: n - start]


def _collect(n: int, blocks: Iterator[np.ndarray]) -> Float[np.ndarray, "n 90 360"]:
    images = np.empty((n, *PAS_SHAPE), np.float32)
    done = 0
    for part in blocks:
        images[done : done + len(part)] = part
        done += len(part)
    return images
