"""How good predicted received powers are, beside what free space and the nearest transmitter say."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.evaluation.baselines import can_lend, nearest_links
from wbgs_jax.evaluation.calibration import power_calibration
from wbgs_jax.inference.confidence import PowerConfidence, expected_power
from wbgs_jax.radio.channel import NOT_HEARD_DB, free_space_db


def score_power(
    predicted: Float[np.ndarray, " n"], truth: Float[np.ndarray, " n"], frequencies_hz: Float[np.ndarray, " n"]
) -> dict[str, Any]:
    """Returns a report of received powers (dB), ready for JSON: n, power_error_db (median absolute error), power_mae_db (mean),
    and the same in per_frequency, a list by ascending frequency_ghz.

    Raises:
        UserError: there is no link, or a prediction is NaN or infinite.
    """
    if len(predicted) == 0:
        raise UserError("there is no link to score; choose a split or frequencies with at least one test link")
    error = np.abs(predicted.astype(np.float64) - truth)
    if not np.isfinite(error).all():
        raise UserError(
            f"{int((~np.isfinite(error)).sum())} of {len(error)} predicted powers are no numbers; the model diverged"
        )
    rows = [{"frequency_ghz": float(f / 1e9)} | _summary(error[frequencies_hz == f]) for f in np.unique(frequencies_hz)]
    return _summary(error) | {"per_frequency": rows}


def power_figures(predicted: Float[np.ndarray, " n"], dataset: Dataset, index: Int[np.ndarray, " n"]) -> dict[str, Any] | None:
    """Returns the report of predicted powers of some links, and that of the baselines: free_space (Friis over the straight
    line) and, where there is training data of the receivers, nearest_tx (the power of the nearest training transmitter at the
    same frequency). None where the data know no power.

    Raises:
        UserError: as `score_power`.
    """
    report = score_heard(predicted, dataset, index)
    if report is None:
        return None
    others = {"free_space": free_space(dataset, index)}
    if can_lend(dataset, index):
        others["nearest_tx"] = nearest_power(dataset, index)
    return report | {"baselines": {name: score_heard(values, dataset, index) for name, values in others.items()}}


def score_heard(predicted: Float[np.ndarray, " n"], dataset: Dataset, index: Int[np.ndarray, " n"]) -> dict[str, Any] | None:
    """Returns the report of predicted powers of some links, those without any power left out; None where the data know none, or
    are snapshots in which nothing was heard."""
    truth = dataset.received_db(index)
    if truth is None:
        return None
    heard = truth > NOT_HEARD_DB
    if dataset.kind != "power" and not heard.any():
        return None
    return score_power(predicted[heard], truth[heard], dataset.frequencies_hz[index[heard]])


def calibrate_power(
    confidence: PowerConfidence, predicted: Float[np.ndarray, " n"], dataset: Dataset, index: Int[np.ndarray, " n"]
) -> dict[str, Any] | None:
    """Returns how sure predicted powers of some links were, and should have been (`calibration.power_calibration`); None where
    the data know no power."""
    truth = dataset.received_db(index)
    if truth is None:
        return None
    heard = truth > NOT_HEARD_DB
    receivers = jnp.asarray(dataset.rx_positions(index[heard]), jnp.float32)
    expected = _expected_power(confidence, jnp.asarray(predicted[heard], jnp.float32), dataset.query(index[heard]), receivers)
    return power_calibration(expected, np.abs(predicted[heard].astype(np.float64) - truth[heard]), float(confidence.level))


_expected_power = jax.jit(expected_power)


def free_space(dataset: Dataset, index: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns the power (dB) over the straight line, whatever stands in its way."""
    distance = np.linalg.norm(dataset.tx_positions[index] - dataset.rx_positions(index), axis=-1)
    return np.asarray(free_space_db(jnp.asarray(np.maximum(distance, 1e-3)), jnp.asarray(dataset.frequencies_hz[index])))


def nearest_power(dataset: Dataset, index: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns the power (dB) of the nearest training transmitter that is heard at the same frequency and receiver; where a
    receiver heard none, of the nearest one."""
    everything = dataset.received_db(np.arange(len(dataset)))
    assert everything is not None
    heard = dataset.train[everything[dataset.train] > NOT_HEARD_DB]
    all_hear = np.isin(dataset.receiver_index[index], dataset.receiver_index[heard]).all()
    return everything[nearest_links(dataset, index, heard if all_hear else dataset.train)]


def _summary(error: Float[np.ndarray, " n"]) -> dict[str, Any]:
    return {"n": len(error), "power_error_db": float(np.median(error)), "power_mae_db": float(error.mean())}
