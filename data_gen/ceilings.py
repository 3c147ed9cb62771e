"""Ceilings: the best possible scores of certain kinds of predictors on a scene, as a reference for a model's score.

Two kinds are compared with the coherent ground truth (all paths with their phases), as SSIM of one transmitter's image:
* the coherent sum of the paths with at most 0, 1, 2 or 3 interactions: the limit of a model of that order;
* the mean image over random path phases: directions and powers exact, phases unknown. Models that blend real, positive
  intensities cannot be expected to exceed it.
"""

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from wbgs_jax.metrics import ssim
from wbgs_jax.radio.array import snapshot_to_pas

if TYPE_CHECKING:
    from data_gen.solve import TxPaths

MAX_ORDER = 3
NAMES = (*(f"order<={order}" for order in range(MAX_ORDER + 1)), "phase_blind")
PHASE_DRAWS = 32
PHASE_SEED = 0


def measure(paths: "TxPaths", element_positions: Float[np.ndarray, "elements 3"]) -> Float[np.ndarray, " ceilings"]:
    """Returns the SSIM of every ceiling in `NAMES` for one transmitter at one frequency; NaN without a path.

    Element positions are in wavelengths.
    """
    if not len(paths.delays):
        return np.full(len(NAMES), np.nan)
    partial = [paths.coefficients[paths.order <= order].sum(0) for order in range(MAX_ORDER + 1)]
    truth, *images = scaled_images(np.stack([paths.coefficients.sum(0), *partial]), element_positions)
    images.append(phase_blind_image(paths, element_positions))
    return ssim(np.stack(images), np.stack([truth] * len(NAMES)))


def phase_blind_image(paths: "TxPaths", element_positions: Float[np.ndarray, "elements 3"]) -> Float[np.ndarray, "90 360"]:
    """Returns the mean PAS over `PHASE_DRAWS` draws of random path phases (always the same draws)."""
    phases = np.random.default_rng(PHASE_SEED).uniform(0, 2 * np.pi, (PHASE_DRAWS, len(paths.delays)))
    return scaled_images(np.exp(1j * phases) @ paths.coefficients, element_positions).mean(0)


def scaled_images(
    snapshots: Complex[np.ndarray, "n elements"], element_positions: Float[np.ndarray, "elements 3"]
) -> Float[np.ndarray, "n 90 360"]:
    """Returns the PAS of snapshots of any scale; element positions are in wavelengths."""
    return np.asarray(snapshot_to_pas(scaled(snapshots), jnp.asarray(element_positions)))


def scaled(snapshots: Complex[np.ndarray, "n elements"]) -> Complex[Array, "n elements"]:
    """Returns snapshots scaled to a maximum of 1: the comparison is scale-free, and squares of weak ones do not underflow."""
    peak = np.abs(snapshots).max(-1, keepdims=True)
    return jnp.asarray(snapshots / np.where(peak > 0, peak, 1), jnp.complex64)
