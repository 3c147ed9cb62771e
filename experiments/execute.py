"""Run one job: train its models, score them, and put the result together. What is done of a job is kept in its folder."""

import dataclasses
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from experiments.jobs import BASELINES, PICTURED_GHZ, Job
from experiments.profiles import PROFILES
from experiments.settings import settings
from wbgs_jax import metrics
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.files import atomic_write, read_arrays
from wbgs_jax.config import Settings
from wbgs_jax.data import Dataset
from wbgs_jax.evaluation.baselines import baselines
from wbgs_jax.evaluation.report import environment
from wbgs_jax.fields import default_field
from wbgs_jax.inference.predictor import corrected, predict_spectra
from wbgs_jax.inference.trained_field import RunConfig
from wbgs_jax.training.fit_kriging import learn_neighbours
from wbgs_jax.training.loop import train
from wbgs_jax.training.run_folder import prepare_folder

CURVE_POINTS = 200
ENVIRONMENT = environment()
"""Read when this code is: what is committed while it runs is not what ran."""
BLOCK = 256
"""Spectra scored at a time."""


@dataclass(frozen=True)
class Part:
    """Results of one trained model of a job."""

    tx: Int[np.ndarray, " tx"]
    ghz: Float[np.ndarray, " ghz"]
    ssim: Float[np.ndarray, "tx ghz"]
    psnr_db: Float[np.ndarray, "tx ghz"]
    curve: Float[np.ndarray, "2 points"]
    """Steps and training losses."""
    sizes: Int[np.ndarray, "2"]
    """Steps, and Gaussians at the end."""
    seconds: Float[np.ndarray, "2"]
    """Durations of training and of evaluation."""
    pictures: UInt8[np.ndarray, "k 90 360"]


def execute(job: Job, folder: Path, may_go_on: Callable[[], None] = lambda: None) -> tuple[dict[str, Any], np.ndarray | None]:
    """Train and score a job, or go on with it: its result, and its pictures (k, 90, 360) if they are kept.

    `may_go_on` is called where stopping loses nothing, and raises if the job is to stop.
    """
    origin = {"profile": job.profile, "environment": ENVIRONMENT}
    if job.field == BASELINES:
        return baseline_scores(job) | origin, None
    chosen = settings(job)
    parts = [part(job, dataset, chosen, folder / name, may_go_on) for name, dataset in job.models()]
    pictures = np.concatenate([p.pictures for p in parts]) if job.pictured else None
    return merged(parts, chosen.optim.batch) | {"preset": PROFILES[job.profile].preset} | origin, pictures


def part(job: Job, dataset: Dataset, chosen: Settings, folder: Path, may_go_on: Callable[[], None]) -> Part:
    """Train one model and score it, unless that is done."""
    trained_ghz = job.train_ghz if job.combination else ()
    preset = PROFILES[job.profile].preset
    config = RunConfig(job.scene, job.field, preset, job.seed, None, chosen, trained_ghz, validation=0.0)
    prepare_folder(folder, config, resume=True)  # refuses what other settings have begun
    done = folder / "part.npz"
    if done.exists():
        return Part(**read_arrays(done, "finished part", "remove it, and the same command makes it again"))
    trained = train(dataset, job.field, chosen, job.seed, folder, resume=True)
    may_go_on()
    begin = time.perf_counter()
    predicted = predict_spectra(trained.field, trained.params, dataset, dataset.test)
    if job.field == default_field():
        beside = learn_neighbours(trained.field, trained.params, dataset).neighbours
        predicted = corrected(beside, predicted, dataset, dataset.test)
    scores = score(dataset, predicted)
    seconds = np.array([trained.seconds, time.perf_counter() - begin])
    sizes = np.array([trained.steps, trained.sizes.get("gaussians", 0)])
    shown = pictured(dataset) if job.pictured else np.zeros(0, int)
    pictures = (np.clip(predicted[shown], 0, 1) * 255).round().astype(np.uint8)
    result = Part(**scores, curve=curve(folder), sizes=sizes, seconds=seconds, pictures=pictures)
    with atomic_write(done) as stream:
        np.savez_compressed(stream, **{f.name: getattr(result, f.name) for f in dataclasses.fields(result)})
    return result


def score(dataset: Dataset, predicted: Float[np.ndarray, "n 90 360"]) -> dict[str, np.ndarray]:
    """Returns SSIM and PSNR of the test spectra, by transmitter (and receiver) and frequency.

    Raises:
        UserError: a transmitter has no test spectrum at a frequency, or two at one.
    """
    test = dataset.test
    test_ghz = dataset.frequencies_hz[test] / 1e9
    ghz = np.unique(test_ghz)
    order = np.lexsort((test_ghz, dataset.receiver_index[test], dataset.tx_index[test]))
    if len(test) % len(ghz) or not np.array_equal(test_ghz[order], np.resize(ghz, len(test))):
        raise UserError(
            f"{dataset.name}: not every test transmitter has one spectrum at every frequency, which tables by frequency need; "
            "leave the others out of test_index.txt"
        )
    tx = dataset.tx_index[test[order]][:: len(ghz)]
    ssim, psnr = np.zeros(len(test)), np.zeros(len(test))
    for start in range(0, len(test), BLOCK):  # the truth of a whole scene is hundreds of megabytes
        block = slice(start, start + BLOCK)
        truth = np.asarray(dataset.pas(test[block]))
        ssim[block], psnr[block] = metrics.ssim(predicted[block], truth), metrics.psnr_db(predicted[block], truth)
    shape = (len(tx), len(ghz))
    return {"tx": tx, "ghz": ghz, "ssim": ssim[order].reshape(shape), "psnr_db": psnr[order].reshape(shape)}


def pictured(dataset: Dataset) -> Int[np.ndarray, " k"]:
    """Returns the places in `dataset.test` of the spectra that figure 4 shows: another transmitter at every frequency."""
    ghz, transmitters = dataset.frequencies_hz[dataset.test] / 1e9, dataset.tx_index[dataset.test]
    shown = np.random.default_rng([0, 6]).permutation(np.unique(transmitters))[
        np.arange(len(PICTURED_GHZ)) % len(set(transmitters))
    ]
    return np.concatenate(
        [np.flatnonzero(np.isclose(ghz, f) & (transmitters == tx)) for f, tx in zip(PICTURED_GHZ, shown, strict=True)]
    )


def curve(folder: Path) -> Float[np.ndarray, "2 points"]:
    """Returns steps and losses of a run, thinned to at most `CURVE_POINTS` by averaging neighbours."""
    entries = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    points = np.array([(e["step"], e["loss"]) for e in entries if "loss" in e])
    thin = -(-len(points) // CURVE_POINTS)
    return np.array([block.mean(0) for block in np.split(points, range(thin, len(points), thin))]).T


def merged(parts: list[Part], batch: int) -> dict[str, Any]:
    """Returns the result of a job from those of its models."""
    ssim = {f"{f:g}": p.ssim[:, i] for p in parts for i, f in enumerate(p.ghz)}
    psnr = {f"{f:g}": float(np.median(p.psnr_db[:, i])) for p in parts for i, f in enumerate(p.ghz)}
    everything = np.concatenate(list(ssim.values()))
    steps, loss = np.mean([p.curve for p in parts], 0)
    n_steps = sum(int(p.sizes[0]) for p in parts)
    return {
        "models": len(parts),
        "median_ssim": rounded(np.median(everything)),
        "mean_ssim": rounded(everything.mean()),
        "average_of_medians": rounded(np.mean([np.median(values) for values in ssim.values()])),
        "psnr_db": {name: round(value, 2) for name, value in psnr.items()},
        "tx": parts[0].tx.tolist(),
        "ssim": {name: rounded(values) for name, values in ssim.items()},
        "curve": {"step": np.round(steps).astype(int).tolist(), "loss": rounded(loss)},
        "steps": n_steps,
        "samples": n_steps * batch,
        "gaussians": round(float(np.mean([p.sizes[1] for p in parts]))),
        "training_seconds": round(sum(float(p.seconds[0]) for p in parts), 1),
        "evaluation_seconds": round(sum(float(p.seconds[1]) for p in parts), 1),
    }


def baseline_scores(job: Job) -> dict[str, Any]:
    """Returns the median SSIM by frequency of the predictors that learn nothing."""
    dataset = job.dataset()
    begin = time.perf_counter()
    scores = {}
    for name, predictor in baselines(dataset).items():
        values = score(dataset, predictor(dataset.test))
        medians = np.median(values["ssim"], 0)
        scores[name] = {f"{f:g}": rounded(m) for f, m in zip(values["ghz"], medians, strict=True)}
    return {BASELINES: scores, "evaluation_seconds": round(time.perf_counter() - begin, 1)}


def rounded(values: Any) -> Any:
    """Returns four digits, as plain numbers."""
    return np.round(values, 4).tolist()
