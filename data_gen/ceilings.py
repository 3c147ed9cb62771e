"""How well predictors of a known kind could do at best on a scene, so that a model's score can be read.

Against the coherent truth (all paths with their phases) two kinds are measured, as the median SSIM over some transmitters:
* the coherent sum of the paths with at most 0, 1, 2 or 3 interactions: what a model of that order could reach;
* the mean image over random path phases: directions and powers known exactly, phases not. Models that blend real, positive
  intensities cannot expect more.
"""

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from wbgs_jax.array import planar_array, snapshot_to_pas
from wbgs_jax.metrics import ssim

if TYPE_CHECKING:
    from data_gen.solve import Simulator, TxPaths

MAX_ORDER = 3
PHASE_DRAWS = 32
PHASE_SEED = 0
DIGITS = 4
"""Decimals kept: far below the spread over transmitters, far above rounding noise."""


def measure(simulator: "Simulator", tx_positions: Float[np.ndarray, "tx 3"]) -> dict[str, float]:
    """Median SSIM of every ceiling over the transmitters (world frame, metres), at the simulator's frequency.

    Returns:
        "order<=0" ... "order<=3" and "phase_blind", each a median SSIM.
    """
    size = simulator.settings.tx_per_call
    paths = [p for i in range(0, len(tx_positions), size) for p in simulator.paths(tx_positions[i : i + size])]
    truth = _images(np.stack([p.coefficients.sum(0) for p in paths]))
    result = {}
    for order in range(MAX_ORDER + 1):
        partial = _images(np.stack([p.coefficients[p.order <= order].sum(0) for p in paths]))
        result[f"order<={order}"] = _median(partial, truth)
    result["phase_blind"] = _median(np.stack([phase_blind_image(p) for p in paths]), truth)
    return result


def phase_blind_image(paths: "TxPaths") -> Float[np.ndarray, "90 360"]:
    """Mean PAS over `PHASE_DRAWS` draws of random path phases (always the same draws)."""
    phases = np.random.default_rng(PHASE_SEED).uniform(0, 2 * np.pi, (PHASE_DRAWS, len(paths.delays)))
    return _images(np.exp(1j * phases) @ paths.coefficients).mean(0)


def _images(snapshots: Complex[np.ndarray, "n elements"]) -> Float[np.ndarray, "n 90 360"]:
    # Scaled before the cast: a PAS has no scale, and weak sums of few paths stay normal complex64 numbers.
    peak = np.abs(snapshots).max(-1, keepdims=True)
    scaled = (snapshots / np.where(peak > 0, peak, 1)).astype(np.complex64)
    return np.asarray(snapshot_to_pas(jnp.asarray(scaled), jnp.asarray(planar_array())))


def _median(predicted: Float[np.ndarray, "n 90 360"], truth: Float[np.ndarray, "n 90 360"]) -> float:
    return round(float(np.median(ssim(predicted, truth))), DIGITS)
