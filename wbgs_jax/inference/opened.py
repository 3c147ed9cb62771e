"""A run folder opened for one question: by what an earlier command left ready where that will do, else by reading the run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from wbgs_jax.inference.bounds import CONFIDENCES, Bounds
from wbgs_jax.inference.queries import Product, Queries
from wbgs_jax.inference.ready import MOST, QUANTITIES, Ready, load_ready, make_ready


class Options(NamedTuple):
    """Of some quantities alone."""

    tx_velocity: Float[np.ndarray, "3"]
    """Metres a second."""
    rx_velocity: Float[np.ndarray, "3"]
    band_hz: float
    """Of frequency responses."""
    points: int
    """Frequencies in the band."""
    tx_array: tuple[int, int]
    """Rows and columns of a MIMO matrix's transmitters."""


class Opened(NamedTuple):
    """Who answers, and what lines and files say of it."""

    answer: Callable[[list[Product]], dict[str, np.ndarray]]
    """Answers a block of queries (`asking.answer_block`)."""
    bounds: Bounds
    source: dict[str, Any]
    """Scene, field, step, version and receiver (`answers.source_of`)."""


def open_field(
    run: Path,
    rx: str,
    what: str,
    queries: Queries,
    lowest_hz: float,
    options: Options,
    load: Callable[[], tuple[Any, list[Path]]],
) -> Opened:
    """Returns who answers queries. The first command that asks a little leaves the field ready for those that follow.

    Args:
        run: the folder.
        rx: names the receiver (`answers.receiver_at`).
        what: is asked.
        queries: all of them.
        lowest_hz: the lowest frequency among them.
        options: of some quantities.
        load: reads the run: a trained field, and the files and folders that it follows from.

    Raises:
        UserError: the run cannot be read, or knows nothing of what is asked.
    """
    few = len(queries) <= MOST and what in QUANTITIES
    if few and (ready := load_ready(run, rx, len(queries))) and _knows(ready, what, lowest_hz):
        return _opened_ready(ready, what, queries)
    return _opened_run(run, rx, what, queries, lowest_hz, options, load, few)


def _knows(ready: Ready, what: str, lowest_hz: float) -> bool:
    return what in ready.meta["what"] and lowest_hz >= ready.meta["lowest_hz"]


def _opened_ready(ready: Ready, what: str, queries: Queries) -> Opened:
    bounds = Bounds.from_json(ready.meta["bounds"])
    positions, frequencies_hz = queries.flat()
    answer = _masked(ready(what, positions, frequencies_hz), bounds, positions)
    return Opened(lambda block: answer, bounds, ready.meta["source"])


def _masked(answer: dict[str, np.ndarray], bounds: Bounds, positions: Float[np.ndarray, "n 3"]) -> dict[str, np.ndarray]:
    """Returns an answer without confidence where there is none (NaN)."""
    if not set(CONFIDENCES) & set(answer):
        return answer
    nowhere = bounds.without_confidence(positions)
    return {
        name: np.where(nowhere.reshape(-1, *[1] * (values.ndim - 1)), np.nan, values).astype(values.dtype)
        if name in CONFIDENCES
        else values
        for name, values in answer.items()
    }


def _opened_run(
    run: Path, rx: str, what: str, queries: Queries, lowest_hz: float, options: Options, load: Callable[[], Any], few: bool
) -> Opened:
    # Here: what was left ready needs nothing of all this, and it takes seconds to load.
    from wbgs_jax.inference import asking
    from wbgs_jax.inference.answers import bounds_of, check_frequencies, lowest_answered, receiver_at, source_of
    from wbgs_jax.inference.predictor import at_receiver
    from wbgs_jax.inference.quantities import check_known, known_quantities

    trained, watched = load()
    dataset = trained.dataset()
    receiver = receiver_at(rx, dataset)
    trained = at_receiver(trained, receiver, dataset)
    check_frequencies(trained, dataset, lowest_hz)
    check_known(what, trained, dataset)
    bounds, source = bounds_of(dataset), source_of(trained, dataset, receiver)
    if few:
        meta = {
            "source": source,
            "bounds": bounds.as_json(),
            "what": known_quantities(trained, dataset),
            "lowest_hz": lowest_answered(trained, dataset),
        }
        if ready := make_ready(run, rx, len(queries), trained, receiver, watched, meta):
            return _opened_ready(ready, what, queries)

    def answer(block: list[Product]) -> dict[str, np.ndarray]:
        found = asking.answer_block(what, trained, dataset, receiver, options, block)
        rows = np.concatenate([product.rows for product in block])
        positions = np.concatenate([np.repeat(one.tx_positions, len(one.frequencies_hz), axis=0) for one in block])
        return _masked(found, bounds, positions[np.argsort(rows)])

    return Opened(answer, bounds, source)
