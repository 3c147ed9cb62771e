"""Quantities of the channel that a trained field is asked for, beside spectra: snapshots, powers, gains, spreads."""

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.fields import Field, field_names, get_field
from wbgs_jax.fields.base import Output, outputs_of, paths_of
from wbgs_jax.inference.intervals import PowerConfidence, expected_power
from wbgs_jax.inference.predictor import BLOCK, Trained, check_power, check_spectra, observe_queries
from wbgs_jax.propagation.transport import snapshots_from_paths
from wbgs_jax.radio import channel
from wbgs_jax.radio.array import cbf, pas_directions, steering_vector
from wbgs_jax.types import Query, Receiver, make_query

OfArrivals = Callable[[channel.Arrivals, Receiver, Any], Any]
"""(arrivals of one link, receiver, frequency_hz) -> a quantity of it."""


def ask_channel(
    what: str,
    trained: Trained,
    dataset: Dataset,
    receiver: Receiver,
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
) -> dict[str, np.ndarray]:
    """Returns {name with unit: values (tx, freq) or (tx, freq, elements)} of every transmitter at every frequency.

    Args:
        what: a name of `CHANNEL`.
        trained: the field, and the data it was trained on: `dataset`.
        receiver: at which it is asked (`predictor.at_receiver`).
        tx_positions: world frame, metres.
        frequencies_hz: of the carrier.

    Raises:
        UserError: the field knows nothing of it.
    """
    check_known(what, trained, dataset)
    name, function = CHANNEL[what]
    query = make_query(np.repeat(tx_positions, len(frequencies_hz), 0), np.tile(frequencies_hz, len(tx_positions)))
    if function is None:
        found = observe_queries(trained, receiver, query, name)
    else:
        found = _measured(trained, trained.field.plan(trained.params, receiver), query, receiver, function)
    values = found.reshape(len(tx_positions), len(frequencies_hz), *found.shape[1:])
    asked = {"tx_positions": tx_positions, "frequencies_hz": frequencies_hz}
    sure = trained.power_confidence if what == "power" else None
    return {name: values} | asked | ({} if sure is None else expected_errors(sure, values, receiver, **asked))


def check_known(what: str, trained: Trained, dataset: Dataset) -> None:
    """Raises a `UserError` where a field knows nothing of a quantity."""
    if what == "spectra":
        check_spectra(trained.field, dataset)
    if what not in CHANNEL:
        return
    enough = {"paths", OBSERVED.get(what, "paths")}
    if not enough & set(outputs_of(trained.field)):
        able = " or ".join(name for name in field_names() if enough & set(get_field(name).outputs))
        raise UserError(f"the {trained.field.name} field has no {what}, only spectra; train --field {able}")
    if what == "power":
        check_power(trained.field, dataset)


def known_quantities(trained: Trained, dataset: Dataset) -> list[str]:
    """Returns what a field can be asked for beside what follows from paths alone: spectra, and names of `OBSERVED`."""
    found = []
    for what in ("spectra", *OBSERVED):
        with contextlib.suppress(UserError):
            check_known(what, trained, dataset)
            found.append(what)
    return found


def _measured(trained: Trained, plan: Any, query: Query, receiver: Receiver, function: OfArrivals) -> np.ndarray:
    """Returns what follows from the arrivals of queries, in blocks of one shape: one compilation."""
    count, parts = len(query.frequency_hz), []
    size = min(BLOCK, count)
    for start in range(0, count, size):
        index = np.minimum(np.arange(start, start + size), count - 1)  # the last query fills the last block up
        block = jax.tree.map(lambda leaf, index=index: leaf[index], query)
        found = _of_arrivals(trained.field, trained.params, plan, receiver, block, function)
        parts.append(np.asarray(found)[: count - start])
    return np.concatenate(parts)


@partial(jax.jit, static_argnames=("function",))
def _of_arrivals(field: Field, params: Any, plan: Any, receiver: Receiver, query: Query, function: OfArrivals) -> Any:
    arrivals = paths_of(field, params, plan, query)
    return jax.vmap(lambda one, frequency_hz: function(one, receiver, frequency_hz))(arrivals, query.frequency_hz)


def expected_errors(
    confidence: PowerConfidence,
    power_db: Float[np.ndarray, "tx freq"],
    receiver: Receiver,
    tx_positions: Float[np.ndarray, "tx 3"],
    frequencies_hz: Float[np.ndarray, " freq"],
) -> dict[str, np.ndarray]:
    """Returns {expected_error_db, within_db}, each (tx, freq), of received powers of every transmitter at every frequency."""
    query = make_query(np.repeat(tx_positions, len(frequencies_hz), 0), np.tile(frequencies_hz, len(tx_positions)))
    found = expected_power(confidence, jnp.asarray(power_db.reshape(-1), jnp.float32), query, receiver.position)
    return {
        name: np.asarray(values).reshape(power_db.shape)
        for name, values in zip(("expected_error_db", "within_db"), found, strict=True)
    }


def _beamforming_gain(arrivals: channel.Arrivals, receiver: Receiver, frequency_hz: Any) -> Any:
    y = snapshots_from_paths(arrivals, receiver, frequency_hz)
    directions = jnp.asarray(pas_directions(), jnp.float32)
    return channel.beamforming_gain_db(
        y, jnp.max(cbf(y, steering_vector(receiver.element_wavelengths(frequency_hz), directions)))
    )


CHANNEL: dict[str, tuple[str, OfArrivals | None]] = {
    "snapshot": ("snapshots", None),
    "power": ("power_db", None),
    "beamforming-gain": ("beamforming_gain_db", _beamforming_gain),
    "k-factor": ("k_factor_db", lambda arrivals, *_: channel.k_factor_db(arrivals)),
    "angular-spread": ("angular_spread_deg", lambda arrivals, *_: channel.angular_spread_deg(arrivals)),
    "delay-spread": ("delay_spread_s", lambda arrivals, *_: channel.delay_spread_s(arrivals)),
}
"""Name in the file, and how it follows from what arrives; None: the field says it itself, under that name (`Observation`)."""
OBSERVED: dict[str, Output] = {"snapshot": "snapshots", "power": "power"}
"""What a field that knows of no paths may know nevertheless."""
