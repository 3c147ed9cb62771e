"""How badly candidates for a field's parameters explain some training spectra: what the searches before a training compare."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wbgs_jax.fields import Field
from wbgs_jax.fields.losses import log_decorrelation
from wbgs_jax.training.data import TrainingData

Scores = Callable[[Sequence[Any]], Float[np.ndarray, "k n"]]
"""K candidates for all parameters -> how badly each explains N spectra: log decorrelation, or log error of spectra alone."""


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
