"""Search for what ray tracers leave out and nature does not: thick walls and curved waves.

In nature a wave that passes a wall of thickness t goes without the air's phase k t cos(theta); ray tracers whose walls are
surfaces without thickness count it on top of the slab's own. In nature waves reach an array as spheres around mirrored sources;
ray tracers with synthetic arrays make them plane. Data are of one kind or of the other, and training spectra tell which.
"""

import dataclasses
from dataclasses import dataclass

from wbgs_jax.config import SearchConfig
from wbgs_jax.fields.coherent_model import WaveParams
from wbgs_jax.training.calibration.material_fit import search_materials
from wbgs_jax.training.calibration.objective import Told, surely_better

SURE = 3.0
"""As many standard errors over transmitters as a gain has to be sure by (`surely_better`)."""


@dataclass(frozen=True)
class Idealisation:
    """What was found out about one of them."""

    ideal: float
    """Mean score of the spectra as ray tracers have them ..."""
    natural: float
    """... and as nature has them."""
    dropped: bool
    """Whether nature's is taken."""


def search_idealisations(params: WaveParams, told: Told, config: SearchConfig) -> tuple[WaveParams, dict[str, Idealisation]]:
    """Returns parameters without the idealisations that spectra surely contradict; materials are named anew before walls are
    said to be thick."""
    once, found, count = dataclasses.replace(config, rounds=1), {}, config.ideal_spectra
    score, tx_index = told.scores(count), told.tx_index(count)
    for name in ("curved", "thick"):
        if float(getattr(params, name)):
            continue
        natural = dataclasses.replace(params, **{name: 1 + getattr(params, name)})  # training gives every array away once
        if name == "thick":
            natural, _ = search_materials(natural, told, count, once)
        before, after = score([params, natural])
        dropped = surely_better(before - after, tx_index, SURE)
        found[name] = Idealisation(float(before.mean()), float(after.mean()), dropped)
        params = natural if dropped else params
    return params, found
