"""Calibration of array gains, the complex gains of elements by which measured snapshots differ from predicted ones.

Cables and receivers of an array differ by degrees and decibels; the gains are assumed to be independent of the frequency. With
x_i the predicted and y_i the measured snapshot of link i, the gains g and a factor c_i for every link minimise

    sum_i  w_i |y_i - c_i g x_i|^2,    w_i = 1 / (1 - correlation^2 of y_i and g x_i)

alternately for c, w and g. This is a calibration by known sources, with the field in place of the sources. The gains are
estimated on half of the spectra in use, and kept if the other half fits significantly better with them.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float, Int

from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import WaveParams
from wbgs_jax.fields.losses import GOOD_MATCH
from wbgs_jax.training.calibration.objective import CalibrationProblem, predicted, surely_better

ROUNDS = 20
"""Iterations of least squares."""
FEWEST = 32
"""Minimum number of snapshots of a receiver; with fewer its array is not calibrated."""
SURE = 3.0
"""n_sigma: standard errors over transmitters by which the gains must improve the fit (`surely_better`)."""


@dataclass(frozen=True)
class TuningReport:
    """Result of the calibration of array gains."""

    before: float
    """Mean score of spectra without new gains."""
    after: float
    """Mean score of spectra with the gains."""
    kept: bool
    """Whether the gains are used."""
    phase_deg: float
    """Standard deviation of the phases of elements."""
    amplitude_db: float
    """Standard deviation of the amplitudes of elements."""


def search_tuning(params: WaveParams, problem: CalibrationProblem, count: int) -> tuple[Calibratable, TuningReport]:
    """Returns the field with calibrated array gains if these fit significantly better, else unchanged. `params` are its
    parameters, and `problem` has snapshots; `count` spectra are used: the gains are estimated on half of them and tested on the
    other half."""
    field, links = problem.field, problem.data.links
    chosen = problem.spectra[:count]
    half = np.unique(np.asarray(links.tx_index)[chosen], return_inverse=True)[1] % 2 == 0
    tuned = field.with_gains(gains_of(field, params, problem, chosen[half]))
    held_out = dataclasses.replace(problem, spectra=chosen[~half])
    before, after = (dataclasses.replace(held_out, field=one).scores(compared="spectra")([params])[0] for one in (field, tuned))
    kept = surely_better(before - after, held_out.tx_index(), SURE)
    phase, amplitude = (np.sqrt(np.mean(np.square(part - part.mean()))) for part in _parts(tuned))
    report = TuningReport(float(before.mean()), float(after.mean()), kept, float(np.rad2deg(phase)), float(amplitude))
    return tuned if kept else field, report


def _parts(tuned: Calibratable) -> tuple[np.ndarray, np.ndarray]:
    """Returns phases (radians) and amplitudes (dB) of all elements."""
    tuning = np.asarray(tuned.tuning, np.float64)
    return tuning[..., 1], 20 / np.log(10) * tuning[..., 0]


def gains_of(
    field: Calibratable, params: WaveParams, problem: CalibrationProblem, spectra: Int[np.ndarray, " n"]
) -> Complex[np.ndarray, "r elements"]:
    """Returns the gains of the elements of all receivers, 1 for receivers with too few snapshots. Their mean phase is 0 and
    their root mean square 1, since a common factor is not observable."""
    receiver = np.asarray(problem.data.links.receiver_index)[spectra]
    positions = problem.data.receivers.element_positions
    assert problem.data.snapshots is not None, "array gains are estimated from snapshots"
    measured, gains = np.asarray(problem.data.snapshots), np.ones(positions.shape[:2], complex)
    for number in np.unique(receiver):
        own = spectra[receiver == number]
        if len(own) >= FEWEST:
            of_receiver = dataclasses.replace(problem, field=field, spectra=own)
            gains[number] = least_squares(predicted(of_receiver, params, "snapshots"), measured[own])
    return gains


def least_squares(
    predicted: Complex[np.ndarray, "n elements"], measured: Complex[np.ndarray, "n elements"]
) -> Complex[np.ndarray, " elements"]:
    """Returns the gains that turn predicted snapshots into measured ones, each up to a complex factor."""
    power = _power(predicted) * _power(measured)
    usable = np.isfinite(power) & (power > 0)
    x, y = (part[usable].astype(complex) / np.sqrt(_power(part[usable]))[:, None] for part in (predicted, measured))
    gains = np.ones(predicted.shape[1], complex)
    for _ in range(ROUNDS if len(x) else 0):
        tuned = gains * x
        factor = np.sum(tuned.conj() * y, 1) / np.maximum(_power(tuned), np.finfo(float).tiny)
        left = _power(y - factor[:, None] * tuned)
        weighted = (1 / (left + GOOD_MATCH))[:, None] * factor.conj()[:, None] * x.conj()
        gains = np.sum(weighted * y, 0) / np.maximum(np.sum(weighted * factor[:, None] * x, 0).real, 1e-30)
        gains = gains / np.sqrt(np.mean(np.abs(gains) ** 2)) * np.exp(-1j * np.angle(np.sum(gains)))
    return gains


def _power(snapshots: Complex[np.ndarray, "n elements"]) -> Float[np.ndarray, " n"]:
    return np.sum(np.abs(snapshots) ** 2, -1)
