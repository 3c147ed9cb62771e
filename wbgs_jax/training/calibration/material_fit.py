"""Calibration of the materials of a scene.

At high frequencies a slab changes the phase by many radians. As a function of its permittivity, the loss then has a local
minimum for every cycle, and gradient descent ends in the one where it begins. Training on low frequencies first
(`optim.curriculum`) can avoid this; if the data have too wide a gap between two frequencies, several minima are equally deep.
Prior knowledge distinguishes them: buildings consist of few materials, and ITU-R P.2040 lists these. For one material after the
other, the entry of the list that fits the spectra best is chosen, unless the current properties fit better (significantly
better, if they are not an entry of the list). A few spectra narrow down the entries first. Training starts from the result.
"""

import dataclasses
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax._util.pytree import same
from wbgs_jax._util.statistics import standard_error
from wbgs_jax.config import CalibrationConfig
from wbgs_jax.fields.coherent_model import Materials, WaveParams
from wbgs_jax.training.calibration.objective import CalibrationProblem, Compared

ITU_MATERIALS: dict[str, tuple[float, float, float]] = {
    # name: relative permittivity, c and d of the conductivity c f^d (S/m, f in GHz)
    "concrete": (5.24, 0.0462, 0.7822),
    "brick": (3.91, 0.0238, 0.16),
    "plasterboard": (2.73, 0.0085, 0.9395),
    "wood": (1.99, 0.0047, 1.0718),
    "glass": (6.31, 0.0036, 1.3394),
    "ceiling board": (1.48, 0.0011, 1.0750),
    "chipboard": (2.58, 0.0217, 0.78),
    "plywood": (2.71, 0.33, 0.0),
    "marble": (7.074, 0.0055, 0.9262),
    "floorboard": (3.66, 0.0044, 1.3515),
    "metal": (1.01, 1e7, 0.0),
}
"""ITU-R P.2040-3, table 3 (metal has permittivity 1 there, but log(eps_r - 1) is stored)."""
USUAL_M: dict[str, float] = {
    "concrete": 0.2,
    "brick": 0.115,
    "plasterboard": 0.0125,
    "wood": 0.02,
    "glass": 0.006,
    "ceiling board": 0.015,
    "chipboard": 0.018,
    "plywood": 0.015,
    "marble": 0.02,
    "floorboard": 0.02,
    "metal": 0.002,
}
"""Usual thicknesses of walls, boards and panes, metres: the initial values if a scene does not define them."""
UNSEEN = 1e-6
"""A material that changes the scores by less does not occur in the paths of the spectra, and is not changed."""


SHORTLIST = 4
"""Number of entries that are compared on all spectra: the best ones on the first few."""


@dataclass(frozen=True)
class SearchReport:
    """Result of the calibration of materials."""

    before: float
    """Mean score (log decorrelation) of the spectra with the initial materials."""
    after: float
    """Mean score of the spectra with the chosen materials."""
    taken: dict[int, str]
    """Chosen entries by material."""
    thickness_mm: dict[int, float] = field(default_factory=dict)
    """Estimated thicknesses of materials whose thickness the scene does not define."""


def search_materials(
    params: WaveParams,
    problem: CalibrationProblem,
    count: int,
    config: CalibrationConfig,
    compared: Compared = "snapshots",
    usual: bool = False,
) -> tuple[WaveParams, SearchReport]:
    """Returns parameters with the materials that fit spectra best.

    Args:
        params: parameters with `materials`.
        problem: training spectra, with the field and its paths.
        count: number of spectra in use.
        config: settings of the calibration.
        compared: the compared quantity.
        usual: whether changed materials also get their usual thickness, which has no effect if the scene defines the thickness.
    """
    score, tx_index = problem.scores(count, compared), problem.tx_index(count)
    before, taken, settled = np.zeros(0), dict[int, str](), 0
    materials = len(params.materials.slope)
    for turn in range(config.rounds * materials):
        material = turn % materials
        entries = [
            dataclasses.replace(
                params, materials=with_entry(params.materials, material, name, USUAL_M[name] if usual else None)
            )
            for name in ITU_MATERIALS
        ]
        likely = np.argsort(score(entries, config.glance).mean(1))[:SHORTLIST]
        candidates = [params, *(entries[i] for i in likely)]
        scores = score(candidates)
        best = 1 + int(np.argmin(scores[1:].mean(1)))
        before = before if turn else scores[0]
        settled += 1
        listed = any(same(params.materials, entry.materials) for entry in entries)
        gain, error = standard_error(scores[best] - scores[0], tx_index)  # gain of the current properties
        kept = scores[0].mean() < scores[best].mean() if listed else gain > config.n_sigma * error
        if np.ptp(scores.mean(1)) >= UNSEEN and not kept:
            taken[material] = list(ITU_MATERIALS)[likely[best - 1]]
            settled = settled if same(params.materials, candidates[best].materials) else 1
            params, scores = candidates[best], scores[best:]
        if settled == materials:  # no other material has changed since each was scored
            break
    return params, SearchReport(float(before.mean()), float(scores[0].mean()), taken)


def unknown_mm(materials: Materials, known_thickness: Float[np.ndarray, " m"]) -> dict[int, float]:
    """Returns the thicknesses (mm) of those materials whose thickness the scene does not define (0)."""
    metres = np.exp(np.asarray(materials.log_thickness))
    return {int(i): round(1e3 * float(metres[i]), 2) for i in np.flatnonzero(known_thickness == 0)}


def entries_of(materials: Materials) -> dict[int, str]:
    """Returns the entries of ITU-R P.2040 by material, for those materials that are entries."""
    own = np.exp(np.stack([materials.log_susceptibility, materials.log_conductivity, materials.slope]))
    listed = {name: np.exp([np.log(permittivity - 1), np.log(c), d]) for name, (permittivity, c, d) in ITU_MATERIALS.items()}
    alike = ((i, name) for i, one in enumerate(own.T) for name, entry in listed.items() if np.allclose(one, entry, rtol=1e-4))
    return dict(alike)


def with_entry(materials: Materials, material: int, name: str, metres: float | None = None) -> Materials:
    """Returns a copy in which one material is an entry of ITU-R P.2040, with a new thickness (metres) if one is given."""
    return with_properties(materials, material, *ITU_MATERIALS[name], metres)


def with_properties(
    materials: Materials, material: int, permittivity: float, c: float, d: float, metres: float | None = None
) -> Materials:
    """Returns a copy in which one material has another relative permittivity (above 1) and the conductivity c f^d (S/m, f in
    GHz), with a new thickness (metres) if one is given."""
    new = {
        "log_susceptibility": np.log(permittivity - 1),
        "log_conductivity": np.log(c),
        "slope": d,
        "log_thickness": None if metres is None else np.log(metres),
    }
    return dataclasses.replace(materials, **{leaf: _with(getattr(materials, leaf), material, new[leaf]) for leaf in new})


def _with(leaf: Float[Array, " m"], index: int, value: float | None) -> Float[Array, " m"]:
    """Returns `leaf.at[index].set(value)`, computed in an eighth of the time, since there are thousands of candidates; the leaf
    itself without a value."""
    if value is None:
        return leaf
    copy = np.array(leaf)
    copy[index] = value
    return jnp.asarray(copy)
