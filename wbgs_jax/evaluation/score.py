"""How good a trained field is on held-out links: figures of every kind that field and data have, beside the baselines.

How well the tracer of the released scenes repeats itself: beyond that no score can be told from the truth.

Spectra of some transmitters, traced again with three times the rays (`python -m data_gen.repeatability`).

Whether a field knows how good it is: intervals that hold what they promise, and scores that rise when doubtful answers are
left out.

How good predicted received powers are, beside what free space and the nearest transmitter say.
"""

import dataclasses
import time
from collections.abc import Callable, Iterable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float, Int
from scipy.stats import rankdata

from wbgs_jax import metrics
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_json
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.load import RELEASED
from wbgs_jax.data.scene import in_sight
from wbgs_jax.data.splits import with_validation_trained
from wbgs_jax.evaluation.baselines import baselines, can_lend, nearest_links
from wbgs_jax.fields import Field, Observation
from wbgs_jax.fields.base import Params
from wbgs_jax.inference.intervals import Confidence, Expected, ExpectedPower, PowerConfidence, expect_many, expected_power
from wbgs_jax.inference.kriging import for_receiver, without_asked
from wbgs_jax.inference.predictor import BLOCK, as_observed, observe, observe_links, render_pas
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.metrics import plane_normal
from wbgs_jax.radio import channel
from wbgs_jax.radio.channel import NOT_HEARD_DB, free_space_db

FILE = "repeatability.json"


def repeatability(scene: str, ghz: Iterable[float]) -> float | None:
    """Returns the truth's median SSIM to itself in a released scene (`scene4`), averaged over frequencies (GHz); None where it
    is not known for all of them."""
    known = read_json(RELEASED / FILE).get(scene, {}).get("median_ssim", {})
    names = [f"{f:g}" for f in ghz]
    return float(np.mean([known[name] for name in names])) if names and all(name in known for name in names) else None


COVERAGES = (1.0, 0.9, 0.75, 0.5, 0.25, 0.1)
"""Shares of the answers, the surest ones, whose mean score is reported."""


def calibration(expected: Expected, scores: Float[np.ndarray, " n"], level: float) -> dict[str, Any]:
    """Returns how the expected SSIM of answers compares with what they scored: `coverage` of the intervals and their mean
    `width`, the mean `expected` and true `scored` SSIM, their rank `correlation` (Spearman), and the `risk_coverage` curve: the
    mean SSIM of the surest share."""
    expectation, low, high = (np.asarray(values, np.float64) for values in expected)
    held = (low <= scores) & (scores <= high)
    return _figures(expectation, scores, -expectation, held, level) | {"width": float(np.mean(np.minimum(high, 1) - low))}


def power_calibration(expected: ExpectedPower, errors_db: Float[np.ndarray, " n"], level: float) -> dict[str, Any]:
    """Returns how the expected errors of received powers compare with the true absolute ones (dB): `coverage` of what they were
    to stay within, its mean `within_db`, the mean `expected` and true `scored` error, their rank `correlation`, and the
    `risk_coverage` curve: the mean error of the surest share."""
    expectation, within = (np.asarray(values, np.float64) for values in expected)
    return _figures(expectation, errors_db, expectation, errors_db <= within, level) | {"within_db": float(within.mean())}


def _figures(
    expectation: Float[np.ndarray, " n"],
    truth: Float[np.ndarray, " n"],
    doubt: Float[np.ndarray, " n"],
    held: Bool[np.ndarray, " n"],
    level: float,
) -> dict[str, Any]:
    """Returns what both have in common; `doubt` orders the answers, the surest first, and those of equal doubt count as their
    mean."""
    ranks, equal = np.unique(doubt, return_inverse=True)
    means = np.bincount(equal, truth, len(ranks)) / np.bincount(equal, minlength=len(ranks))
    surest = means[np.sort(equal)]
    return {
        "level": round(level, 4),
        "coverage": float(held.mean()),
        "expected": float(expectation.mean()),
        "scored": float(truth.mean()),
        "correlation": _rank_correlation(expectation, truth),
        "risk_coverage": {f"{share:g}": float(surest[: max(1, round(share * len(truth)))].mean()) for share in COVERAGES},
    }


def _rank_correlation(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> float:
    """Returns Spearman's; 0 where one of both is constant."""
    ranks = [rankdata(values) for values in (a, b)]
    return float(np.corrcoef(*ranks)[0, 1]) if min(map(np.ptp, ranks)) > 0 else 0.0


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
    if dataset.has_spectra and not heard.any():
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


Part = Literal["test", "validation"]
"""What is held out: for the final figures, or for choices."""


def evaluate(
    trained: TrainedField, dataset: Dataset, part: Part = "test"
) -> tuple[dict[str, Any], Float[np.ndarray, "n 90 360"]]:
    """Returns the report of a field on a dataset's held-out links, ready for JSON, and the predicted spectra (n, 90, 360).

    Raises:
        UserError: nothing is held out, or the field knows nothing of what was observed.
    """
    index = held_out(dataset, part)
    tested = part == "test"
    if not tested and trained.neighbours is not None:  # they know the validation part
        asked = without_asked(trained.neighbours, dataset.query(index))
        trained = dataclasses.replace(trained, neighbours=asked)
    others_know = with_validation_trained(dataset) if tested else dataset
    seen = observe(trained, dataset, index)
    report = {"scene": dataset.name, "field": trained.origin()["field"], "part": part}
    said = power_of(seen, dataset)
    power = None if said is None else power_figures(said, others_know, index)
    if said is not None and power and trained.power_confidence and tested:  # how sure it is, the validation part has told
        power |= {"confidence_db": calibrate_power(trained.power_confidence, said, dataset, index)}
    own = own_scores(seen, dataset, index)
    if not dataset.has_spectra:
        return report | own | (power or {}) | time_queries(trained, dataset), np.asarray(seen.pas)
    truth, known = np.asarray(dataset.pas(index)), (dataset.frequencies_hz[index], in_sight(dataset, index))
    normal = plane_normal(np.asarray(dataset.receiver().element_positions))
    figures = metrics.figures(np.asarray(seen.pas), truth, normal)
    report |= metrics.summarise(figures, *known, dataset.receiver_index[index])
    noisy, alike = as_observed(trained.field, trained.params, np.asarray(seen.pas)), figures["ssim"]
    if not np.array_equal(noisy, seen.pas):
        alike = metrics.ssim(noisy, truth)
        report["as_observed"] = {"median_ssim": float(np.median(alike)), "mean_ssim": float(np.mean(alike))}
    repeats = repeatability(dataset.name, np.unique(known[0]) / 1e9)
    report |= {} if repeats is None else {"truth_repeats": repeats}
    report |= own | ({"power": power} if power else {})
    sure = trained.confidence
    if tested and sure is not None and (expected := expectations(sure, dataset, index, np.asarray(seen.pas), said)):
        report["confidence"] = calibration(expected, alike, float(sure.level))  # as it was learned
    report |= time_queries(trained, dataset)
    beside = baselines(others_know) if can_lend(others_know, index) else {}
    report["baselines"] = {
        name: metrics.score(np.asarray(predict(index)), truth, *known, normal) for name, predict in beside.items()
    }
    return report, np.asarray(seen.pas)


def expectations(
    confidence: Confidence | None,
    dataset: Dataset,
    index: Int[np.ndarray, " n"],
    pas: Float[np.ndarray, "n 90 360"],
    power_db: Float[np.ndarray, " n"] | None,
) -> Expected | None:
    """Returns what is expected of the answers to some links; None where nothing was learned of one of their receivers."""
    receiver = dataset.receiver_index[index]
    learned = {number: for_receiver(confidence, dataset.receiver(number)) for number in np.unique(receiver).tolist()}
    if any(own is None for own in learned.values()):
        return None
    expected = Expected(*np.empty((3, len(index)), np.float32))
    for number, of_one in learned.items():
        own = np.flatnonzero(receiver == number)
        asked = dataset.tx_positions[index[own]], dataset.frequencies_hz[index[own]]
        found = expect_many(of_one, pas[own], *asked, None if power_db is None else power_db[own])
        for column, values in zip(expected, found, strict=True):
            column[own] = values
    return expected


def held_out(dataset: Dataset, part: Part) -> Int[np.ndarray, " n"]:
    """Returns the indices of the held-out links; none at all is a `UserError`."""
    index = getattr(dataset, part)
    if not len(index):
        raise UserError(f"{dataset.name} has no {part} spectra; choose another split")
    return index


def power_of(seen: Observation, dataset: Dataset) -> Float[np.ndarray, " n"] | None:
    """Returns the received powers that a field says; None where it knows none.

    Raises:
        UserError: the data know power alone, and the field nothing of it.
    """
    if seen.power_db is None and not dataset.has_spectra:
        raise UserError(
            f"{dataset.name} holds {dataset.observed.words}, of which this field knows nothing; choose another field"
        )
    return None if seen.power_db is None else np.asarray(seen.power_db)


def score_snapshots(predicted: Complex[np.ndarray, "n elements"], truth: Complex[np.ndarray, "n elements"]) -> dict[str, float]:
    """Returns medians of the correlation |y^H y'| / (|y| |y'|) and of the power error (dB) over the links on which something
    was heard; nothing, if there is none."""
    heard = truth.any(-1)
    if not heard.any():
        return {}
    a, b = (jnp.asarray(snapshots[heard]) for snapshots in (truth, predicted))
    error = jnp.abs(channel.received_power_db(b) - channel.received_power_db(a))
    return {
        "snapshot_correlation": float(jnp.median(channel.correlation(a, b))),
        "power_error_db": float(jnp.median(error)),
    }


SCORES: dict[str, Callable[[Observation, np.ndarray], dict[str, float]]] = {
    "snapshots": lambda seen, truth: {} if seen.snapshots is None else score_snapshots(np.asarray(seen.snapshots), truth),
}
"""Figures of some kinds of observation, beside those of spectra and of received power: (what a field says of n links, what was
observed on them) -> figures, none if it says nothing that could be compared."""


def own_scores(seen: Observation, dataset: Dataset, index: Int[np.ndarray, " n"]) -> dict[str, float]:
    """Returns the figures (`SCORES`) of what was observed on some links."""
    kinds = [name for name in dataset.observations if name in SCORES]
    return {key: value for name in kinds for key, value in SCORES[name](seen, dataset.observations[name][index]).items()}


def watch(field: Field, params: Params, dataset: Dataset, index: Int[np.ndarray, " n"]) -> dict[str, float]:
    """Returns the figure that the curves of a training show of some held-out links."""
    seen = observe_links(field, params, dataset, index)
    said = power_of(seen, dataset)
    if not dataset.has_spectra and said is not None and (report := score_heard(said, dataset, index)):
        return {"held_out_power_error_db": report["power_error_db"]}
    noisy = as_observed(field, params, np.asarray(seen.pas))
    return {"held_out_ssim": float(np.median(metrics.ssim(noisy, np.asarray(dataset.pas(index)))))}


def time_queries(trained: TrainedField, dataset: Dataset, repeats: int = 7) -> dict[str, float]:
    """Returns milliseconds a PAS, for single queries and in blocks: medians over repeats after compilation."""
    plan = trained.field.plan(trained.params, dataset.receiver())
    neighbours = for_receiver(trained.neighbours, dataset.receiver())
    result = {}
    for name, size in (("ms_per_pas", BLOCK), ("ms_per_pas_single", 1)):
        query = dataset.query(np.resize(dataset.test if len(dataset.test) else dataset.train, size))
        seconds = []
        for _ in range(repeats + 1):
            begin = time.perf_counter()
            jax.block_until_ready(render_pas(trained.field, trained.params, plan, query, neighbours))
            seconds.append(time.perf_counter() - begin)
        result[name] = round(1e3 * float(np.median(seconds[1:])) / size, 3)  # the first call compiles
    return result
