"""How far surfaces may stand from where the mesh has them: a first guess, the same for all of them and for the transmitters.

A surface that is off by more than a tenth of a wavelength says nothing about phases. A field that believes it nevertheless is
further from the truth than one that adds powers. The guess is the one by which spectra are explained best; training learns how
far it is for each.
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
    """What was found."""

    spread_mm: float
    """Standard deviation along each axis."""
    certain: float
    """Mean score of spectra if every place were known (to the least of `SPREADS_M`) ..."""
    uncertain: float
    """... and with the standard deviation that was taken."""


def search_placement(params: WaveParams, score: Scores) -> tuple[WaveParams, PlacementReport]:
    """Returns parameters with the uncertainty of all places by which spectra are explained best."""
    candidates = [
        dataclasses.replace(params, placement=jnp.full_like(params.placement, np.log(spread))) for spread in SPREADS_M
    ]
    scores = score(candidates).mean(1)
    best = int(np.argmin(scores))
    return candidates[best], PlacementReport(1e3 * SPREADS_M[best], float(scores[0]), float(scores[best]))
