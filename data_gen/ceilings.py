"""How well predictors of a known kind could do at best on a scene, so that a model's score can be read.

Against the coherent truth (all paths with their phases) two kinds are measured, as SSIM of one transmitter's image:
* the coherent sum of the paths with at most 0, 1, 2 or 3 interactions: what a model of that order could reach;
* the mean image over random path phases: directions and powers known exactly, phases not. Models that blend real, positive
  intensities cannot expect more.
"""

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from wbgs_jax.evaluation.metrics import ssim
from wbgs_jax.radio.array import snapshot_to_pas

if TYPE_CHECKING:
    from data_gen.solve import TxPaths

MAX_ORDER = 3
NAMES = (*(f"order<={order}" for order in range(MAX_ORDER + 1)), "phase_blind")
PHASE_DRAWS = 32
PHASE_SEED = 0


def measure(paths: "TxPaths", element_positions: Float[np.ndarray, "elements 3"]) -> Float[np.ndarray, "ceilings"]:
    """Returns the SSIM of every ceiling in `NAMES` for one transmitter at one frequency; NaN without a path.

    Element positions are in wavelengths.
    """
    if not len(paths.delays):
        return np.full(len(NAMES), np.nan)
    partial = [paths.coefficients[paths.order <= order].sum(0) for order in range(MAX_ORDER + 1)]
    truth, *images = _images(np.stack([paths.coefficients.sum(0), *partial]), element_positions)
    images.append(phase_blind_image(paths, element_positions))
    return ssim(np.stack(images), np.stack([truth] * len(NAMES)))


def phase_blind_image(paths: "TxPaths", element_positions: Float[np.ndarray, "elements 3"]) -> Float[np.ndarray, "90 360"]:
    """Returns the mean PAS over `PHASE_DRAWS` draws of random path phases (always the same draws)."""
    phases = np.random.default_rng(PHASE_SEED).uniform(0, 2 * np.pi, (PHASE_DRAWS, len(paths.delays)))
    return _images(np.exp(1j * phases) @ paths.coefficients, element_positions).mean(0)


def _images(
    snapshots: Complex[np.ndarray, "n elements"], element_positions: Float[np.ndarray, "elements 3"]
) -> Float[np.ndarray, "n 90 360"]:
    # Scaled before the cast: a PAS has no scale, and weak sums of few paths stay normal complex64 numbers.
    peak = np.abs(snapshots).max(-1, keepdims=True)
    scaled = (snapshots / np.where(peak > 0, peak, 1)).astype(np.complex64)
    return np.asarray(snapshot_to_pas(jnp.asarray(scaled), jnp.asarray(element_positions)))
