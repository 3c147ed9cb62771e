"""Equation 6 of the paper, written out for a pixel: the readable oracle of every renderer."""

import numpy as np

from wbgs_jax.radio.geometry import AZIMUTH_PERIOD
from wbgs_jax.splat.projection import SUPPORT


def pixel(splats, attenuation, signal, row, column):
    """What a pixel shows of splats with an attenuation and a signal each (NumPy arrays), in double precision."""
    dx = (column - splats.means2d[:, 0] + AZIMUTH_PERIOD / 2) % AZIMUTH_PERIOD - AZIMUTH_PERIOD / 2
    dy = row - splats.means2d[:, 1]
    a, b, c = splats.conics.T.astype(float)
    edge = np.exp(-(SUPPORT**2) / 2)
    footprint = np.maximum(np.exp(-(a * dx**2 + 2 * b * dx * dy + c * dy**2) / 2) - edge, 0) / (1 - edge)
    total, surviving = 0.0, 1.0
    for i in np.argsort(splats.depths, kind="stable"):
        if footprint[i] and np.isfinite(splats.depths[i]):
            alpha = attenuation[i] * footprint[i]
            total += surviving * alpha * signal[i]
            surviving *= 1 - alpha
    return total
