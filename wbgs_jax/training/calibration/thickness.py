"""Search for the thicknesses of walls and boards that nobody has measured, together with what they are made of.

What passes a slab, or comes back from its far side, has turned by its optical thickness, t sqrt(eps_r), in wavelengths. At low
frequencies few thicknesses can be told from each other and one look at all of them is enough; every higher frequency then tells
those apart that the ones before it left, just as surfaces are put in place (alignment.py). Entries of the list of materials are
tried with the thickness that keeps the optical thickness as it is. Materials as thick as is usual are the beginning; what comes
out is taken if it explains snapshots surely better than the materials that were named without it.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from wbgs_jax.config import SearchConfig
from wbgs_jax.fields.coherent_model import Materials, WaveParams
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.calibration.material_fit import (
    ITU_MATERIALS,
    UNSEEN,
    SearchReport,
    search_materials,
    unknown_mm,
    with_entry,
)
from wbgs_jax.training.calibration.objective import Compared, Scores, Told, surely_better

SHEETS = (0.002, 0.004, 0.006, 0.01, 0.015)
"""Metres: thicknesses of what is thinner than a step of the first look."""
THINNEST, THICKEST = 5e-4, 0.35
"""Metres."""
FIRST_STEP, STEP = 1 / 6, 1 / 8
"""Of the wavelength in the material, from one thickness to the next at the first frequency and at those after it."""
MOST = 40
"""Thicknesses of one entry at the first look, besides sheets."""
APART = 1.25
"""Ratio of two frequencies that are looked at one after the other, at least."""
BELIEVED = 0.1
"""Wavelengths: where surfaces may stand further off (standard deviation), phases tell nothing of thicknesses."""
FEWER = 3
"""A third of the spectra of a glance tell which third of many slabs deserve the whole of it."""
SHORTLIST = 4
"""Slabs that are looked at closely: the best at a glance."""
ONCE_MORE = 60
"""Slabs that are tried again when all materials have been looked at once, or surfaces have moved: the best at a glance ..."""
ENTRIES = 6
"""... and entries of the list that are tried at higher frequencies: those of the best of them."""
SURE = 2.0
"""As many standard errors over transmitters as the gain has to be sure by (`surely_better`)."""


class Slab(NamedTuple):
    """An entry of the list of materials, so many metres thick."""

    entry: str
    metres: float


Likely = dict[int, list[Slab]]
"""Of all materials of unknown thickness the best slabs at a first glance, the best first; all slabs of a material that no path
has met."""


def search_slabs(
    params: WaveParams,
    told: Told,
    config: SearchConfig,
    count: int,
    compared: Compared = "snapshots",
    likely: Likely | None = None,
) -> tuple[WaveParams, SearchReport, Likely | None]:
    """Returns parameters with the materials that explain spectra best, and with thicknesses that the scene does not say; and
    the slabs that were likely, if any were looked for.

    Thicknesses are searched where snapshots are known; to pictures alone materials are as thick as is usual.

    Args:
        params: with `materials`, one of them for each of the field's thicknesses.
        told: what training spectra say.
        config: of the search for materials; `thickness_spectra` are looked at for every frequency.
        count: spectra by which materials are named.
        compared: of those.
        likely: slabs, where those that are not likely have been ruled out before.
    """
    score, known = told.scores(count, compared), np.asarray(told.field.known_thickness)
    unknown = known == 0
    named, report = search_materials(params, told, count, config, compared, usual=bool(unknown.any()))
    if not unknown.any() or told.data.snapshots is None:  # a spectrum costs as much as ten snapshots, and tells less
        return named, report, likely
    once = dataclasses.replace(config, rounds=1)
    params, likely = _sized(named, unknown, told, config, compared, likely)
    sized, anew = search_materials(params, told, count, once, compared)
    before, after = score([named, sized])
    if not surely_better(before - after, told.tx_index(count), SURE):
        return named, report, likely
    thick = unknown_mm(sized.materials, known)
    return sized, dataclasses.replace(anew, before=report.before, thickness_mm=thick), likely


def _sized(
    params: WaveParams,
    unknown: Bool[np.ndarray, " m"],
    told: Told,
    config: SearchConfig,
    compared: Compared,
    likely: Likely | None,
) -> tuple[WaveParams, Likely]:
    """Returns parameters with materials and thicknesses as spectra of ever higher frequencies say, and the likely slabs."""
    materials, spread = np.flatnonzero(unknown).tolist(), float(jnp.exp(jnp.median(params.placement)))
    first, *others = frequencies_to_look_at(told.frequency_hz(), BELIEVED * SPEED_OF_LIGHT / spread)
    likely = dict(likely or {m: _all_slabs(first) for m in materials})
    score = told.scores(config.thickness_spectra, compared, first)
    for _ in range(2):
        for material in materials:
            params, likely[material] = _best(params, material, likely[material], score, config.thickness_glance)
    before = first
    for frequency_hz in others:
        score = told.scores(config.thickness_spectra, compared, frequency_hz)
        for material in materials:
            seen = len(likely[material]) <= ONCE_MORE  # of what no path has met, no entry is likelier than another
            entries = list(dict.fromkeys(slab.entry for slab in likely[material]))[: ENTRIES if seen else None]
            near = _slabs_near(params.materials, material, entries, frequency_hz, before)
            params, _ = _best(params, material, near, score, config.thickness_glance)
        before = frequency_hz
    return params, likely


def frequencies_to_look_at(frequency_hz: Float[np.ndarray, " n"], believed_hz: float) -> list[float]:
    """Returns the highest frequencies of the looks, ascending: those of the data as far as they stand apart and their phases
    are believed, but not the lowest by itself, which tells little, unless the first look at the next would miss thick walls."""
    found = [float(frequency_hz.max())]
    for one in np.unique(frequency_hz)[::-1]:
        found += [float(one)] if one * APART <= found[-1] else []
    first, *others = found[::-1]
    if others and len(_steps("concrete", others[0])) <= MOST:
        first, *others = others
    return [first, *(one for one in others if one <= believed_hz)]


def _all_slabs(frequency_hz: float) -> list[Slab]:
    """Returns all entries of the list in all thicknesses that differ at a frequency."""
    found = []
    for name in ITU_MATERIALS:
        found += [Slab(name, float(metres)) for metres in (*SHEETS, *_steps(name, frequency_hz)[:MOST])]
    return found


def _steps(entry: str, frequency_hz: float) -> Float[np.ndarray, " n"]:
    """Returns thicknesses (metres) that differ at a frequency, up to the thickest."""
    return np.arange(0.02, THICKEST, FIRST_STEP * _wavelength(entry, frequency_hz))


def _slabs_near(materials: Materials, material: int, entries: list[str], frequency_hz: float, before_hz: float) -> list[Slab]:
    """Returns entries in thicknesses that could not be told from the present one at the frequency before."""
    optical = float(jnp.exp(materials.log_thickness[material]) * jnp.sqrt(1 + jnp.exp(materials.log_susceptibility[material])))
    around, found = int(np.ceil(frequency_hz / before_hz)), []
    for name in entries:
        steps = STEP * _wavelength(name, frequency_hz) * np.arange(-around, around + 1)
        metres = np.clip(optical / np.sqrt(ITU_MATERIALS[name][0]) + steps, THINNEST, THICKEST)
        found += [Slab(name, float(one)) for one in np.unique(metres)]
    return found


def _wavelength(entry: str, frequency_hz: float) -> float:
    """Returns metres, in the material."""
    return SPEED_OF_LIGHT / frequency_hz / float(np.sqrt(ITU_MATERIALS[entry][0]))


def _best(params: WaveParams, material: int, slabs: list[Slab], score: Scores, glance: int) -> tuple[WaveParams, list[Slab]]:
    """Returns parameters in which a material is the best of some slabs, or what it was, where it makes no difference or fits
    better; and the likely ones of them, the best first."""
    few, left = len(slabs) // FEWER, slabs
    if few > ONCE_MORE:
        left = _ranked(params, material, slabs, score, -(-glance // FEWER))[:few] or slabs
    likely = _ranked(params, material, left, score, glance)[:ONCE_MORE]
    if not likely:
        return params, slabs
    close = [params, *(_made_of(params, material, slab) for slab in likely[:SHORTLIST])]
    return close[int(np.argmin(score(close).mean(1)))], likely


def _ranked(params: WaveParams, material: int, slabs: list[Slab], score: Scores, spectra: int) -> list[Slab]:
    """Returns slabs, the best first by so many spectra; none, where the material makes no difference to these."""
    scores = score([_made_of(params, material, slab) for slab in slabs], spectra).mean(1)
    return [] if np.ptp(scores) < UNSEEN else [slabs[i] for i in np.argsort(scores)]


def _made_of(params: WaveParams, material: int, slab: Slab) -> WaveParams:
    return dataclasses.replace(params, materials=with_entry(params.materials, material, *slab))
