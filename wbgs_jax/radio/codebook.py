"""The beams that a receiver chooses from: directions of the hemisphere, as pixels of its spectrum."""

import functools

import numpy as np
from jaxtyping import Float, Int

from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH

RINGS, SECTORS = 4, 16
"""Beams on four rings of equal zenith angle, sixteen on each."""


@functools.cache
def codebook() -> Int[np.ndarray, " beams"]:
    """Returns the pixels, in row-major order, that the codebook's beams point at."""
    rows = (np.arange(RINGS) + 0.5) * (PAS_HEIGHT - 1) / RINGS
    columns = np.arange(SECTORS) * (PAS_WIDTH - 1) / SECTORS
    return (rows.round().astype(int)[:, None] * PAS_WIDTH + columns.round().astype(int)).reshape(-1)


def best_beams(spectra: Float[np.ndarray, "n 90 360"]) -> Int[np.ndarray, " n"]:
    """Returns which beam hears most in every spectrum."""
    return spectra.reshape(len(spectra), -1)[:, codebook()].argmax(1)
