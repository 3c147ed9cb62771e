"""Scores of a trained field on held-out links, compared with baselines, for every kind of output that field and data have.

Besides the accuracy of spectra, snapshots and received powers, the report has

* the repeatability of the released scenes: spectra of some transmitters, traced again with three times the rays
  (`python -m data_gen.repeatability`). It is the highest meaningful score;
* the calibration of the prediction intervals: their coverage, and scores as a function of the fraction of predictions kept, the
  most certain ones first;
* received powers compared with free space and the nearest training transmitter.
"""

import dataclasses
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int
from scipy.stats import rankdata

from wbgs_jax import metrics
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import read_json
from wbgs_jax._util.progress_lines import CountProgress, Pulse
from wbgs_jax.data.dataset import Dataset, with_validation_trained
from wbgs_jax.data.load import RELEASED
from wbgs_jax.data.scene import in_sight
from wbgs_jax.evaluation.baselines import Baseline, baselines, can_lend, nearest_links
from wbgs_jax.fields import Field, Observation
from wbgs_jax.fields.base import Params
from wbgs_jax.inference.intervals import Confidence, Expected, ExpectedPower, PowerConfidence, expect_many, expected_power
from wbgs_jax.inference.kriging import for_receiver, without_queried
from wbgs_jax.inference.predictor import BLOCK, as_observed, observe, observe_links, render_pas
from wbgs_jax.inference.trained_field import TrainedField
from wbgs_jax.radio import channel
from wbgs_jax.radio.channel import NO_PATH_DB, free_space_db

FILE = "repeatability.json"


def repeatability(scene: str, ghz: Iterable[float]) -> float | None:
    """Returns the median SSIM of a released scene (`scene4`) with itself, averaged over frequencies (GHz); None unless it is
    available for all of them."""
    recorded = read_json(RELEASED / FILE).get(scene, {}).get("median_ssim", {})
    names = [f"{f:g}" for f in ghz]
    return float(np.mean([recorded[name] for name in names])) if names and all(name in recorded for name in names) else None


def calibration(expected: Expected, scores: Float[np.ndarray, " n"], level: float) -> dict[str, Any] | None:
    """Returns a comparison of expected and actual SSIM: `coverage` of the intervals and their mean `width`, the mean `expected`
    and actual (`scored`) SSIM, their rank `correlation` (Spearman), and the `risk_coverage` curve: the mean SSIM of the most
    certain fractions. Predictions without an expectation (NaN, at the receiver) are left out; None if there are no others.

    Args:
        expected: expectation and interval of every prediction.
        scores: actual SSIM.
        level: nominal coverage of the intervals.
    """
    known = np.isfinite(expected.ssim)  # not at the receiver
    if not known.any():
        return None
    expectation, low, high = (np.asarray(values, np.float64)[known] for values in expected)
    scores = scores[known]
    covered = (low <= scores.clip(0)) & (scores <= high)  # a score below 0 counts as 0
    return _figures(expectation, scores, -expectation, covered, level) | {"width": float(np.mean(np.minimum(high, 1) - low))}


def power_calibration(expected: ExpectedPower, errors_db: Float[np.ndarray, " n"], level: float) -> dict[str, Any] | None:
    """Returns a comparison of expected and actual absolute errors of received powers (dB): `coverage` of the error bounds and
    their mean `within_db`, the mean `expected` and actual (`scored`) error, their rank `correlation`, and the `risk_coverage`
    curve: the mean error of the most certain fractions. Predictions without an expectation are left out, as in `calibration`.

    Args:
        expected: expected error and error bound of every prediction.
        errors_db: actual absolute errors.
        level: nominal coverage of the bounds.
    """
    known = np.isfinite(expected.error_db)
    if not known.any():
        return None
    expectation, within = (np.asarray(values, np.float64)[known] for values in expected)
    errors_db = errors_db[known]
    return _figures(expectation, errors_db, expectation, errors_db <= within, level) | {"within_db": float(within.mean())}


def _figures(
    expectation: Float[np.ndarray, " n"],
    truth: Float[np.ndarray, " n"],
    uncertainty: Float[np.ndarray, " n"],
    covered: Bool[np.ndarray, " n"],
    level: float,
) -> dict[str, Any]:
    """Returns the figures common to both. `uncertainty` orders the predictions; scores of predictions with equal uncertainty
    are replaced by their mean."""
    ranks, equal = np.unique(uncertainty, return_inverse=True)
    means = np.bincount(equal, truth, len(ranks)) / np.bincount(equal, minlength=len(ranks))
    most_certain = means[np.sort(equal)]
    # Fractions of the predictions, the most certain ones first, whose mean score is reported
    coverages = (1.0, 0.9, 0.75, 0.5, 0.25, 0.1)
    return {
        "level": round(level, 4),
        "coverage": float(covered.mean()),
        "expected": float(expectation.mean()),
        "scored": float(truth.mean()),
        "correlation": _rank_correlation(expectation, truth),
        "risk_coverage": {f"{share:g}": float(most_certain[: max(1, round(share * len(truth)))].mean()) for share in coverages},
    }


def _rank_correlation(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> float:
    """Returns Spearman's rank correlation; 0 if one of the arguments is constant."""
    ranks = [rankdata(values) for values in (a, b)]
    return float(np.corrcoef(*ranks)[0, 1]) if min(map(np.ptp, ranks)) > 0 else 0.0


def score_power(
    predicted: Float[np.ndarray, " n"], truth: Float[np.ndarray, " n"], frequencies_hz: Float[np.ndarray, " n"]
) -> dict[str, Any]:
    """Returns a report of received powers (dB), ready for JSON: n, power_error_db (median absolute error), power_mae_db (mean),
    and the same in per_frequency, a list by ascending frequency_ghz.

    Raises:
        UserError: there are no links, or a prediction is NaN or infinite.
    """
    if len(predicted) == 0:
        raise UserError("there are no links to score; choose a split or frequencies with at least one test link")
    error = np.abs(predicted.astype(np.float64) - truth)
    if not np.isfinite(error).all():
        raise UserError(
            f"{int((~np.isfinite(error)).sum())} of {len(error)} predicted powers are not finite; the model diverged"
        )
    rows = [{"frequency_ghz": float(f / 1e9)} | _summary(error[frequencies_hz == f]) for f in np.unique(frequencies_hz)]
    return _summary(error) | {"per_frequency": rows}


def power_figures(predicted: Float[np.ndarray, " n"], dataset: Dataset, index: Int[np.ndarray, " n"]) -> dict[str, Any] | None:
    """Returns the report of predicted powers, and that of the baselines: free_space (Friis over the straight line) and, if the
    receivers received anything in the training data, nearest_tx (the power of the nearest training transmitter that was
    received at the same frequency). None if the data contain no powers.

    Raises:
        UserError: as `score_power`.
    """
    report = score_received(predicted, dataset, index)
    if report is None:
        return None
    others = {"free_space": free_space(dataset, index)}
    lending = _with_received_training(dataset)
    if can_lend(lending, index[_received(dataset, index)]):
        others["nearest_tx"] = nearest_power(dataset, index)
    return report | {"baselines": {name: score_received(values, dataset, index) for name, values in others.items()}}


def score_received(predicted: Float[np.ndarray, " n"], dataset: Dataset, index: Int[np.ndarray, " n"]) -> dict[str, Any] | None:
    """Returns the report of predicted powers of links, omitting those without received power; None if the data contain no
    powers, or only snapshots in which nothing was received."""
    truth = dataset.received_db(index)
    if truth is None:
        return None
    received = truth > NO_PATH_DB
    if dataset.has_spectra and not received.any():
        return None
    return score_power(predicted[received], truth[received], dataset.frequencies_hz[index[received]])


def calibrate_power(
    confidence: PowerConfidence, predicted: Float[np.ndarray, " n"], dataset: Dataset, index: Int[np.ndarray, " n"]
) -> dict[str, Any] | None:
    """Returns the calibration of the error bounds of predicted powers (`power_calibration`); None if the data contain no
    powers."""
    truth = dataset.received_db(index)
    if truth is None:
        return None
    received = truth > NO_PATH_DB
    receivers = jnp.asarray(dataset.rx_positions(index[received]), jnp.float32)
    expected = _expected_power(
        confidence, jnp.asarray(predicted[received], jnp.float32), dataset.query(index[received]), receivers
    )
    return power_calibration(
        expected, np.abs(predicted[received].astype(np.float64) - truth[received]), float(confidence.level)
    )


_expected_power = jax.jit(expected_power)


def free_space(dataset: Dataset, index: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns the power (dB) over the unobstructed straight line."""
    distance = np.linalg.norm(dataset.tx_positions[index] - dataset.rx_positions(index), axis=-1)
    return np.asarray(free_space_db(jnp.asarray(np.maximum(distance, 1e-3)), jnp.asarray(dataset.frequencies_hz[index])))


def nearest_power(dataset: Dataset, index: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns the power (dB) of the nearest training transmitter that was received at the same frequency and receiver; silence
    at receivers that received none."""
    lending = _with_received_training(dataset)
    known = np.isin(dataset.receiver_index[index], dataset.receiver_index[lending.train])
    powers = np.full(len(index), NO_PATH_DB, np.float32)
    found = dataset.received_db(nearest_links(dataset, index[known], lending.train))
    assert found is not None
    powers[known] = found
    return powers


def _received(dataset: Dataset, index: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Returns on which links something was received."""
    powers = dataset.received_db(index)
    assert powers is not None
    return powers > NO_PATH_DB


def _with_received_training(dataset: Dataset) -> Dataset:
    """Returns a dataset with only those training links on which something was received."""
    return dataclasses.replace(dataset, train=dataset.train[_received(dataset, dataset.train)])


def _summary(error: Float[np.ndarray, " n"]) -> dict[str, Any]:
    return {"n": len(error), "power_error_db": float(np.median(error)), "power_mae_db": float(error.mean())}


Part = Literal["test", "validation"]
"""Held-out part: "test" for the final figures, "validation" for choices."""


def evaluate(
    trained: TrainedField, dataset: Dataset, part: Part = "test", shown: bool = False, timed: bool = False
) -> tuple[dict[str, Any], Float[np.ndarray, "n 90 360"]]:
    """Returns the report of a field on a dataset's held-out links, ready for JSON, and the predicted spectra (n, 90, 360).

    Args:
        trained: a trained field.
        dataset: the data of its run, or others of the same kind.
        part: "test" or "validation".
        shown: print progress on stderr.
        timed: also measure the time of a query, `ms_per_pas` in blocks and `ms_per_pas_single`, which compiles two programs.

    Returns:
        The report, {figure: value}, and the spectra (n, 90, 360) in the order of the held-out links.

    Raises:
        UserError: nothing is held out, or the field does not predict the kind of observation in the data.

    Example:
        >>> report, spectra = evaluate(trained, trained.dataset())  # doctest: +SKIP
    """
    index = held_out(dataset, part)
    tested = part == "test"
    if not tested and trained.correction is not None:  # residual kriging uses the validation part
        left = without_queried(trained.correction, dataset.query(index))
        trained = dataclasses.replace(trained, correction=left)
    reference = with_validation_trained(dataset) if tested else dataset
    with _Beside() as beside:
        calls = timed_calls(trained, dataset) if timed else {}
        compiled = [beside.submit(call) for call in calls.values()]
        truth: Future[Truth] | None = None
        rivals: dict[str, Future[dict[str, Any]]] = {}
        if dataset.has_spectra:
            truth = beside.submit(true_spectra, dataset, index)
            lent = lending_baselines(reference, index)
            rivals = {name: beside.submit(_score_baseline, predict, index, truth) for name, predict in lent.items()}
        with CountProgress("predicted spectra", len(index), shown=shown) as progress:
            predictions = observe(trained, dataset, index, progress.advance)
            for call in compiled:
                call.result()
        scores: dict[str, Any] = {}
        with CountProgress("scores of simple methods", len(rivals), shown=shown) as progress:
            for name, rival in rivals.items():
                scores[name] = rival.result()
                progress.advance()
    report = {"scene": dataset.name, "field": trained.origin()["field"], "part": part}
    power_db = power_of(predictions, dataset)
    with Pulse(lambda: "scores of received power and of snapshots", shown):
        power = None if power_db is None else power_figures(power_db, reference, index)
        if power_db is not None and power and trained.power_intervals and tested:  # fitted to the validation part
            calibrated = calibrate_power(trained.power_intervals, power_db, dataset, index)
            power |= {} if calibrated is None else {"confidence_db": calibrated}
        own = own_scores(predictions, dataset, index)
    if truth is None:
        return report | own | (power or {}) | time_queries(calls), np.asarray(predictions.pas)
    true = truth.result()
    with Pulse(lambda: "scores of the field, prediction intervals" + timed * ", time of a query", shown):
        spectra, ssim = score_spectra(np.asarray(predictions.pas), true, dataset, index)
        report |= spectra | {"baselines": scores}
        noisy = as_observed(trained.field, trained.params, np.asarray(predictions.pas))
        if not np.array_equal(noisy, predictions.pas):
            ssim = metrics.ssim(noisy, true.pas)
            report["as_observed"] = {"median_ssim": float(np.median(ssim)), "mean_ssim": float(np.mean(ssim))}
        report |= own | ({"power": power} if power else {})
        intervals = trained.intervals
        if (
            tested
            and intervals is not None
            and (expected := expectations(intervals, dataset, index, np.asarray(predictions.pas), power_db))
        ):
            calibrated = calibration(expected, ssim, float(intervals.level))  # scored as it was fitted
            report |= {} if calibrated is None else {"confidence": calibrated}
        report |= time_queries(calls)
    return report, np.asarray(predictions.pas)


class _Beside(ThreadPoolExecutor):
    """One more thread, for work that others do not wait for while programs compile; what has not begun at an error is
    dropped."""

    def __init__(self) -> None:
        super().__init__(1)

    def __exit__(self, *exception: Any) -> None:
        self.shutdown(cancel_futures=True)


class Truth(NamedTuple):
    """Observed spectra of N links, and what scores are grouped by."""

    pas: Float[np.ndarray, "n 90 360"]
    frequencies_hz: Float[np.ndarray, " n"]
    sight: Bool[np.ndarray, " n"] | None
    """Whether there is a line of sight; None without a mesh."""
    element_positions: Float[Array, "elements 3"]

    def score(self, pas: Float[np.ndarray, "n 90 360"]) -> dict[str, Any]:
        """Returns the report of predicted spectra (`metrics.score`)."""
        return metrics.score(pas, *self)


def true_spectra(dataset: Dataset, index: Int[np.ndarray, " n"]) -> Truth:
    """Returns the observed spectra of links; computing them from snapshots, and lines of sight, takes seconds."""
    pas, elements = np.asarray(dataset.pas(index)), dataset.receiver().element_positions
    return Truth(pas, dataset.frequencies_hz[index], in_sight(dataset, index), elements)


def score_spectra(
    pas: Float[np.ndarray, "n 90 360"], truth: Truth, dataset: Dataset, index: Int[np.ndarray, " n"]
) -> tuple[dict[str, Any], Float[np.ndarray, " n"]]:
    """Returns the report of spectra predicted for links, with the repeatability of the scene beside it, and the SSIM of each.

    Args:
        pas: predicted spectra.
        truth: observed spectra.
        dataset: the data.
        index: indices of the links.

    Raises:
        UserError: a prediction is NaN or infinite.
    """
    figures = metrics.figures(pas, truth.pas, truth.element_positions)
    report = metrics.summarise(figures, truth.frequencies_hz, truth.sight, dataset.receiver_index[index])
    repeats = repeatability(dataset.name, np.unique(truth.frequencies_hz) / 1e9)
    return report | ({} if repeats is None else {"truth_repeats": repeats}), figures["ssim"]


def lending_baselines(reference: Dataset, index: Int[np.ndarray, " n"]) -> dict[str, Baseline]:
    """Returns the baselines that can predict links from the training links of `reference`, by name."""
    return baselines(reference) if can_lend(reference, index) else {}


def _score_baseline(predict: Baseline, index: Int[np.ndarray, " n"], truth: Future[Truth]) -> dict[str, Any]:
    return truth.result().score(np.asarray(predict(index)))


def expectations(
    confidence: Confidence | None,
    dataset: Dataset,
    index: Int[np.ndarray, " n"],
    pas: Float[np.ndarray, "n 90 360"],
    power_db: Float[np.ndarray, " n"] | None,
) -> Expected | None:
    """Returns expected scores and intervals of the predictions for links; None if none were fitted for one of their
    receivers."""
    receiver = dataset.receiver_index[index]
    learned = {number: for_receiver(confidence, dataset.receiver(number)) for number in np.unique(receiver).tolist()}
    if any(own is None for own in learned.values()):
        return None
    expected = Expected(*np.empty((3, len(index)), np.float32))
    for number, of_one in learned.items():
        own = np.flatnonzero(receiver == number)
        queries = dataset.tx_positions[index[own]], dataset.frequencies_hz[index[own]]
        found = expect_many(of_one, pas[own], *queries, None if power_db is None else power_db[own])
        for column, values in zip(expected, found, strict=True):
            column[own] = values
    return expected


def held_out(dataset: Dataset, part: Part) -> Int[np.ndarray, " n"]:
    """Returns the indices of the held-out links.

    Raises:
        UserError: there are none.
    """
    index = getattr(dataset, part)
    if not len(index):
        raise UserError(f"{dataset.name} has no {part} spectra; choose another split")
    return index


def power_of(predictions: Observation, dataset: Dataset) -> Float[np.ndarray, " n"] | None:
    """Returns the received powers predicted by a field; None if it predicts none.

    Raises:
        UserError: the data contain only powers, which the field does not predict.
    """
    if predictions.power_db is None and not dataset.has_spectra:
        raise UserError(
            f"{dataset.name} contains {dataset.observed.words}, which this field does not predict; choose another field"
        )
    return None if predictions.power_db is None else np.asarray(predictions.power_db)


def score_snapshots(predicted: Complex[np.ndarray, "n elements"], truth: Complex[np.ndarray, "n elements"]) -> dict[str, float]:
    """Returns medians of the correlation |y^H y'| / (|y| |y'|) and of the power error (dB) over links with a received signal;
    empty if there are none."""
    received = truth.any(-1)
    if not received.any():
        return {}
    a, b = (jnp.asarray(snapshots[received]) for snapshots in (truth, predicted))
    error = jnp.abs(channel.received_power_db(b) - channel.received_power_db(a))
    return {
        "snapshot_correlation": float(jnp.median(channel.correlation(a, b))),
        "power_error_db": float(jnp.median(error)),
    }


SCORES: dict[str, Callable[[Observation, np.ndarray], dict[str, float]]] = {
    "snapshots": lambda seen, truth: {} if seen.snapshots is None else score_snapshots(np.asarray(seen.snapshots), truth),
}
"""Additional scores for some kinds of observation, besides those of spectra and received power: (predictions for n links, what
was observed on them) -> scores; empty if the predictions contain nothing comparable."""


def own_scores(seen: Observation, dataset: Dataset, index: Int[np.ndarray, " n"]) -> dict[str, float]:
    """Returns the additional scores (`SCORES`) for the observations of links."""
    kinds = [name for name in dataset.observations if name in SCORES]
    return {key: value for name in kinds for key, value in SCORES[name](seen, dataset.observations[name][index]).items()}


def watch(field: Field, params: Params, dataset: Dataset, index: Int[np.ndarray, " n"]) -> dict[str, float]:
    """Returns the figure of held-out links shown in the training curves."""
    predictions = observe_links(field, params, dataset, index)
    power_db = power_of(predictions, dataset)
    if not dataset.has_spectra and power_db is not None and (report := score_received(power_db, dataset, index)):
        return {"held_out_power_error_db": report["power_error_db"]}
    noisy = as_observed(field, params, np.asarray(predictions.pas))
    return {"held_out_ssim": float(np.median(metrics.ssim(noisy, np.asarray(dataset.pas(index)))))}


TIMED = {"ms_per_pas": BLOCK, "ms_per_pas_single": 1}
"""Queries of a call that is timed, by the name of the figure."""


def timed_calls(trained: TrainedField, dataset: Dataset) -> dict[str, Callable[[], None]]:
    """Returns the calls that `time_queries` measures, by the names of its figures. The first one of each compiles."""
    plan = trained.field.plan(trained.params, dataset.receiver())
    neighbours = for_receiver(trained.correction, dataset.receiver())
    timed = dataset.test if len(dataset.test) else dataset.train

    def call(size: int) -> None:
        query = dataset.query(np.resize(timed, size))
        jax.block_until_ready(render_pas(trained.field, trained.params, plan, query, neighbours))

    return {name: partial(call, size) for name, size in TIMED.items()}


def time_queries(calls: dict[str, Callable[[], None]], repeats: int = 7) -> dict[str, float]:
    """Returns milliseconds per PAS, for single queries and in blocks: medians over repeats of calls that are compiled."""
    result = {}
    for name, call in calls.items():
        seconds = []
        for _ in range(repeats):
            begin = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - begin)
        result[name] = round(1e3 * float(np.median(seconds)) / TIMED[name], 3)
    return result
