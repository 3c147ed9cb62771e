"""Search on the host, before the first epoch, for what gradients alone cannot find: antennas, then materials.

Both are a choice among known ones by how well they explain some training spectra, and training goes on from there.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wbgs_jax.config import SearchConfig
from wbgs_jax.fields import Field
from wbgs_jax.fields.losses import log_decorrelation
from wbgs_jax.training.antennas import search_antennas
from wbgs_jax.training.controls import Context, Edit
from wbgs_jax.training.data import TrainingData
from wbgs_jax.training.materials import search_materials

Scores = Callable[[Sequence[Any]], Float[np.ndarray, "k n"]]
"""K candidates for all parameters -> how badly each explains N spectra: log decorrelation, or log error of spectra alone."""


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
        """Returns the parameters with the antennas and materials that explain some training spectra best."""
        config, data = self.config, context.data
        spectra = rng.choice(context.train, min(config.spectra, len(context.train)), replace=False)
        report = {}
        if config.antenna_rounds:
            some = spectra[: config.antenna_spectra]
            score = make_scores(field, context.cache, data, jnp.asarray(some, jnp.int32))
            known = bool(np.any(np.asarray(data.receivers.pattern_exponents) != 0))
            params, found = search_antennas(params, score, np.asarray(data.links.tx_index)[some], config, known)
            report["antennas"] = dataclasses.asdict(found)
        if config.rounds:
            score = make_scores(field, context.cache, data, jnp.asarray(spectra, jnp.int32))
            params, named = search_materials(params, score, config)
            report["search"] = dataclasses.asdict(named)
        return Edit(params, (), None, report)


def make_scores(field: Field, cache: Any, data: TrainingData, spectra: Int[Array, "n"]) -> Scores:
    """Returns the function that scores candidates on some spectra of one receiver."""

    def score(candidates: Sequence[Any]) -> Float[np.ndarray, "k n"]:
        return np.asarray(_score(field, jax.tree.map(lambda *leaves: jnp.stack(leaves), *candidates), cache, data, spectra))

    return score


@jax.jit
def _score(field: Field, candidates: Any, cache: Any, data: TrainingData, spectra: Int[Array, "n"]):
    batch = data.batch(spectra, jax.random.key(0))
    plan = field.plan(jax.tree.map(lambda leaf: leaf[0], candidates), batch.receiver, None, cache)

    def one(params):
        seen = field.render_links(params, plan, cache, batch.links)
        if seen.snapshots is not None and batch.snapshots is not None:
            return log_decorrelation(seen.snapshots, batch.snapshots)
        assert batch.pas is not None, "candidates are scored by spectra or snapshots"
        return jnp.log(jnp.mean(jnp.abs(seen.pas - batch.pas), (-2, -1)))

    return jax.lax.map(one, candidates)
