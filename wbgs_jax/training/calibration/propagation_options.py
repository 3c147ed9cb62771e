"""Calibration of the propagation options: effects that ray tracers leave out, namely the finite thickness of walls and the
curvature of waves.

In reality a wave that passes a wall of thickness t does not acquire the phase k t cos(theta) of the air that the wall replaces;
ray tracers whose walls are surfaces without thickness add it to the phase of the slab. In reality waves reach an array as
spherical waves about mirrored sources; ray tracers with synthetic arrays make them plane. Data are of one kind or the other,
which training spectra reveal.
"""

import dataclasses
from dataclasses import dataclass

from wbgs_jax.config import CalibrationConfig
from wbgs_jax.fields.coherent_model import WaveParams
from wbgs_jax.training.calibration.material_fit import search_materials
from wbgs_jax.training.calibration.objective import CalibrationProblem, surely_better

SURE = 3.0
"""n_sigma: standard errors over transmitters by which a gain must be significant (`surely_better`)."""


@dataclass(frozen=True)
class Idealisation:
    """Result for one propagation option."""

    ideal: float
    """Mean score of the spectra as in ray tracers."""
    natural: float
    """Mean score of the spectra as in reality."""
    dropped: bool
    """Whether the option is set as in reality."""


def search_idealisations(
    params: WaveParams, problem: CalibrationProblem, config: CalibrationConfig
) -> tuple[WaveParams, dict[str, Idealisation]]:
    """Returns parameters with options set as in reality if spectra fit significantly better, and the results by option. Before
    the finite thickness of walls is tested, materials are chosen again with it."""
    once, found, count = dataclasses.replace(config, rounds=1), {}, config.propagation_spectra
    score, tx_index = problem.scores(count), problem.tx_index(count)
    for name in ("curved", "thick"):
        if float(getattr(params, name)):
            continue
        natural = dataclasses.replace(params, **{name: 1 + getattr(params, name)})  # a new array: training donates it once
        if name == "thick":
            natural, _ = search_materials(natural, problem, count, once)
        before, after = score([params, natural])
        dropped = surely_better(before - after, tx_index, SURE)
        found[name] = Idealisation(float(before.mean()), float(after.mean()), dropped)
        params = natural if dropped else params
    return params, found
