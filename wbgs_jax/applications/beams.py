"""Which beams of the receiver's codebook to try for a transmitter, and what that costs against knowing the best one."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from wbgs_jax.inference.batching import predict_many
from wbgs_jax.inference.predictor import Predictor
from wbgs_jax.metrics import beam_loss_db
from wbgs_jax.radio.array import ALIKE, codebook, pas_directions

AnyArray = Array | np.ndarray
RIGHT_DB = float(-20 * np.log10(1 - ALIKE))
"""A beam that hears so little less than the best one is as good (0.45 dB): a planar array hears alike ahead and behind."""


class BeamScores(NamedTuple):
    """What beams are worth that were chosen by predicted spectra; over n transmitters."""

    top1: float
    """Share of them for which the first choice is as good as the best beam of the codebook ..."""
    top3: float
    """... and for which one of the first three is."""
    loss_db: float
    """Mean power that the first choice loses against the best beam, dB ..."""
    loss_top3_db: float
    """... and the best of the first three."""


def rank_beams(spectra: Float[AnyArray, "n 90 360"], count: int = 3) -> Int[np.ndarray, "n count"]:
    """Returns the beams of the codebook (0 to 63: four rings from the zenith down, sixteen azimuths from -180 degrees on) that
    hear most in every spectrum, the best one first."""
    heard = np.asarray(spectra).reshape(len(spectra), -1)[:, codebook()]
    return np.argsort(-heard, axis=1, kind="stable")[:, :count]


def beam_directions() -> Float[np.ndarray, "64 3"]:
    """Returns the unit vectors (float64, receiver's frame) that the beams of the codebook point at."""
    return pas_directions().reshape(-1, 3)[codebook()]


def choose_beams(predict: Predictor, tx_positions: Any, frequencies_hz: Any, count: int = 3) -> Int[np.ndarray, "n count"]:
    """Returns which beams to try for n transmitters, the most promising one first.

    Args:
        predict: a field's spectra, of `predictor`.
        tx_positions: (n, 3), world frame, metres.
        frequencies_hz: (n,) or one, hertz.
        count: beams for every transmitter.
    """
    return rank_beams(predict_many(predict, tx_positions, frequencies_hz), count)


def score_beams(predicted: Float[AnyArray, "n 90 360"], truth: Float[AnyArray, "n 90 360"]) -> BeamScores:
    """Returns what the beams that predicted spectra rank highest are worth in true spectra."""
    first, three = (beam_loss_db(np.asarray(predicted), np.asarray(truth), tried) for tried in (1, 3))
    top1, top3 = (float(np.mean(loss <= RIGHT_DB)) for loss in (first, three))
    return BeamScores(top1, top3, float(first.mean()), float(three.mean()))
