"""Quantities of the channel that a trained field is asked for, beside spectra: snapshots, powers, gains, spreads."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.fields import Field, field_names, get_field
from wbgs_jax.fields.base import Quantity
from wbgs_jax.inference.confidence import PowerConfidence, expected_power
from wbgs_jax.inference.predictor import Trained, check_power, observe_queries
from wbgs_jax.propagation.transport import snapshots_from_paths
from wbgs_jax.radio import channel
from wbgs_jax.radio.array import cbf, pas_directions, steering_vector
from wbgs_jax.types import Query, Receiver, make_query


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
    enough = {"paths", OBSERVED.get(what, "paths")}
    if not enough & set(trained.field.known()):
        able = " or ".join(name for name in field_names() if enough & set(get_field(name).gives))
        raise UserError(f"the {trained.field.name} field has no {what}, only spectra; train --field {able}")
    if what == "power":
        check_power(trained.field, dataset)
    name, function = CHANNEL[what]
    query = make_query(np.repeat(tx_positions, len(frequencies_hz), 0), np.tile(frequencies_hz, len(tx_positions)))
    if function is None:
        found = observe_queries(trained, receiver, query, name)
    else:
        plan, measure = trained.field.plan(trained.params, receiver), jax.jit(function)
        found = np.array([_measured(trained, plan, one, receiver, measure) for one in _each(query)])
    values = found.reshape(len(tx_positions), len(frequencies_hz), *found.shape[1:])
    asked = {"tx_positions": tx_positions, "frequencies_hz": frequencies_hz}
    sure = trained.power_confidence if what == "power" else None
    return {name: values} | asked | ({} if sure is None else expected_errors(sure, values, receiver, **asked))


def _each(query: Query) -> list[Query]:
    return [jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], query) for i in range(len(query.frequency_hz))]


def _measured(trained: Trained, plan: Any, query: Query, receiver: Receiver, measure: Callable[..., Any]) -> np.ndarray:
    """Returns what follows from the arrivals of one query."""
    found = _arrivals(trained.field, trained.params, plan, query)
    return np.asarray(measure(jax.tree.map(lambda leaf: leaf[0], found), receiver, query.frequency_hz[0]))


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


@jax.jit
def _arrivals(field: Field, params: Any, plan: Any, query: Query) -> channel.Arrivals:
    return field.arrivals(params, plan, query)


def _beamforming_gain(arrivals: channel.Arrivals, receiver: Receiver, frequency_hz: Any) -> Any:
    y = snapshots_from_paths(arrivals, receiver, frequency_hz)
    directions = jnp.asarray(pas_directions(), jnp.float32)
    return channel.beamforming_gain_db(
        y, jnp.max(cbf(y, steering_vector(receiver.element_wavelengths(frequency_hz), directions)))
    )


CHANNEL: dict[str, tuple[str, Callable[[channel.Arrivals, Receiver, Any], Any] | None]] = {
    "snapshot": ("snapshots", None),
    "power": ("power_db", None),
    "beamforming-gain": ("beamforming_gain_db", _beamforming_gain),
    "k-factor": ("k_factor_db", lambda arrivals, *_: channel.k_factor_db(arrivals)),
    "angular-spread": ("angular_spread_deg", lambda arrivals, *_: channel.angular_spread_deg(arrivals)),
    "delay-spread": ("delay_spread_s", lambda arrivals, *_: channel.delay_spread_s(arrivals)),
}
"""Name in the file, and how it follows from what arrives; None: the field says it itself, under that name (`Observation`)."""
OBSERVED: dict[str, Quantity] = {"snapshot": "snapshots", "power": "power"}
"""What a field that knows of no paths may know nevertheless."""
