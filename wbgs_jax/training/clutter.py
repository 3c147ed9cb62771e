"""Search for clutter: what stands in the way of waves and is not in the mesh (propagation/clutter.py).

Its density is fitted to the spectra of most transmitters by gradient descent, all else being what it is. If those of the others
are explained better with it, and not by chance, training goes on from there and learns it beside everything else; a few
transmitters, or a mesh that lacks nothing, do not show that, and then there is no clutter.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from wbgs_jax._util.pytree import replaced
from wbgs_jax.config import SearchConfig
from wbgs_jax.training.data import TrainingData, batches_of_one_receiver
from wbgs_jax.training.scores import Told, surely_better

JUDGES = 0.25
"""Share of the transmitters whose spectra say whether clutter is there."""
FEWEST = 6
"""Judges: fewer are never sure."""
SURE = 1.0
"""As many standard errors over transmitters as the gain has to be sure by (`surely_better`): where there is no clutter, what
was fitted explains other spectra worse, and so long as it does not it does no harm."""
LEAST = 2e-4
"""Error that clutter has to spare; spectra are at most 1."""
BATCH = 8


@dataclass(frozen=True)
class ClutterReport:
    """What was found."""

    before: float
    """Mean absolute error of the judges' spectra without clutter ..."""
    after: float
    """... and with it, taken or not."""
    taken: bool


def search_clutter(
    params: Any, told: Told, config: SearchConfig, rng: np.random.Generator
) -> tuple[Any, Told, ClutterReport | None]:
    """Returns parameters and field with clutter, if it is there; no report where too few could say so.

    Args:
        params: of a coherent field without clutter.
        told: what training spectra say.
        config: of the search.
        rng: draws who judges, and the batches of the others.
    """
    tx = told.tx_index()
    everyone = rng.permutation(np.unique(tx))
    judges = everyone[: round(JUDGES * len(everyone))]
    if len(judges) < FEWEST:
        return params, told, None
    judge = np.isin(tx, judges)
    judged = dataclasses.replace(told, spectra=told.spectra[judge][: config.clutter_spectra])
    batches = batches_of_one_receiver(told.data, told.spectra[~judge], config.clutter_steps, BATCH, rng)
    field = told.field.cluttered()
    clutter = _fitted(field, replaced(params, clutter=field.first_clutter), told.cache, told.data, batches)
    others, fuller = replaced(params, clutter=clutter), dataclasses.replace(told, field=field)
    before, after = _errors(judged, params), _errors(dataclasses.replace(judged, field=field), others)
    gains = before - after
    taken = bool(gains.mean() > LEAST) and surely_better(gains, judged.tx_index(), SURE)
    report = ClutterReport(float(before.mean()), float(after.mean()), taken)
    return (others, fuller, report) if taken else (params, told, report)


def _errors(told: Told, params: Any) -> Float[np.ndarray, " n"]:
    """Returns mean absolute errors: of their logarithms, spectra that are right anyway would have most to say."""
    found: Float[np.ndarray, " n"] = np.exp(told.scores(None, "spectra")([params])[0])
    return found


@jax.jit
def _fitted(field: Any, params: Any, cache: Any, data: TrainingData, batches: Int[Array, "k b"]) -> Float[Array, "x y z 2"]:
    """Returns the clutter after a step on every batch."""
    optimizer = optax.adam(optax.cosine_decay_schedule(field.config.clutter_lr, len(batches)))

    def loss(clutter: Float[Array, "x y z 2"], index: Int[Array, " b"]) -> Float[Array, ""]:
        found: Float[Array, ""] = field.loss(replaced(params, clutter=clutter), cache, data.batch(index, jax.random.key(0)))[0]
        return found

    def step(carry: Any, index: Int[Array, " b"]) -> tuple[Any, None]:
        clutter, state = carry
        updates, state = optimizer.update(jax.grad(loss)(clutter, index), state)
        return (optax.apply_updates(clutter, updates), state), None

    (clutter, _), _ = jax.lax.scan(step, (params.clutter, optimizer.init(params.clutter)), batches)
    return clutter
