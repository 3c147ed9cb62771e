"""Search on the host, before the first epoch, for what gradients alone cannot find: antennas, materials, places of surfaces.

The first two are a choice among known ones by how well they explain some training spectra; surfaces are moved where the mesh is
doubtful, and how far they may still be off is guessed. Training goes on from there.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from wbgs_jax.config import SearchConfig
from wbgs_jax.fields import Field
from wbgs_jax.training.antennas import search_antennas
from wbgs_jax.training.controls import Context, Edit
from wbgs_jax.training.geometry import Place, is_doubtful, learn_geometry
from wbgs_jax.training.materials import search_materials
from wbgs_jax.training.placement import search_placement
from wbgs_jax.training.scores import make_scores


@dataclass(frozen=True)
class Search:
    """The host control of fields whose parameters hold antennas and `materials`, and whose links are prepared."""

    config: SearchConfig
    stream: int = 6

    def statistics(self, params: Any) -> tuple[()]:
        """Returns nothing: it watches no step."""
        return ()

    def accumulate(self, statistics: tuple[()], gradients: Any, probe: Any) -> tuple[()]:
        """Returns nothing."""
        return ()

    def due(self, step: int, steps: int) -> bool:
        """Returns whether it is before the first step."""
        return step == 0 and (self.config.rounds > 0 or self.config.antenna_rounds > 0)

    def apply(
        self, field: Field, params: Any, statistics: tuple[()], context: Context, step: int, rng: np.random.Generator
    ) -> Edit:
        """Returns the antennas and materials that explain some training spectra best, and the field with its surfaces moved if
        the mesh is doubtful."""
        config, data, cache = self.config, context.data, context.cache
        spectra = rng.choice(context.train, min(config.spectra, len(context.train)), replace=False)
        report = {}
        if config.antenna_rounds:
            some = spectra[: config.antenna_spectra]
            score = make_scores(field, cache, data, jnp.asarray(some, jnp.int32))
            known = bool(np.any(np.asarray(data.receivers.pattern_exponents) != 0))
            params, found = search_antennas(params, score, np.asarray(data.links.tx_index)[some], config, known)
            report["antennas"] = dataclasses.asdict(found)
        if config.rounds:
            score = make_scores(field, cache, data, jnp.asarray(spectra, jnp.int32))
            params, named = search_materials(params, score, config)
            report["search"] = dataclasses.asdict(named)
            frequency_hz = np.asarray(data.links.query.frequency_hz)[spectra]
            if config.geometry_steps and is_doubtful(score([params])[0], frequency_hz):
                place, moved = learn_geometry(Place(field, params, cache), data, context.train, config, rng)
                report["geometry"] = dataclasses.asdict(moved)
                params, field, cache = place.params, place.field, place.cache
            some = spectra[: config.placement_spectra]
            score = make_scores(field, cache, data, jnp.asarray(some, jnp.int32), phases=False)
            params, guessed = search_placement(params, score)
            report["placement"] = dataclasses.asdict(guessed)
        return Edit(params, (), None, report, field, cache)
