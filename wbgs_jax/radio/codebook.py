"""The beams that a receiver chooses from: directions of the hemisphere, as pixels of its spectrum."""

import functools

import numpy as np
from jaxtyping import Float, Int

from wbgs_jax.radio.array import PAS_HEIGHT, PAS_WIDTH, pas_directions

ALIKE = 0.05
"""Share by which the amplitudes of beams ahead and behind may differ: pixels are not quite symmetric."""
RINGS, SECTORS = 4, 16
"""Beams on four rings of equal zenith angle, sixteen on each."""


@functools.cache
def codebook() -> Int[np.ndarray, " beams"]:
    """Returns the pixels, in row-major order, that the codebook's beams point at."""
    rows = (np.arange(RINGS) + 0.5) * (PAS_HEIGHT - 1) / RINGS
    columns = np.arange(SECTORS) * (PAS_WIDTH - 1) / SECTORS
    return (rows.round().astype(int)[:, None] * PAS_WIDTH + columns.round().astype(int)).reshape(-1)


def best_beams(spectra: Float[np.ndarray, "n 90 360"]) -> Int[np.ndarray, " n"]:
    """Returns which beam hears most in every spectrum. A planar array in the local y-z plane hears the same ahead and behind:
    there the beam ahead, at local +x, where directional elements look."""
    heard = spectra.reshape(len(spectra), -1)[:, codebook()]
    best = heard.argmax(1)
    ring, sector = np.divmod(best, SECTORS)
    twin = ring * SECTORS + (SECTORS // 2 - sector) % SECTORS
    ahead, row = pas_directions().reshape(-1, 3)[codebook(), 0], np.arange(len(heard))
    return np.where((heard[row, twin] >= (1 - ALIKE) * heard[row, best]) & (ahead[twin] > ahead[best]), twin, best)
