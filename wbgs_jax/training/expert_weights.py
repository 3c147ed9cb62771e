"""Mixture weights of the experts of a field, fitted to validation links after the last step (host)."""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from wbgs_jax.fields import Field
from wbgs_jax.fields.base import Params, components_of
from wbgs_jax.fields.losses import COARSE
from wbgs_jax.fields.mixture import (
    ExpertPredictions,
    Mixing,
    coherent_alone,
    floor_of,
    learn_shares,
    nearness,
    observed_predictions,
    reported,
    similarity,
)
from wbgs_jax.radio.channel import NO_PATH_DB
from wbgs_jax.training.hooks import Context, Edit, Hook
from wbgs_jax.types import Batch


class Seen(NamedTuple):
    """Predictions of the experts for B links, with observations."""

    spectra: ExpertPredictions
    power: ExpertPredictions
    features: Float[Array, "b features"]
    """Features that the mixture weights depend on."""
    pas: Float[Array, "b 90 360"] | None
    power_db: Float[Array, " b"] | None


@dataclass(frozen=True)
class ExpertWeights(Hook):
    """The hook of a `Mixing` field: fits the mixture weights to validation links, which none of its components was trained on.
    For spectra or powers without observations, and without validation links, the coherent field is used alone. The noise floor
    of spectra is estimated as well (`fields.mixture`)."""

    stream: int = 4

    def due(self, step: int, steps: int) -> bool:
        """Returns whether the last step is done."""
        return step >= steps

    def apply(
        self, field: Field, params: Params, statistics: tuple[()], context: Context, step: int, rng: np.random.Generator
    ) -> Edit:
        """Returns the parameters with fitted weights, or unchanged if a component is missing."""
        mixing, same = field.ability(Mixing), Edit(params, (), lambda tree: tree, {})
        if mixing is None or len(components_of(field)) < len(field.components):
            return same
        if not (batches := context.validation()):
            alone = mixing.field.with_shares(mixing.of(params), coherent_alone(), coherent_alone())
            return same._replace(params=mixing.put(params, alone))
        context.say("validation: weights of the coherent and the splatting half")
        raw = mixing.put(params, mixing.field.with_shares(mixing.of(params)))
        receivers = {_receiver_of(batch): batch.receiver for batch in batches}
        plans = {number: field.plan(raw, receiver, context.prepared) for number, receiver in receivers.items()}
        own = {number: mixing.of(plan) for number, plan in plans.items()}
        found = (expert_predictions_of(mixing.field, mixing.of(raw), own[_receiver_of(batch)], batch) for batch in batches)
        seen = [jax.tree.map(np.asarray, one) for one in found]
        predicted, powers, features, pas, measured_db = jax.tree.map(lambda *parts: np.concatenate(parts), *seen)
        tx_index = np.concatenate([np.asarray(batch.links.tx_index) for batch in batches])
        floor, spectra, power = 0.0, coherent_alone(), coherent_alone()
        if pas is not None:
            floor = floor_of(predicted, pas, tx_index)
            spectra = learn_shares(
                features, tx_index, observed_predictions(predicted, floor), partial(similarity, pas, stride=COARSE)
            )
        if measured_db is not None and np.any(measured_db > NO_PATH_DB):
            usual_spread_db = 1.0  # of the difference in error of two experts, over transmitters
            power = learn_shares(features, tx_index, powers, partial(nearness, measured_db), usual_spread_db)
        report = {name: reported(shares, features) for name, shares in (("spectra", spectra), ("power", power))}
        weighted = mixing.field.with_shares(mixing.of(params), spectra, power, floor)
        return same._replace(params=mixing.put(params, weighted), report={"shares": report, "noise_floor": floor})


def _receiver_of(batch: Batch) -> int:
    return int(batch.links.receiver_index[0])


@jax.jit
def expert_predictions_of(field: Mixing, params: Params, plan: Any, batch: Batch) -> Seen:
    """Returns the experts' spectra and received powers of links, the features of their weights, and the observations."""
    spectra, power, features = field.expert_predictions(params, plan, batch.links)
    return Seen(spectra, power, features, batch.pas, batch.received_db)
