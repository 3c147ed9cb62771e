"""Calibration of the antennas of transmitters and elements whose pattern is unknown, and of array gains.

Candidates are the isotropic antenna, the short dipole and the directional element of 3GPP TR 38.901, oriented along the axes.
All transmitters have the same antenna. A wrong antenna distorts the power of every path: in the authors' published sample the
transmitters point along the scene's -z axis, and a field with isotropic ones is less accurate than the mean image for half of
the transmitters.

Array gains are the complex gains of elements by which measured snapshots differ from predicted ones: cables and receivers of an
array differ by degrees and decibels. They are assumed to be independent of the frequency. With x_i the predicted and y_i the
measured snapshot of link i, the gains g and a factor c_i for every link minimise

    sum_i  w_i |y_i - c_i g x_i|^2,    w_i = 1 / (1 - correlation^2 of y_i and g x_i)

alternately for c, w and g. This is a calibration by known sources, with the field in place of the sources. The gains are
estimated on half of the spectra in use, and kept if the other half fits significantly better with them.
"""

import dataclasses
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.spatial.transform import Rotation

from wbgs_jax._util.pytree import replaced
from wbgs_jax.config import CalibrationConfig
from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import WaveParams
from wbgs_jax.fields.losses import GOOD_MATCH
from wbgs_jax.radio.antenna import PATTERN_EXPONENTS, Antenna
from wbgs_jax.training.calibration.objective import CalibrationProblem, Scores, by_transmitter, predicted, surely_better

AXES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}
ENDS = "transmitter", "element"
"""Parameters whose antennas are calibrated."""
UP = ("+x", "+y", "+z")
"""Directions of an antenna's z axis; an opposite direction only changes the sign."""
FEW = 20
"""Number of transmitters below which pairs of antennas are tried."""
LARGE, SURE_OF_LARGE = 0.3, 1.5
"""A large gain (natural logarithm: the error is reduced by a quarter) must be significant by fewer standard errors. With few
transmitters it is much worse to miss the correct antenna than to take a wrong one that gains nothing; docs/history.md lists the
probabilities of both."""
LARGE_OF_PAIR, PAIR_SPECTRA = 0.5, 32
"""Gain that a pair of antennas must have, and number of spectra on which pairs are compared."""


@dataclass(frozen=True)
class AntennaReport:
    """Result of the calibration of antennas."""

    before: float
    """Mean score of the spectra with the initial antennas."""
    after: float
    """Mean score of the spectra with the chosen antennas."""
    taken: dict[str, str]
    """Descriptions of new antennas of the transmitters and of the elements; unchanged antennas are not listed."""


def antenna_candidates() -> dict[str, Antenna]:
    """Returns the candidate antennas by description."""
    found = {}
    for up in UP:
        for pattern in ("iso", "dipole"):
            forward = next(axis for axis in UP if axis != up)
            found[f"{pattern} along {up}"] = _antenna(pattern, forward, up)
        for forward in AXES:
            if forward[1] != up[1]:
                found[f"tr38901 along {up} towards {forward}"] = _antenna("tr38901", forward, up)
    return found


def _antenna(pattern: str, forward: str, up: str) -> Antenna:
    x, z = np.array(AXES[forward], float), np.array(AXES[up], float)
    quaternion = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], -1)).as_quat()
    return Antenna(
        jnp.asarray(np.roll(quaternion, 1), jnp.float32), jnp.asarray(PATTERN_EXPONENTS[pattern], jnp.float32)
    )  # SciPy has w last


def search_pair(
    params: WaveParams, score: Scores, tx_index: Int[np.ndarray, " n"], known_elements: bool
) -> tuple[WaveParams, dict[str, str]]:
    """Returns parameters with the antennas that `choose_pair` chooses for few transmitters, and descriptions of those that are
    new; unchanged parameters for many transmitters, and for a single one.

    Args:
        params: parameters.
        score: scores of candidates.
        tx_index: transmitters of the scored spectra.
        known_elements: whether the data define the pattern of the elements, which is then unchanged.
    """
    if not 1 < len(np.unique(tx_index)) < FEW:
        return params, {}
    tx_index = tx_index[:PAIR_SPECTRA]
    elements, transmitters = ([{}, *({end: name} for name in antenna_candidates())] for end in reversed(ENDS))
    elements = elements[:1] if known_elements else elements
    pairs = [element | transmitter for element in elements for transmitter in transmitters]
    # Arrays of its own for each end, since training donates each of them once.
    antennas = {end: antenna_candidates() for end in ENDS}
    tried = [replaced(params, **{end: antennas[end][name] for end, name in pair.items()}) for pair in pairs]
    scores = by_transmitter(score(tried, len(tx_index)), tx_index)
    element, transmitter = choose_pair(scores.reshape(len(elements), len(transmitters), -1))
    best = element * len(transmitters) + transmitter
    return tried[best], pairs[best]


def choose_pair(scores: Float[np.ndarray, "k m n"]) -> tuple[int, int]:
    """Returns the best antenna of the elements and that of the transmitters, by number; 0 is the present one.

    Few transmitters are little evidence of either end, but sufficient for both together. Both the gain and the choice between
    one end and both are cross-validated (`gains_of_chosen`).

    Args:
        scores: score of each of N transmitters by antenna of the elements and of the transmitters.
    """
    best, largest = (0, 0), LARGE_OF_PAIR
    for some in (scores[:1], scores[:, :1], scores) if scores.shape[-1] > 1 else ():
        flat = some.reshape(-1, scores.shape[-1])
        if len(flat) > 1 and (gain := gains_of_chosen(flat).mean()) > largest:
            place = np.unravel_index(1 + flat[1:].sum(1).argmin(), some.shape[:2])
            best, largest = (int(place[0]), int(place[1])), gain
    return best


def search_antennas(
    params: WaveParams,
    score: Scores,
    tx_index: Int[np.ndarray, " n"],
    config: CalibrationConfig,
    known_elements: bool,
) -> tuple[WaveParams, AntennaReport]:
    """Returns parameters with the antennas that score best, chosen alternately for transmitters and elements. An antenna is
    replaced only if the new one is significantly better, or better by a large amount.

    Args:
        params: parameters.
        score: scores of candidates.
        tx_index: transmitters of the scored spectra.
        config: settings of the calibration.
        known_elements: whether the data define the pattern of the elements, which is then unchanged.
    """
    taken, settled, before, after = dict[str, str](), 0, np.zeros(1), np.zeros(1)
    ends = ENDS[:1] if known_elements else ENDS
    for turn in range(config.antenna_rounds * len(ends)):
        end, candidates = ends[turn % len(ends)], antenna_candidates()  # new arrays, since training donates each of them once
        tried = [params, *(replaced(params, **{end: antenna}) for antenna in candidates.values())]
        scores = score(tried)
        best = 1 + int(np.argmin(scores[1:].mean(1)))
        before, after = before if turn else scores[0], scores[0]
        settled += 1
        if surely_better(scores[0] - scores[best], tx_index, config.antenna_n_sigma) or gains_much(scores, tx_index):
            taken[end], params, after, settled = list(candidates)[best - 1], tried[best], scores[best], 1
        if settled == len(ends):  # the other end has not changed since this one was scored
            break
    return params, AntennaReport(float(before.mean()), float(after.mean()), taken)


def gains_much(scores: Float[np.ndarray, "k n"], tx_index: Int[np.ndarray, " n"]) -> bool:
    """Returns whether the best of several candidates gains more than `LARGE` over the first one."""
    gains = gains_of_chosen(by_transmitter(scores, tx_index))
    return bool(gains.mean() > LARGE and surely_better(gains, np.arange(len(gains)), SURE_OF_LARGE))


def gains_of_chosen(scores: Float[np.ndarray, "k n"]) -> Float[np.ndarray, " n"]:
    """Returns the gain over the first candidate for each of N transmitters, if another one is chosen with the remaining
    transmitters, so that the selection does not bias it."""
    chosen = 1 + (scores.sum(1, keepdims=True) - scores)[1:].argmin(0)
    gains: Float[np.ndarray, " n"] = scores[0] - scores[chosen, np.arange(scores.shape[1])]
    return gains


FEWEST = 32
"""Minimum number of snapshots of a receiver; with fewer its array is not calibrated."""


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


def search_tuning(
    params: WaveParams, problem: CalibrationProblem, config: CalibrationConfig
) -> tuple[Calibratable, TuningReport]:
    """Returns the field with calibrated array gains if these fit significantly better, else unchanged. `params` are its
    parameters, and `problem` has snapshots; of the `array_gain_spectra`, half serve to estimate the gains, half to test
    them."""
    field, links = problem.field, problem.data.links
    chosen = problem.spectra[: config.array_gain_spectra]
    half = np.unique(np.asarray(links.tx_index)[chosen], return_inverse=True)[1] % 2 == 0
    tuned = field.with_gains(gains_of(field, params, problem, chosen[half]))
    held_out = dataclasses.replace(problem, spectra=chosen[~half])
    before, after = (dataclasses.replace(held_out, field=one).scores(compared="spectra")([params])[0] for one in (field, tuned))
    kept = surely_better(before - after, held_out.tx_index(), config.array_gain_n_sigma)
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
    rounds = 20  # iterations of least squares
    for _ in range(rounds if len(x) else 0):
        tuned = gains * x
        factor = np.sum(tuned.conj() * y, 1) / np.maximum(_power(tuned), np.finfo(float).tiny)
        left = _power(y - factor[:, None] * tuned)
        weighted = (1 / (left + GOOD_MATCH))[:, None] * factor.conj()[:, None] * x.conj()
        gains = np.sum(weighted * y, 0) / np.maximum(np.sum(weighted * factor[:, None] * x, 0).real, 1e-30)
        gains = gains / np.sqrt(np.mean(np.abs(gains) ** 2)) * np.exp(-1j * np.angle(np.sum(gains)))
    return gains


def _power(snapshots: Complex[np.ndarray, "n elements"]) -> Float[np.ndarray, " n"]:
    return np.sum(np.abs(snapshots) ** 2, -1)
