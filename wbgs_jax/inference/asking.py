"""Blocks of queries answered by a trained field: spectra, or any other quantity that `wbgs-jax predict --what` names."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from wbgs_jax.data.dataset import Dataset
from wbgs_jax.inference.confidence import expect_many
from wbgs_jax.inference.links import ask_mimo, ask_paths, ask_response
from wbgs_jax.inference.neighbours import for_receiver
from wbgs_jax.inference.opened import Options
from wbgs_jax.inference.parts import SHARED
from wbgs_jax.inference.predictor import Trained, observe_queries
from wbgs_jax.inference.quantities import ask_channel
from wbgs_jax.inference.queries import Product
from wbgs_jax.radio.array import planar_array
from wbgs_jax.types import Receiver, make_query

PATHS = "paths"
ASKED = ("tx_positions", "frequencies_hz")
"""What answers repeat of the question."""


def answer_block(
    what: str, trained: Trained, dataset: Dataset, receiver: Receiver, options: Options, block: list[Product]
) -> dict[str, np.ndarray]:
    """Returns the answers to a block of queries by name, their leading axis the queries in order, and `parts.SHARED` arrays;
    of paths a table, in the queries' order, whose `tx` says which transmitter a row belongs to."""
    ask, found = _asker(what, trained, dataset, receiver, options), []
    for product in block:
        answer = ask(product.tx_positions, product.frequencies_hz)
        if what == PATHS:
            answer["tx"] = product.tx_numbers[answer["tx"]]
        found.append({name: values for name, values in answer.items() if name not in ASKED and values is not None})
    if what == PATHS:
        order = np.argsort(np.concatenate([answer["tx"] for answer in found]), kind="stable")
        return {name: np.concatenate([answer[name] for answer in found])[order] for name in found[0]}
    order = np.argsort(np.concatenate([product.rows for product in block]))
    return {
        name: found[0][name]
        if name in SHARED
        else np.concatenate([answer[name].reshape(-1, *answer[name].shape[2:]) for answer in found])[order]
        for name in found[0]
    }


def _asker(
    what: str, trained: Trained, dataset: Dataset, receiver: Receiver, options: Options
) -> Callable[[Any, Any], dict[str, np.ndarray]]:
    """Returns a function of transmitters and frequencies, every one at every other."""
    if what == "spectra":
        return lambda tx, freq: ask_spectra(trained, receiver, tx, freq)
    if what == PATHS:
        velocities = options.tx_velocity, options.rx_velocity
        return lambda tx, freq: ask_paths(trained, dataset, receiver, tx, freq, *velocities)
    if what == "frequency-response":
        return lambda tx, freq: ask_response(trained, receiver, tx, freq, options.band_hz, options.points)
    if what == "mimo":
        return lambda tx, freq: ask_mimo(trained, receiver, tx, freq, planar_array(*options.tx_array))
    return lambda tx, freq: ask_channel(what, trained, dataset, receiver, tx, freq)


def ask_spectra(
    trained: Trained,
    receiver: Receiver,
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
) -> dict[str, np.ndarray]:
    """Returns the spectra `pas` (tx, freq, 90, 360) of every transmitter at every frequency, and `expected` (tx, freq, 3): the
    SSIM that is expected of each, and the ends of its interval, where the run knows how sure it is."""
    shape = len(tx_positions), len(frequencies_hz)
    tx, frequency = np.repeat(tx_positions, shape[1], axis=0), np.tile(frequencies_hz, shape[0])
    seen = observe_queries(trained, receiver, make_query(tx, frequency))
    pas, power = np.asarray(seen.pas), None if seen.power_db is None else np.asarray(seen.power_db)
    answer = {"pas": pas.reshape(*shape, *pas.shape[1:])}
    confidence = for_receiver(trained.confidence, receiver)
    if confidence is not None:
        expected = np.stack(expect_many(confidence, pas, tx, frequency, power), -1)
        answer["expected"] = expected.reshape(*shape, 3)
    return answer
