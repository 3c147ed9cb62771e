"""Value of the frequency to a law of the spectrum that is smooth in it: `python -m experiments.studies.frequency_account`.

Nothing is trained. Every spectrum of the validation transmitters is predicted from the *true* spectra of the same transmitter
at the other frequencies: by their mean, which needs no frequency, by the four nearest and the four farthest, and pixel by pixel
by polynomials in the logarithm of the frequency (least squares; "half a line" has half of its slope). The frequency is worth to
such a law, at most, what a line gains over the mean. Writes experiments/results/frequency_account.json; docs/history.md
quotes it.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float

from experiments.results import FOLDER
from wbgs_jax import metrics
from wbgs_jax._util.cli import run_command
from wbgs_jax._util.files import write_json
from wbgs_jax.data import Dataset, load_dataset
from wbgs_jax.data.dataset import hold_out_validation
from wbgs_jax.evaluation.report import environment

NEIGHBOURS = 4
Spectra = Float[np.ndarray, "f 90 360"]
Others = Callable[[Spectra, Float[np.ndarray, " f"], float], Float[np.ndarray, "90 360"]]
"""(spectra of the other frequencies, logarithms of these, logarithm of the predicted one) -> prediction."""


@dataclass(frozen=True)
class Command:
    """Score predictions of a spectrum from the transmitter's spectra at other frequencies."""

    data: tyro.conf.Positional[tuple[str, ...]] = ("1", "2", "3", "4", "5", "6")
    """Released scenes, scene files or folders of the published layout."""
    out: Path = FOLDER


def main() -> None:
    """Entry point."""
    command = tyro.cli(Command, prog="python -m experiments.studies.frequency_account")
    scenes = {}
    for name in command.data:
        dataset = hold_out_validation(load_dataset(name))
        scenes[dataset.name] = account(dataset)
        print(f"{dataset.name:12}", scenes[dataset.name], file=sys.stderr)
    write_json(command.out / "frequency_account.json", {"scenes": scenes} | environment())


def mean(spectra: Spectra, logs: Float[np.ndarray, " f"], wanted: float) -> Float[np.ndarray, "90 360"]:
    """Returns the mean of all other frequencies."""
    return spectra.mean(0)


def nearest(spectra: Spectra, logs: Float[np.ndarray, " f"], wanted: float) -> Float[np.ndarray, "90 360"]:
    """Returns the mean of the nearest frequencies."""
    return spectra[np.argsort(np.abs(logs - wanted))[:NEIGHBOURS]].mean(0)


def farthest(spectra: Spectra, logs: Float[np.ndarray, " f"], wanted: float) -> Float[np.ndarray, "90 360"]:
    """Returns the mean of the farthest frequencies."""
    return spectra[np.argsort(np.abs(logs - wanted))[-NEIGHBOURS:]].mean(0)


def polynomial(degree: int, slope: float = 1) -> Others:
    """Returns the prediction by a polynomial in every pixel; the terms but the mean are multiplied by `slope`."""

    def predict(spectra: Spectra, logs: Float[np.ndarray, " f"], wanted: float) -> Float[np.ndarray, "90 360"]:
        powers = np.vander(np.append(logs, wanted) - logs.mean(), degree + 1, increasing=True)
        powers[:, 1:] -= powers[:-1, 1:].mean(0)  # so that the constant is the mean
        weights = (powers[-1] * np.append(1, np.full(degree, slope))) @ np.linalg.pinv(powers[:-1])
        return np.clip(np.tensordot(weights, spectra, 1), 0, 1)

    return predict


LAWS: dict[str, Others] = {
    "mean": mean,
    "nearest": nearest,
    "farthest": farthest,
    "half_a_line": polynomial(1, 0.5),
    "line": polynomial(1),
    "parabola": polynomial(2),
}


def account(dataset: Dataset) -> dict[str, float]:
    """Returns the average over the frequencies of the median SSIM over the validation transmitters, by law."""
    scores: dict[str, list[np.ndarray]] = {name: [] for name in LAWS}
    for tx in np.unique(dataset.tx_index[dataset.validation]):
        index = dataset.validation[dataset.tx_index[dataset.validation] == tx]
        index = index[np.argsort(dataset.frequencies_hz[index])]
        logs, truth = np.log10(dataset.frequencies_hz[index]), np.asarray(dataset.pas(index))
        for name, law in LAWS.items():
            others = [np.arange(len(index)) != i for i in range(len(index))]
            predicted = np.stack([law(truth[rest], logs[rest], logs[i]) for i, rest in enumerate(others)])
            scores[name].append(metrics.ssim(predicted.astype(np.float32), truth))
    return {name: round(float(np.median(np.array(values), 0).mean()), 4) for name, values in scores.items()}


if __name__ == "__main__":
    run_command(main)
