"""Elements of an array that are out of tune: complex gains by which snapshots differ from what their geometry says.

Cables and receivers of an array differ by degrees and decibels, at all frequencies alike as far as is known here. With x_i the
snapshot that a field says of link i and y_i the one that was heard, gains g and one factor c_i of every link make

    sum_i  w_i |y_i - c_i g x_i|^2,    w_i = 1 / (1 - correlation^2 of y_i and g x_i)

least, in turn for c, w and g: a calibration by known sources, the field in the place of the sources. It is found on half of the
spectra that are looked at, and believed where it explains the other half surely better.
"""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from wbgs_jax.fields.calibratable import Calibratable
from wbgs_jax.fields.coherent_model import PreparedPaths, WaveParams
from wbgs_jax.fields.losses import GOOD_MATCH
from wbgs_jax.training.batches import TrainingData
from wbgs_jax.training.calibration.objective import Told, surely_better

ROUNDS = 20
"""Of least squares."""
AT_ONCE = 8
"""Snapshots."""
FEWEST = 32
"""Snapshots of a receiver without which its array is taken as it is."""
SURE = 3.0
"""As many standard errors over transmitters as the gain has to be sure by (`surely_better`)."""


@dataclass(frozen=True)
class TuningReport:
    """What was found."""

    before: float
    """Mean score of spectra with arrays in tune ..."""
    after: float
    """... and with the gains."""
    kept: bool
    """Whether they are used."""
    phase_deg: float
    """Root mean square over elements of their phases ..."""
    amplitude_db: float
    """... and of their amplitudes."""


def search_tuning(params: WaveParams, told: Told, count: int) -> tuple[Calibratable, TuningReport]:
    """Returns the field with its arrays tuned as training snapshots say, where that is surely better; as it is otherwise.

    Args:
        params: of a field whose arrays can be given gains.
        told: training spectra, with snapshots, and the field.
        count: how many of them are looked at: one half says the gains, the other whether they are right.
    """
    field, links = told.field, told.data.links
    chosen = told.spectra[:count]
    half = np.unique(np.asarray(links.tx_index)[chosen], return_inverse=True)[1] % 2 == 0
    tuned = field.with_gains(gains_of(field, params, told, chosen[half]))
    judge = dataclasses.replace(told, spectra=chosen[~half])
    before, after = (dataclasses.replace(judge, field=one).scores(compared="spectra")([params])[0] for one in (field, tuned))
    kept = surely_better(before - after, judge.tx_index(), SURE)
    phase, amplitude = (np.sqrt(np.mean(np.square(part - part.mean()))) for part in _parts(tuned))
    report = TuningReport(float(before.mean()), float(after.mean()), kept, float(np.rad2deg(phase)), float(amplitude))
    return tuned if kept else field, report


def _parts(tuned: Calibratable) -> tuple[np.ndarray, np.ndarray]:
    """Returns phases (radians) and amplitudes (dB) of all elements."""
    tuning = np.asarray(tuned.tuning, np.float64)
    return tuning[..., 1], 20 / np.log(10) * tuning[..., 0]


def gains_of(
    field: Calibratable, params: WaveParams, told: Told, spectra: Int[np.ndarray, " n"]
) -> Complex[np.ndarray, "r elements"]:
    """Returns the gains of all receivers' elements, 1 where too few snapshots were heard; their mean phase is 0 and their root
    mean square 1, since a common factor says nothing."""
    receiver = np.asarray(told.data.links.receiver_index)[spectra]
    positions = told.data.receivers.element_positions
    gains = np.ones(positions.shape[:2], complex)
    for number in np.unique(receiver):
        own = spectra[receiver == number]
        if len(own) >= FEWEST:
            gains[number] = least_squares(*_snapshots(field, params, told, own))
    return gains


def _snapshots(
    field: Calibratable, params: WaveParams, told: Told, spectra: Int[np.ndarray, " n"]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the snapshots (n, elements) that a field says of some links, and those that were heard."""
    padded = np.resize(spectra, -(-len(spectra) // AT_ONCE) * AT_ONCE)  # repeats itself: one shape
    said = _said(field, params, told.prepared, told.data, jnp.asarray(padded, jnp.int32))
    assert told.data.snapshots is not None, "tuning is found from snapshots"
    return np.asarray(said)[: len(spectra)], np.asarray(told.data.snapshots)[spectra]


@jax.jit
def _said(
    field: Calibratable, params: WaveParams, prepared: PreparedPaths, data: TrainingData, spectra: Int[Array, " n"]
) -> Complex[Array, "n elements"]:
    def one(link: Int[Array, ""]) -> Complex[Array, " elements"]:
        batch = data.batch(link[None], jax.random.key(0))
        seen = field.render(params, field.plan(params, batch.receiver, prepared), batch.links)
        assert seen.snapshots is not None, "it is coherent"
        return seen.snapshots[0]

    found: Complex[Array, "n elements"] = jax.lax.map(one, spectra, batch_size=AT_ONCE)
    return found


def least_squares(
    said: Complex[np.ndarray, "n elements"], heard: Complex[np.ndarray, "n elements"]
) -> Complex[np.ndarray, " elements"]:
    """Returns the gains by which snapshots that were said become those that were heard, each up to a factor of its own."""
    power = _power(said) * _power(heard)
    usable = np.isfinite(power) & (power > 0)
    x, y = (part[usable].astype(complex) / np.sqrt(_power(part[usable]))[:, None] for part in (said, heard))
    gains = np.ones(said.shape[1], complex)
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
