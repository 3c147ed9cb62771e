"""Bodies that a mesh has and the room does not: furniture that has been carried away, or that stands there twice.

What is not there neither reflects nor shades, as if it were made of air, and that is how it is tried: every mover of the facets
gets a material of its own, and those are left out, one after the other, without which spectra are explained surely better. Then
paths are traced and materials named again, which lets others be seen, until none is left out or spectra of all frequencies
say that it was wrong. Only low frequencies are asked: at high ones a body that stands a little elsewhere is worse than none.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from wbgs_jax._util.pytree import replaced
from wbgs_jax.config import SearchConfig
from wbgs_jax.propagation.facets import centres
from wbgs_jax.radio.array import SPEED_OF_LIGHT
from wbgs_jax.training.antennas import ENDS
from wbgs_jax.training.materials import search_materials, with_properties
from wbgs_jax.training.scores import Told, surely_better
from wbgs_jax.training.thicknesses import search_slabs

AIR = (1.0001, 1e-9, 0.0, 1e-4)
"""Relative permittivity, c and d of the conductivity c f^d, metres: what changes no wave."""
ROUNDS = 3
"""Times that all movers are gone through, at most."""
CLOSELY = 32
"""Movers that are looked at closely: those without which a glance explains spectra best."""
BELIEVED = 0.1
"""Wavelengths: a body that stands no further off than this is better than none."""
SURE = 2.0
"""As many standard errors over transmitters as a gain has to be sure by (`surely_better`)."""


@dataclass(frozen=True)
class AbsentReport:
    """What was left out."""

    before: float
    """Mean score of training spectra with the mesh as it was ..."""
    after: float
    """... and without the bodies."""
    centres: list[list[float]]
    """Of all that were left out: metres, world frame."""


def search_absent(params: Any, told: Told, config: SearchConfig) -> tuple[Any, Told, AbsentReport]:
    """Returns parameters, and the field with its paths, without the bodies whose absence spectra tell.

    Args:
        params: with materials that have been named.
        told: what training spectra say.
        config: `absent_spectra` are looked at, up to the highest frequency at which places are believed.
    """
    score = told.scores(config.spectra)
    before = now = score([params])[0]
    tx, where = told.tx_index(config.spectra), list[list[float]]()
    unknown, once = bool(np.any(np.asarray(told.field.known_thickness) == 0)), dataclasses.replace(config, rounds=1)
    for _ in range(ROUNDS):
        movers = absent_movers(params, told, config)
        if not len(movers):
            break
        field = told.field.without(movers)
        fewer = dataclasses.replace(told, field=field, cache=field.prepare(told.data.links, told.data.receivers))
        others, _ = search_materials(_carried(params, field), fewer.scores(config.spectra), once, usual=unknown)
        after = fewer.scores(config.spectra)([others])[0]
        if not surely_better(now - after, tx, SURE):
            break
        middles = np.asarray(centres(told.field.facets, len(told.field.motion.shift)))[movers]
        where += np.round(middles.astype(float), 3).tolist()
        params, told, now = others, fewer, after
    if where and config.rounds:
        params, _, _ = search_slabs(params, told, config, config.spectra)
    return params, told, AbsentReport(float(before.mean()), float(now.mean()), where)


def absent_movers(params: Any, told: Told, config: SearchConfig) -> Int[np.ndarray, " k"]:
    """Returns the movers without which some spectra are explained surely better, each without those before it."""
    own, params = _each_by_itself(params, told)
    frequency = max(float(told.frequency_hz().min()), BELIEVED * SPEED_OF_LIGHT / config.geometry_width)
    score = own.scores(config.absent_spectra, highest_hz=frequency)
    looked_at = own.spectra[own.frequency_hz() <= frequency * (1 + 1e-6)][: config.absent_spectra]
    tx = np.asarray(own.data.links.tx_index)[looked_at]
    everyone = range(len(own.field.motion.shift))
    gains = score([params], config.absent_glance) - score([_of_air(params, one) for one in everyone], config.absent_glance)
    likely = [int(one) for one in np.argsort(-gains.mean(1))[:CLOSELY] if gains[one].mean() > 0]
    now, gone = score([params])[0], list[int]()
    closely = (now - score([_of_air(params, one) for one in likely])).mean(1) if likely else np.zeros(0)
    for one in np.array(likely, int)[np.argsort(-closely)].tolist():
        without = _of_air(params, one)
        scores = score([without])[0]
        if surely_better(now - scores, tx, SURE):
            params, now = without, scores
            gone.append(one)
    return np.sort(np.array(gone, int))


def _each_by_itself(params: Any, told: Told) -> tuple[Told, Any]:
    """Returns the field, its paths and its parameters with every mover of a material of its own, alike to begin with, and of a
    thickness that nobody knows."""
    facets = told.field.facets
    mover, material = np.asarray(facets.mover), np.asarray(facets.material)
    source = material[np.unique(mover, return_index=True)[1]]
    known = told.field.known_thickness[source]
    own: Any = jax.tree.map(lambda leaf: leaf[source], params.materials)
    own = dataclasses.replace(own, log_thickness=jnp.where(known > 0, jnp.log(jnp.maximum(known, 1e-9)), own.log_thickness))
    field = replaced(told.field, facets=replaced(facets, material=facets.mover), known_thickness=jnp.zeros_like(known))
    surfaces = told.cache.surfaces
    surfaces = replaced(surfaces, facets=replaced(surfaces.facets, material=facets.mover))
    cache = replaced(told.cache, surfaces=surfaces)
    return dataclasses.replace(told, field=field, cache=cache), replaced(params, materials=own)


def _of_air(params: Any, mover: int) -> Any:
    return replaced(params, materials=with_properties(params.materials, mover, *AIR))


def _carried(params: Any, field: Any) -> Any:
    """Returns the first parameters of a field with the materials and antennas that were found in another."""
    return replaced(field.init(jax.random.key(0)), **{name: getattr(params, name) for name in ("materials", *ENDS)})
