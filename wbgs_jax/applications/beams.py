"""Choice of the receiver's codebook beams to try for a transmitter, and the loss compared with the best beam."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from wbgs_jax.inference.predictor import Predictor, predict_many
from wbgs_jax.metrics import beam_loss_db
from wbgs_jax.radio.array import ALIKE, codebook

RIGHT_DB = float(-20 * np.log10(1 - ALIKE))
"""A beam that receives at most this much less than the best one (0.45 dB) counts as equally good: a planar array receives
equally ahead and behind."""


class BeamScores(NamedTuple):
    """Quality of beams chosen by predicted spectra, over n transmitters."""

    top1: float
    """Fraction of transmitters for which the first choice is as good as the best beam of the codebook ..."""
    top3: float
    """... and for which one of the first three choices is."""
    loss_db: float
    """Mean power lost by the first choice relative to the best beam, dB ..."""
    loss_top3_db: float
    """... and by the best of the first three."""


def rank_beams(spectra: Any, count: int = 3) -> Int[np.ndarray, "n count"]:
    """Returns the strongest beams of the codebook (0 to 63: four rings from the zenith down, sixteen azimuths from -180 degrees
    on) in every spectrum, the best one first.

    Args:
        spectra: (n, 90, 360), measured or predicted.
        count: beams per spectrum, 1 to 64.

    Returns:
        Indices of beams (n, count).

    Raises:
        ValueError: the spectra are not (n, 90, 360), or the count is not within the codebook.
    """
    values, beams = np.asarray(spectra), codebook()
    if values.ndim != 3 or values.shape[1:] != (90, 360):
        raise ValueError(f"spectra have shape {values.shape}; pass (n, 90, 360)")
    if not 1 <= count <= len(beams):
        raise ValueError(f"count is {count}; give 1 to {len(beams)} beams")
    received = values.reshape(-1, 90 * 360)[:, beams].astype(float)  # unsigned integers of an image have no negative
    return np.argsort(-received, axis=1, kind="stable")[:, :count]


def choose_beams(predict: Predictor, tx_positions: Any, frequencies_hz: Any, count: int = 3) -> Int[np.ndarray, "n count"]:
    """Returns the beams to try for n transmitters, the most promising one first.

    Args:
        predict: predicts a field's spectra, from `make_predictor`.
        tx_positions: (n, 3), world frame, metres.
        frequencies_hz: (n,) or one, hertz.
        count: beams per transmitter, 1 to 64.

    Returns:
        Indices of beams (n, count), as in `rank_beams`.
    """
    return rank_beams(predict_many(predict, tx_positions, frequencies_hz), count)


def score_beams(predicted: Any, truth: Any) -> BeamScores:
    """Returns the quality, in true spectra, of the beams that predicted spectra rank highest.

    Args:
        predicted: (n, 90, 360), spectra of a field.
        truth: (n, 90, 360), measured spectra of the same links.

    Returns:
        Shares of links and losses in dB (`BeamScores`).

    Raises:
        ValueError: the numbers of spectra differ, or some values are not finite.
    """
    predicted, truth = np.asarray(predicted, float), np.asarray(truth, float)
    if predicted.shape != truth.shape:
        raise ValueError(
            f"predicted spectra have shape {predicted.shape}, true ones {truth.shape}; pass those of the same links"
        )
    for name, spectra in (("predicted", predicted), ("true", truth)):
        if not np.isfinite(spectra).all():
            raise ValueError(f"some {name} spectra have values that are not finite; leave these links out")
    first, three = (beam_loss_db(predicted, truth, tried) for tried in (1, 3))
    top1, top3 = (float(np.mean(loss <= RIGHT_DB)) for loss in (first, three))
    return BeamScores(top1, top3, float(first.mean()), float(three.mean()))
