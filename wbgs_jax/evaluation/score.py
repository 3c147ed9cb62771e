"""How good a trained field is on held-out links: figures of every kind that field and data have, beside the baselines."""

import dataclasses
import time
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from wbgs_jax._util.errors import UserError
from wbgs_jax.data.dataset import Dataset
from wbgs_jax.data.repeatability import repeatability
from wbgs_jax.data.sight import in_sight
from wbgs_jax.data.splits import with_validation_trained
from wbgs_jax.evaluation import metrics
from wbgs_jax.evaluation.baselines import baselines, can_lend
from wbgs_jax.evaluation.beams import plane_normal
from wbgs_jax.evaluation.calibration import calibration
from wbgs_jax.evaluation.power import calibrate_power, power_figures, score_heard
from wbgs_jax.fields import Field, Observation
from wbgs_jax.inference.confidence import Confidence, Expected, expect_many
from wbgs_jax.inference.neighbours import for_receiver, without_asked
from wbgs_jax.inference.predictor import BLOCK, Trained, as_observed, observe, observe_links, render_pas
from wbgs_jax.radio import channel

Part = Literal["test", "validation"]
"""What is held out: for the final figures, or for choices."""


def evaluate(trained: Trained, dataset: Dataset, part: Part = "test") -> tuple[dict[str, Any], Float[np.ndarray, "n 90 360"]]:
    """Returns the report of a field on a dataset's held-out links, ready for JSON, and the predicted spectra (n, 90, 360).

    Raises:
        UserError: nothing is held out, or the field knows nothing of what was observed.
    """
    index = held_out(dataset, part)
    tested = part == "test"
    if not tested and trained.neighbours is not None:  # they know the validation part
        asked = without_asked(trained.neighbours, dataset.query(index))
        trained = dataclasses.replace(trained, neighbours=asked)  # type: ignore[type-var]
    others_know = with_validation_trained(dataset) if tested else dataset
    seen = observe(trained, dataset, index)
    report = {"scene": dataset.name, "field": trained.origin()["field"], "part": part}
    said = power_of(seen, dataset)
    power = None if said is None else power_figures(said, others_know, index)
    if said is not None and power and trained.power_confidence and tested:  # how sure it is, the validation part has told
        power |= {"confidence_db": calibrate_power(trained.power_confidence, said, dataset, index)}
    if dataset.kind == "power":
        return report | (power or {}) | time_queries(trained, dataset), np.asarray(seen.pas)
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
    if seen.snapshots is not None and dataset.snapshots is not None:
        report |= score_snapshots(np.asarray(seen.snapshots), dataset.snapshots[index])
    report |= {"power": power} if power else {}
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
    if seen.power_db is None and dataset.kind == "power":
        raise UserError(f"{dataset.name} holds received powers, of which this field knows nothing; choose another field")
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


def watch(field: Field, params: Any, dataset: Dataset, index: Int[np.ndarray, " n"]) -> dict[str, float]:
    """Returns the figure that the curves of a training show of some held-out links."""
    seen = observe_links(field, params, dataset, index)
    said = power_of(seen, dataset)
    if dataset.kind == "power" and said is not None and (report := score_heard(said, dataset, index)):
        return {"held_out_power_error_db": report["power_error_db"]}
    noisy = as_observed(field, params, np.asarray(seen.pas))
    return {"held_out_ssim": float(np.median(metrics.ssim(noisy, np.asarray(dataset.pas(index)))))}


def time_queries(trained: Trained, dataset: Dataset, repeats: int = 7) -> dict[str, float]:
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
