"""Search for the materials of a scene.

The phase behind a slab turns by many radians at high frequencies. Its permittivity then has a valley of the loss for every
turn, and gradient descent ends in the one it begins in. Low frequencies first (`optim.curriculum`) is a way around; where the
data leave a gap between two frequencies that is too wide to step over, several valleys are equally deep. What tells them
apart is knowledge: rooms are built of few materials, and ITU-R P.2040 lists them. Material by material the entry that fits the
spectra best is taken, unless what is there fits better, and by more than chance where that is no entry; a few spectra say which
entries are worth a closer look. Training goes on from there.
"""

import dataclasses
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax._util.pytree import same
from wbgs_jax._util.statistics import standard_error
from wbgs_jax.config import SearchConfig
from wbgs_jax.fields.coherent_model import Materials, WaveParams
from wbgs_jax.training.calibration.objective import Compared, Told

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
"""ITU-R P.2040-3, table 3 (metal has permittivity 1 there; log(eps_r - 1) is what is stored)."""
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
"""Metres: how thick walls, boards and panes of each are sold or built; where to begin when a scene does not say."""
UNSEEN = 1e-6
"""A material that changes the scores by less is in no path of the spectra, and stays what it is."""


SHORTLIST = 4
"""Entries that are looked at closely: the best at a first glance."""


@dataclass(frozen=True)
class SearchReport:
    """What a search did."""

    before: float
    """Mean log decorrelation of the spectra that were looked at."""
    after: float
    """The same with the materials that were taken."""
    taken: dict[int, str]
    """Materials, and the entry that each of them got."""
    thickness_mm: dict[int, float] = field(default_factory=dict)
    """Thicknesses that were found for materials whose thickness the scene does not say."""


def search_materials(
    params: WaveParams, told: Told, count: int, config: SearchConfig, compared: Compared = "snapshots", usual: bool = False
) -> tuple[WaveParams, SearchReport]:
    """Returns parameters with the materials by which spectra are explained best.

    Args:
        params: with `materials`.
        told: what training spectra say.
        count: spectra that are looked at.
        config: of the search.
        compared: of these spectra.
        usual: whether those that change become as thick as is usual (where the scene says how thick they are, that counts for
            nothing).
    """
    score, tx_index = told.scores(count, compared), told.tx_index(count)
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
        gain, error = standard_error(scores[best] - scores[0], tx_index)  # of what is there
        kept = scores[0].mean() < scores[best].mean() if listed else gain > config.sure * error
        if np.ptp(scores.mean(1)) >= UNSEEN and not kept:
            taken[material] = list(ITU_MATERIALS)[likely[best - 1]]
            settled = settled if same(params.materials, candidates[best].materials) else 1
            params, scores = candidates[best], scores[best:]
        if settled == materials:  # all others are what they were when each was looked at
            break
    return params, SearchReport(float(before.mean()), float(scores[0].mean()), taken)


def unknown_mm(materials: Materials, known_thickness: Float[np.ndarray, " m"]) -> dict[int, float]:
    """Returns how thick (mm) those materials are whose thickness the scene does not say (0)."""
    metres = np.exp(np.asarray(materials.log_thickness))
    return {int(i): round(1e3 * float(metres[i]), 2) for i in np.flatnonzero(known_thickness == 0)}


def entries_of(materials: Materials) -> dict[int, str]:
    """Returns which materials are entries of ITU-R P.2040, and which."""
    own = np.exp(np.stack([materials.log_susceptibility, materials.log_conductivity, materials.slope]))
    listed = {name: np.exp([np.log(permittivity - 1), np.log(c), d]) for name, (permittivity, c, d) in ITU_MATERIALS.items()}
    alike = ((i, name) for i, one in enumerate(own.T) for name, entry in listed.items() if np.allclose(one, entry, rtol=1e-4))
    return dict(alike)


def with_entry(materials: Materials, material: int, name: str, metres: float | None = None) -> Materials:
    """Returns a copy in which one material is an entry of ITU-R P.2040, so many metres thick, or as thick as before."""
    return with_properties(materials, material, *ITU_MATERIALS[name], metres)


def with_properties(
    materials: Materials, material: int, permittivity: float, c: float, d: float, metres: float | None = None
) -> Materials:
    """Returns a copy in which one material has another relative permittivity (above 1), the conductivity c f^d (S/m, f in GHz),
    and is so many metres thick, or as thick as before."""
    new = {
        "log_susceptibility": np.log(permittivity - 1),
        "log_conductivity": np.log(c),
        "slope": d,
        "log_thickness": None if metres is None else np.log(metres),
    }
    return dataclasses.replace(materials, **{leaf: _with(getattr(materials, leaf), material, new[leaf]) for leaf in new})


def _with(leaf: Float[Array, " m"], index: int, value: float | None) -> Float[Array, " m"]:
    """Returns what `leaf.at[index].set(value)` does, in an eighth of the time: there are thousands of candidates. Without a
    value it is a copy, so that candidates of all kinds differ in the same leaves and have one program (objective.py)."""
    copy = np.array(leaf)
    if value is not None:
        copy[index] = value
    return jnp.asarray(copy)
