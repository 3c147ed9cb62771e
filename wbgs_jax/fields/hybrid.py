"""The hybrid field: a mixture of the coherent field and the paper's splatting field, with weights for every query.

The coherent field is accurate to the phase where mesh and physics are, and can be far off where they are not; the splatting
field needs neither, but its spectra are blurred. Its networks can be conditioned on the spectrum of the coherent field and so
learn where that is wrong, for example behind furniture that is missing from the mesh. In training they are conditioned for half
of the queries, so that this field provides two experts: an unconditioned one, which errs in other places than the coherent
field, and a conditioned one. Both fields are trained on the same batches; the mixture weights of the three experts for each
query are those that fit validation transmitters best (mixture.py).
Without a mesh it is the splatting field alone.
"""

import dataclasses
import warnings
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import pytree, replaced, static
from wbgs_jax.config import Settings
from wbgs_jax.fields.base import Aux, Field, Group, Inspection, Observation, TrainingTime, register
from wbgs_jax.fields.coherent import WaveConfig, WaveField
from wbgs_jax.fields.coherent_model import PreparedPaths
from wbgs_jax.fields.mixture import (
    ExpertPredictions,
    Shares,
    at_first,
    features,
    mixed,
    with_floor,
    without_floor,
)
from wbgs_jax.fields.wideband import WidebandConfig, WidebandField, WidebandParams, WidebandPlan, gaussian_state
from wbgs_jax.radio.channel import NO_PATH_DB
from wbgs_jax.splat.tiles import TileLimits
from wbgs_jax.types import Batch, Query, Receiver, Scene


@dataclass(frozen=True)
class HybridConfig:
    """Settings of both fields."""

    wave: WaveConfig = field(default_factory=WaveConfig)
    wideband: WidebandConfig = field(default_factory=WidebandConfig)

    def check(self, name: str) -> None:
        """Raises a `UserError` for invalid settings; the message names the option of the field concerned."""
        self.wave.check("wave")
        self.wideband.check("wideband")
        if not self.wave.coherent:
            raise UserError("--wave.no-coherent leaves no coherent field to mix; train --field wideband")


@pytree
class Trust:
    """Mixture weights of the three experts, and the noise floor."""

    spectra: Shares
    """Weights for spectra."""
    power: Shares
    """Weights for received power in decibels."""
    floor: Float[Array, ""]
    """Noise floor in the spectra that the splatting field was trained on (`mixture.with_floor`); predictions are without it."""


@pytree
class HybridParams:
    """Parameters of both fields, and of their mixture."""

    wave: Any
    """Parameters of the coherent field (`WaveParams`), or None without one."""
    wideband: WidebandParams
    trust: Trust


@pytree
class HybridPlan:
    """Everything that is independent of the query."""

    wave: Any
    """Plan of the coherent field (`WavePlan`), or None without one."""
    wideband: WidebandPlan


SHARE_WITH_PATHS = {"cpu": 0.58}
"""Fractions of the steps of the splatting field (`OptimConfig.share_with_paths`) that were found to suffice."""


def _preset(name: str) -> Settings:
    wave, wideband = WaveField.presets[name], WidebandField.presets[name]
    optim = dataclasses.replace(wideband.optim, share_with_paths=SHARE_WITH_PATHS.get(name, 1.0))
    config = HybridConfig(wave.field, wideband.field)
    return dataclasses.replace(wideband, field=config, optim=optim, calibration=wave.calibration)


@register
@pytree
class HybridField(Field):
    """The coherent field and the splatting field of a scene."""

    wave: Any
    """Coherent field (`WaveField`), or None if the scene does not support one."""
    wideband: WidebandField
    config: HybridConfig = static()

    name: ClassVar[str] = "hybrid"
    presets: ClassVar = {name: _preset(name) for name in WaveField.presets}
    outputs: ClassVar = WaveField.outputs
    components: ClassVar = {"wideband": WidebandField, "wave": WaveField}
    hooks: ClassVar = ("wideband.density", "wave.calibration", "expert_weights")
    seconds: ClassVar = {"cpu": TrainingTime(265, 115, 140), "smoke": TrainingTime(25, 67, 68)}

    @classmethod
    def build(cls, config: HybridConfig, scene: Scene, seed: int) -> "HybridField":
        """Returns the field of a scene."""
        config.check(cls.name)
        return cls(_coherent(config.wave, scene, seed), WidebandField.build(config.wideband, scene, seed), config)

    def init(self, key: Key[Array, ""]) -> HybridParams:
        """Returns initial parameters, with equal weights of both fields."""
        wave = None if self.wave is None else self.wave.init(key)
        wideband = self.wideband.init(key, given=wave is not None)
        return HybridParams(wave, wideband, Trust(at_first(), at_first(), jnp.zeros(())))

    def plan(
        self,
        params: HybridParams,
        receiver: Receiver,
        prepared: PreparedPaths | None = None,
        capacity: TileLimits | None = None,
    ) -> HybridPlan:
        """Returns the plans of both fields: a receiver's mirror images (host; not needed if paths are prepared) and the
        projected Gaussians."""
        wave = None if self.wave is None else self.wave.plan(params.wave, receiver, prepared)
        return HybridPlan(wave, self.wideband.plan(params.wideband, receiver, None, capacity))

    def render(self, params: HybridParams, plan: HybridPlan, links: Query) -> Observation:
        """Returns the mixed spectra and received powers of B links, and the snapshots and paths of the coherent field."""
        if self.wave is None:
            return self.wideband.render(params.wideband, plan.wideband, links)
        coherent = self.wave.render(params.wave, plan.wave, links)
        pas, power_db, inputs = self._predicted(params, plan, links, coherent)
        spectra, power = mixed(params.trust.spectra, inputs, pas), mixed(params.trust.power, inputs, power_db)
        return coherent._replace(pas=spectra, power_db=power, covariance=None)  # the covariance is of the coherent field only

    def expert_predictions(
        self, params: HybridParams, plan: HybridPlan, links: Query
    ) -> tuple[ExpertPredictions, ExpertPredictions, Float[Array, "b features"]]:
        """Returns the experts' spectra and received powers (dB) of B links, and the features that their weights depend on; the
        scene must have a mesh."""
        return self._predicted(params, plan, links, self.wave.render(params.wave, plan.wave, links))

    def with_shares(
        self, params: HybridParams, spectra: Shares | None = None, power: Shares | None = None, floor: float = 0.0
    ) -> HybridParams:
        """Returns parameters with other mixture weights, where given, and another noise floor of spectra."""
        trust = Trust(spectra or params.trust.spectra, power or params.trust.power, jnp.asarray(floor, jnp.float32))
        return dataclasses.replace(params, trust=trust)

    def _predicted(
        self, params: HybridParams, plan: HybridPlan, query: Query, coherent: Observation
    ) -> tuple[ExpertPredictions, ExpertPredictions, Float[Array, "b features"]]:
        """Returns the experts' spectra and received powers (dB) of B queries, and the features that their weights depend on."""
        assert coherent.pas is not None and coherent.power_db is not None, "the coherent field predicts both"
        nothing = jnp.zeros_like(coherent.pas)
        own, informed = (
            self.wideband.render(params.wideband, plan.wideband, query, given) for given in (nothing, coherent.pas)
        )
        inputs = features(query, plan.wave.receiver.position, coherent, own)
        assert own.power_db is not None, "the splatting field predicts received power"
        met = coherent.power_db > NO_PATH_DB  # without any path the coherent field predicts nothing
        powers = ExpertPredictions(jnp.where(met, coherent.power_db, own.power_db), own.power_db, informed.power_db)
        floor = jax.lax.stop_gradient(params.trust.floor)  # estimated, not trained
        clean, clean_informed = (without_floor(seen.pas, floor) for seen in (own, informed))
        spectra = ExpertPredictions(jnp.where(met[:, None, None], coherent.pas, clean), clean, clean_informed)
        return spectra, powers, inputs

    def as_observed(self, params: HybridParams, pas: Float[Array, "b 90 360"]) -> Float[Array, "b 90 360"]:
        """Returns spectra with the noise floor of the training data."""
        floor = jax.lax.stop_gradient(params.trust.floor)
        return jnp.where(floor > 0, with_floor(pas, floor), pas)

    def loss(
        self,
        params: HybridParams,
        prepared: PreparedPaths | None,
        batch: Batch,
        capacity: TileLimits | None = None,
        probe: Any = None,
    ) -> tuple[Float[Array, ""], Aux]:
        """Returns the sum of both losses. The conditioning spectra are constants to the gradient: the loss of the splatting
        field does not change the coherent field."""
        if self.wave is None:
            return self.wideband.loss(params.wideband, None, batch, capacity, probe)
        seen = self.wave.render(params.wave, self.wave.plan(params.wave, batch.receiver, prepared), batch.links)
        coherent, other = self.wave.compared(params.wave, seen, batch)
        given = jnp.where(_informed(batch), jax.lax.stop_gradient(seen.pas), 0)
        loss, aux = self.wideband.loss(params.wideband, None, batch, capacity, probe, given)
        figures = {f"{name}_wave": value for name, value in other.metrics.items()} | aux.metrics
        return loss + coherent, aux._replace(metrics=figures)

    @classmethod
    def param_groups(cls, config: HybridConfig, params: HybridParams | None = None) -> tuple[dict[str, Group], Any]:
        """Returns the groups of both fields under their names; mixture weights are not trained, but fitted afterwards."""
        groups, labels = super().param_groups(config, params)
        trust = None if params is None else jax.tree.map(lambda _: "trust", params.trust)
        return groups | {"trust": Group(0.0)}, None if params is None else replaced(labels, trust=trust)

    def inspect(self, params: HybridParams, plan: HybridPlan | None = None, links: Query | None = None) -> Inspection:
        """Returns the contents of both fields, with the state of the Gaussians conditioned on the coherent field."""
        found = super().inspect(params)
        if plan is None or links is None:
            return found
        given = None if self.wave is None else self.wave.render(params.wave, plan.wave, links).pas
        return found._replace(gaussians=gaussian_state(params.wideband, plan.wideband, links, given))


def _coherent(config: WaveConfig, scene: Scene, seed: int) -> WaveField | None:
    """Returns the coherent field of a scene, or None with a warning if the scene has no mesh that it could use."""
    try:
        return WaveField.build(config, scene, seed)
    except UserError as why:
        reason = str(why).split(";")[0]  # without the advice, which is meant for `--field wave`
        # The stack level is that of this line, so that the warning appears once.
        warnings.warn(f"the hybrid field uses its wideband component only: {reason}", stacklevel=1)
        return None


def _informed(batch: Batch) -> Bool[Array, "b 1 1"]:
    """Returns the links for which the splatting field is conditioned on the coherent one: half of them, drawn anew in each
    step, and independent of the number of devices that share the batch."""

    def drawn(tx: Any, frequency_hz: Any) -> Any:
        key = jax.random.fold_in(batch.key, tx)
        return jax.random.bernoulli(jax.random.fold_in(key, jax.lax.bitcast_convert_type(frequency_hz, jnp.uint32)))

    return jax.vmap(drawn)(batch.links.tx_index, batch.links.frequency_hz)[:, None, None]
