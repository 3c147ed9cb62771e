"""Calibration of the materials of a scene, and of thicknesses that are unknown.

At high frequencies a slab changes the phase by many radians. As a function of its permittivity, the loss then has a local
minimum for every cycle, and gradient descent ends in the one where it begins. Training on low frequencies first
(`optim.curriculum`) can avoid this; if the data have too wide a gap between two frequencies, several minima are equally deep.
Prior knowledge distinguishes them: buildings consist of few materials, and ITU-R P.2040 lists these. For one material after the
other, the entry of the list that fits the spectra best is chosen, unless the current properties fit better (significantly
better, if they are not an entry of the list). A few spectra narrow down the entries first. Training starts from the result.

Thicknesses of walls and boards that are unknown are found together with their materials (`search_slabs`). A wave that passes a
slab, or is reflected by its far side, is delayed by its optical thickness, t sqrt(eps_r), in wavelengths. At low frequencies
few thicknesses can be distinguished, and a single comparison of all of them is sufficient; every higher frequency then
distinguishes those that the lower ones could not, as in the alignment of surfaces (alignment.py). Entries of the list are tried
with the thickness that preserves the optical thickness. The calibration begins with usual thicknesses; the result is kept if it
fits snapshots significantly better than the materials chosen without it.
"""

import dataclasses
from dataclasses import dataclass, field
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from wbgs_jax._util.pytree import same
from wbgs_jax._util.statistics import standard_error
from wbgs_jax.config import CalibrationConfig
from wbgs_jax.fields.coherent_model import Materials, WaveParams
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.calibration.objective import CalibrationProblem, Compared, Scores, surely_better

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
"""Number of entries, or of slabs, that are compared on all spectra: the best ones on the first few."""


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


THINNEST, THICKEST = 5e-4, 0.35
"""Range of thicknesses, metres."""
FIRST_STEP, STEP = 1 / 6, 1 / 8
"""Steps between thicknesses at the first frequency and at later ones, in wavelengths within the material."""
MOST = 40
"""Maximum number of thicknesses per entry at the first frequency, in addition to sheets."""
APART = 1.25
"""Minimum ratio of two successive frequencies."""
ONCE_MORE = 60
"""Number of slabs that are tried again after a pass over all materials or a displacement of surfaces: the best ones on the
first few spectra."""
ENTRIES = 6
"""Number of entries of the list that are tried at higher frequencies: those of the best slabs."""


class Slab(NamedTuple):
    """An entry of the list of materials with its thickness, metres."""

    entry: str
    metres: float


Likely = dict[int, list[Slab]]
"""Best slabs on the first spectra by material of unknown thickness, the best first; all slabs for a material that occurs in no
path."""


def search_slabs(
    params: WaveParams,
    problem: CalibrationProblem,
    config: CalibrationConfig,
    count: int,
    compared: Compared = "snapshots",
    likely: Likely | None = None,
) -> tuple[WaveParams, SearchReport, Likely | None]:
    """Returns parameters with the materials and unknown thicknesses that fit spectra best, a report, and the most likely slabs
    (None if they have not been searched). `problem` are training spectra with the field and its paths.

    Thicknesses are estimated from snapshots; with spectra alone, materials get their usual thickness.

    Args:
        params: parameters with `materials`.
        config: settings of the calibration; `thickness_spectra` are used at every frequency.
        count: number of spectra with which materials are chosen.
        compared: the compared quantity.
        likely: slabs from an earlier search, to which this one is restricted; None for all.
    """
    score, known = problem.scores(count, compared), np.asarray(problem.field.known_thickness)
    unknown = known == 0
    named, report = search_materials(params, problem, count, config, compared, usual=bool(unknown.any()))
    if not unknown.any() or problem.data.snapshots is None:  # spectra cost ten times as much and contain less information
        return named, report, likely
    once = dataclasses.replace(config, rounds=1)
    params, likely = _sized(named, unknown, problem, config, compared, likely)
    sized, anew = search_materials(params, problem, count, once, compared)
    before, after = score([named, sized])
    if not surely_better(before - after, problem.tx_index(count), config.thickness_n_sigma):
        return named, report, likely
    thick = unknown_mm(sized.materials, known)
    return sized, dataclasses.replace(anew, before=report.before, thickness_mm=thick), likely


def _sized(
    params: WaveParams,
    unknown: Bool[np.ndarray, " m"],
    problem: CalibrationProblem,
    config: CalibrationConfig,
    compared: Compared,
    likely: Likely | None,
) -> tuple[WaveParams, Likely]:
    """Returns parameters with materials and thicknesses estimated at successively higher frequencies, and the likely slabs."""
    materials, spread = np.flatnonzero(unknown).tolist(), float(jnp.exp(jnp.median(params.placement)))
    accurate = 0.1  # position_std, in wavelengths, beyond which phases contain no information about thicknesses
    first, *others = frequencies_to_look_at(problem.frequency_hz(), accurate * SPEED_OF_LIGHT / spread)
    likely = dict(likely or {m: _all_slabs(first) for m in materials})
    score = problem.scores(config.thickness_spectra, compared, first)
    for _ in range(2):
        for material in materials:
            params, likely[material] = _best(params, material, likely[material], score, config.thickness_glance)
    before = first
    for frequency_hz in others:
        score = problem.scores(config.thickness_spectra, compared, frequency_hz)
        for material in materials:
            seen = len(likely[material]) <= ONCE_MORE  # all slabs are equally likely for a material that occurs in no path
            entries = list(dict.fromkeys(slab.entry for slab in likely[material]))[: ENTRIES if seen else None]
            near = _slabs_near(params.materials, material, entries, frequency_hz, before)
            params, _ = _best(params, material, near, score, config.thickness_glance)
        before = frequency_hz
    return params, likely


def frequencies_to_look_at(frequency_hz: Float[np.ndarray, " n"], accurate_hz: float) -> list[float]:
    """Returns the maximum frequencies of the successive comparisons, ascending: those of the data with ratios of at least
    `APART`, up to `accurate_hz`, beyond which phases are inaccurate. The lowest frequency alone contains little information; it
    is left out unless the first comparison at the next one would not include thick walls."""
    found = [float(frequency_hz.max())]
    for one in np.unique(frequency_hz)[::-1]:
        found += [float(one)] if one * APART <= found[-1] else []
    first, *others = found[::-1]
    if others and len(_steps("concrete", others[0])) <= MOST:
        first, *others = others
    return [first, *(one for one in others if one <= accurate_hz)]


def _all_slabs(frequency_hz: float) -> list[Slab]:
    """Returns all entries of the list with all thicknesses that can be distinguished at a frequency."""
    found = []
    # Thicknesses of sheets that are thinner than a step at the first frequency, metres
    sheets = (0.002, 0.004, 0.006, 0.01, 0.015)
    for name in ITU_MATERIALS:
        found += [Slab(name, float(metres)) for metres in (*sheets, *_steps(name, frequency_hz)[:MOST])]
    return found


def _steps(entry: str, frequency_hz: float) -> Float[np.ndarray, " n"]:
    """Returns thicknesses (metres) that can be distinguished at a frequency, up to `THICKEST`."""
    return np.arange(0.02, THICKEST, FIRST_STEP * _wavelength(entry, frequency_hz))


def _slabs_near(materials: Materials, material: int, entries: list[str], frequency_hz: float, before_hz: float) -> list[Slab]:
    """Returns entries with thicknesses that could not be distinguished from the current one at the previous frequency."""
    optical = float(jnp.exp(materials.log_thickness[material]) * jnp.sqrt(1 + jnp.exp(materials.log_susceptibility[material])))
    around, found = int(np.ceil(frequency_hz / before_hz)), []
    for name in entries:
        steps = STEP * _wavelength(name, frequency_hz) * np.arange(-around, around + 1)
        metres = np.clip(optical / np.sqrt(ITU_MATERIALS[name][0]) + steps, THINNEST, THICKEST)
        found += [Slab(name, float(one)) for one in np.unique(metres)]
    return found


def _wavelength(entry: str, frequency_hz: float) -> float:
    """Returns the wavelength in the material, metres."""
    return SPEED_OF_LIGHT / frequency_hz / float(np.sqrt(ITU_MATERIALS[entry][0]))


def _best(params: WaveParams, material: int, slabs: list[Slab], score: Scores, glance: int) -> tuple[WaveParams, list[Slab]]:
    """Returns parameters with the best of some slabs for a material, and the likely slabs, the best first. The material is
    unchanged if its current properties fit better, or if it has no effect."""
    # A third of the first spectra (`thickness_glance`) is used to select the third of many slabs scored on all of them
    fewer = 3
    few, left = len(slabs) // fewer, slabs
    if few > ONCE_MORE:
        left = _ranked(params, material, slabs, score, -(-glance // fewer))[:few] or slabs
    likely = _ranked(params, material, left, score, glance)[:ONCE_MORE]
    if not likely:
        return params, slabs
    close = [params, *(_made_of(params, material, slab) for slab in likely[:SHORTLIST])]
    return close[int(np.argmin(score(close).mean(1)))], likely


def _ranked(params: WaveParams, material: int, slabs: list[Slab], score: Scores, spectra: int) -> list[Slab]:
    """Returns slabs sorted by their scores on the first `spectra` spectra, the best first; an empty list if the material has no
    effect on these."""
    scores = score([_made_of(params, material, slab) for slab in slabs], spectra).mean(1)
    return [] if np.ptp(scores) < UNSEEN else [slabs[i] for i in np.argsort(scores)]


def _made_of(params: WaveParams, material: int, slab: Slab) -> WaveParams:
    return dataclasses.replace(params, materials=with_entry(params.materials, material, *slab))
