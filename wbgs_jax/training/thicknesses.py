"""Search for the thicknesses of walls and boards that nobody has measured, together with what they are made of.

What passes a slab, or comes back from its far side, has turned by its optical thickness, t sqrt(eps_r), in wavelengths. At low
frequencies few thicknesses can be told from each other and one look at all of them is enough; every higher frequency then tells
those apart that the ones before it left, just as surfaces are put in place (geometry.py). Entries of the list of materials are
tried with the thickness that keeps the optical thickness as it is. What comes out is taken if it says spectra surely better
than materials alone, of the thickness that they had.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from wbgs_jax.config import SearchConfig
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.materials import ITU_MATERIALS, UNSEEN, SearchReport, search_materials, with_entry
from wbgs_jax.training.scores import Compared, Scores, Told, surely_better

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
SHORTLIST = 8
"""Candidates that are looked at closely: the best at a first glance."""
BLOCK = 32
"""Candidates that are scored at once; so many, always, that nothing is compiled twice."""
SURE = 2.0
"""As many standard errors over transmitters as the gain has to be sure by (`surely_better`)."""


def search_slabs(
    params: Any, told: Told, config: SearchConfig, count: int, compared: Compared = "snapshots"
) -> tuple[Any, SearchReport]:
    """Returns parameters with the materials, and their thicknesses where the scene does not say, that explain spectra best.

    Args:
        params: with `materials`, one of them for each of the field's thicknesses.
        told: what training spectra say.
        config: of the search for materials; `thickness_spectra` are looked at for every frequency.
        count: spectra by which materials are named.
        compared: of those.
    """
    score, unknown = told.scores(count, compared), np.asarray(told.field.known_thickness) == 0
    named, report = search_materials(params, score, config)
    if not unknown.any():
        return named, report
    sized, anew = search_materials(_sized(params, unknown, told, config, compared), score, config)
    before, after = score([named, sized])
    if not surely_better(before - after, told.tx_index(count), SURE):
        return named, report
    metres = np.exp(np.asarray(sized.materials.log_thickness))
    thick = {int(i): round(1e3 * float(metres[i]), 2) for i in np.flatnonzero(unknown)}
    return sized, dataclasses.replace(anew, before=report.before, thickness_mm=thick)


def _sized(params: Any, unknown: Bool[np.ndarray, " m"], told: Told, config: SearchConfig, compared: Compared) -> Any:
    """Returns parameters with materials and thicknesses as spectra of ever higher frequencies say."""
    spread = float(jnp.exp(jnp.median(params.placement)))
    before = None
    for frequency_hz in frequencies_to_look_at(told.frequency_hz(), BELIEVED * SPEED_OF_LIGHT / spread):
        score = told.scores(config.thickness_spectra, compared, frequency_hz)
        for material in [*np.flatnonzero(unknown)] * (1 if before else 2):
            candidates = [params, *_candidates(params, int(material), frequency_hz, before)]
            params = _best(candidates, score, config.glance)
        before = frequency_hz
    return params


def frequencies_to_look_at(frequency_hz: Float[np.ndarray, " n"], believed_hz: float) -> list[float]:
    """Returns the highest frequencies of the looks, ascending: those of the data as far as they stand apart and their phases
    are believed, but not the lowest by itself, which tells little."""
    found = [float(frequency_hz.max())]
    for one in np.unique(frequency_hz)[::-1]:
        found += [float(one)] if one * APART <= found[-1] else []
    first, *others = found[::-1][min(1, len(found) - 1) :]
    return [first, *(one for one in others if one <= believed_hz)]


def _candidates(params: Any, material: int, frequency_hz: float, before_hz: float | None) -> Iterator[Any]:
    """Yields parameters in which one material is an entry of the list, of some thickness."""
    present = params.materials
    optical = float(jnp.exp(present.log_thickness[material]) * jnp.sqrt(1 + jnp.exp(present.log_susceptibility[material])))
    for name, (permittivity, _, _) in ITU_MATERIALS.items():
        wavelength = SPEED_OF_LIGHT / frequency_hz / np.sqrt(permittivity)
        if before_hz is None:
            thicknesses = np.concatenate([SHEETS, np.arange(0.02, THICKEST, FIRST_STEP * wavelength)[:MOST]])
        else:
            around = int(np.ceil(frequency_hz / before_hz))
            thicknesses = optical / np.sqrt(permittivity) + STEP * wavelength * np.arange(-around, around + 1)
        entry = with_entry(present, material, name)
        for metres in np.unique(np.clip(thicknesses, THINNEST, THICKEST)):
            yield dataclasses.replace(params, materials=_of_thickness(entry, material, metres))


def _of_thickness(materials: Any, material: int, metres: float) -> Any:
    return dataclasses.replace(materials, log_thickness=materials.log_thickness.at[material].set(np.log(metres)))


def _best(candidates: list[Any], score: Scores, glance: int) -> Any:
    """Returns the best candidate; the first one, where it makes no difference."""
    first = np.concatenate([_scores(candidates[i : i + BLOCK], score, glance) for i in range(0, len(candidates), BLOCK)])
    if np.ptp(first) < UNSEEN:
        return candidates[0]
    close = [candidates[0], *(candidates[i] for i in np.argsort(first)[:SHORTLIST])]
    return close[int(np.argmin(score(close).mean(1)))]


def _scores(candidates: list[Any], score: Scores, glance: int) -> Float[np.ndarray, " k"]:
    """Returns the mean scores of at most a block of candidates at a first glance."""
    padded = candidates + candidates[-1:] * (BLOCK - len(candidates))
    return score(padded, glance)[: len(candidates)].mean(1)
