"""What a link engineer loses by trusting a predicted spectrum: the wrong direction, the wrong beam."""

import numpy as np
from jaxtyping import Float

from wbgs_jax.radio.array import pas_directions
from wbgs_jax.radio.codebook import codebook

FLAT = 1e-4
"""Of an array's size: how far the elements of a planar one may stand out."""
FAINTEST_DB = -60.0
"""A beam that hears less than this, relative to the best one, hears nothing."""


def angle_error_deg(
    predicted: Float[np.ndarray, "n 90 360"],
    truth: Float[np.ndarray, "n 90 360"],
    array_normal: Float[np.ndarray, "3"] | None = None,
) -> Float[np.ndarray, " n"]:
    """Returns the angle (degrees) between the strongest directions of predicted and true spectra.

    A planar array cannot tell its front from its back: with its normal, either will do.
    """
    directions = pas_directions().reshape(-1, 3)
    a, b = (directions[spectra.reshape(len(spectra), -1).argmax(1)] for spectra in (predicted, truth))
    twins = [a] if array_normal is None else [a, a - 2 * (a @ array_normal)[:, None] * array_normal]
    angles = [np.arctan2(np.linalg.norm(np.cross(twin, b), axis=-1), (twin * b).sum(-1)) for twin in twins]
    return np.degrees(np.min(angles, 0))


def plane_normal(element_positions: Float[np.ndarray, "elements 3"]) -> Float[np.ndarray, "3"] | None:
    """Returns the unit normal of the plane that the elements of an array lie in; None if they lie in none, or in several."""
    centred = element_positions - element_positions.mean(0)
    if len(centred) < 3:
        return None
    _, sizes, axes = np.linalg.svd(centred.astype(np.float64), full_matrices=False)
    flat = sizes < FLAT * max(sizes[0], 1e-12)
    return axes[-1] if flat.tolist() == [False, False, True] else None


def beam_loss_db(
    predicted: Float[np.ndarray, "n 90 360"], truth: Float[np.ndarray, "n 90 360"], tried: int = 1
) -> Float[np.ndarray, " n"]:
    """Returns the power (dB, at least 0) that is lost against the codebook's best beam.

    The `tried` beams that a predicted spectrum ranks highest are measured, and the best of them is used. A beam is a pixel of
    the spectrum, which is an amplitude: power is its square.
    """
    expected, heard = (spectra.reshape(len(spectra), -1)[:, codebook()] for spectra in (predicted, truth))
    ranked = np.argsort(-expected, axis=1, kind="stable")[:, :tried]
    used = np.take_along_axis(heard, ranked, 1).max(1).astype(np.float64)
    best = heard.max(1).astype(np.float64)
    ratio = np.where(best > 0, used / np.where(best > 0, best, 1), 1)
    return -20 * np.log10(np.maximum(ratio, 10 ** (FAINTEST_DB / 20)))
