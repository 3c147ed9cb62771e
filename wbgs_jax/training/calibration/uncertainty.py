"""Calibration of position_std: an initial estimate, common to all surfaces and the transmitters.

A surface that is displaced by more than a tenth of a wavelength contains no information about phases. A field that takes its
position as exact is less accurate than one that adds powers. The estimate is the value that fits spectra best; training then
refines it for each rigid body.
"""

import dataclasses
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from wbgs_jax.fields.coherent_model import WaveParams
from wbgs_jax.training.calibration.objective import Scores

SPREADS_M = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
"""Standard deviations that are tried, metres."""


@dataclass(frozen=True)
class PlacementReport:
    """Result of the calibration of position_std."""

    spread_mm: float
    """Estimated standard deviation along each axis, mm."""
    certain: float
    """Mean score of spectra with practically exact positions (the smallest of `SPREADS_M`)."""
    uncertain: float
    """Mean score of spectra with the estimated standard deviation."""


def search_placement(params: WaveParams, score: Scores) -> tuple[WaveParams, PlacementReport]:
    """Returns parameters with the standard deviation of all positions that fits spectra best."""
    candidates = [
        dataclasses.replace(params, placement=jnp.full_like(params.placement, np.log(spread))) for spread in SPREADS_M
    ]
    scores = score(candidates).mean(1)
    best = int(np.argmin(scores))
    return candidates[best], PlacementReport(1e3 * SPREADS_M[best], float(scores[0]), float(scores[best]))
