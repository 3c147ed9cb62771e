"""The hybrid field: the coherent field and the paper's splatting field side by side, and how far each is to be trusted.

The coherent field is right to the phase where mesh and physics are, and can be far off where they are not; the splatting field
needs neither and blurs. Its networks may see what the coherent field says, and so learn where that is wrong: behind furniture
that the mesh lacks, say. In training they see it for half of the queries, so that the field has two opinions: one of its own,
which errs in other places than the coherent field, and an informed one. Both fields are trained on the same batches; what the
three opinions count for, query by query, is what explains validation transmitters best (mixture.py).
Without a mesh it is the splatting field by itself.
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
from wbgs_jax.fields.base import Aux, Field, Group, Inspection, Observation, register
from wbgs_jax.fields.coherent import WaveConfig, WaveField
from wbgs_jax.fields.coherent_model import PreparedPaths
from wbgs_jax.fields.mixture import (
    Opinions,
    Shares,
    at_first,
    features,
    mixed,
    with_floor,
    without_floor,
)
from wbgs_jax.fields.wideband import WidebandConfig, WidebandField, WidebandParams, WidebandPlan, gaussian_state
from wbgs_jax.radio.channel import NOT_HEARD_DB
from wbgs_jax.splat import TileLimits
from wbgs_jax.types import Batch, Links, Query, Receiver, Scene


@dataclass(frozen=True)
class HybridConfig:
    """Settings of the two fields."""

    wave: WaveConfig = field(default_factory=WaveConfig)
    wideband: WidebandConfig = field(default_factory=WidebandConfig)

    def check(self, name: str) -> None:
        """Raises a `UserError` for settings that cannot work; options are those of the two fields."""
        self.wave.check("wave")
        self.wideband.check("wideband")
        if not self.wave.coherent:
            raise UserError("--wave.no-coherent leaves nothing to mix; train --field wideband")


@pytree
class Trust:
    """How much each of three opinions counts."""

    spectra: Shares
    power: Shares
    """Of the received power in decibels."""
    floor: Float[Array, ""]
    """What noise has put under the spectra that the splatting field learned; its answers are without it."""


@pytree
class HybridParams:
    """What is trained."""

    wave: Any
    """`WaveParams`, or None without a coherent field."""
    wideband: WidebandParams
    trust: Trust


@pytree
class HybridPlan:
    """What is independent of the query."""

    wave: Any
    """`WavePlan`, or None without a coherent field."""
    wideband: WidebandPlan


def _preset(name: str) -> Settings:
    wave, wideband = WaveField.presets[name], WidebandField.presets[name]
    return dataclasses.replace(wideband, field=HybridConfig(wave.field, wideband.field), search=wave.search)


@register
@pytree
class HybridField(Field):
    """Both fields of a scene."""

    wave: Any
    """`WaveField`, or None where it could know nothing."""
    wideband: WidebandField
    config: HybridConfig = static()

    name: ClassVar[str] = "hybrid"
    presets: ClassVar = {name: _preset(name) for name in WaveField.presets}
    outputs: ClassVar = WaveField.outputs
    components: ClassVar = {"wideband": WidebandField, "wave": WaveField}
    hooks: ClassVar = ("wideband.density", "wave.search", "expert_weights")
    seconds: ClassVar = {"cpu": 700.0, "smoke": 60.0}

    @classmethod
    def build(cls, config: HybridConfig, scene: Scene, seed: int) -> "HybridField":
        """Returns the field of a scene."""
        config.check(cls.name)
        return cls(_coherent(config.wave, scene, seed), WidebandField.build(config.wideband, scene, seed), config)

    def init(self, key: Key[Array, ""]) -> HybridParams:
        """Returns initial parameters, both fields trusted alike."""
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
        """Returns a receiver's mirror images (host, unless they are prepared) and the projected Gaussians."""
        wave = None if self.wave is None else self.wave.plan(params.wave, receiver, prepared)
        return HybridPlan(wave, self.wideband.plan(params.wideband, receiver, None, capacity))

    def render(self, params: HybridParams, plan: HybridPlan, links: Query | Links) -> Observation:
        """Returns spectra and received power of B links, and the coherent field's snapshots and paths."""
        if self.wave is None:
            return self.wideband.render(params.wideband, plan.wideband, links)
        coherent = self.wave.render(params.wave, plan.wave, links)
        pas, power_db, told = self._said(params, plan, links.query, coherent)
        spectra, power = mixed(params.trust.spectra, told, pas), mixed(params.trust.power, told, power_db)
        return coherent._replace(pas=spectra, power_db=power, covariance=None)  # which is that of the coherent field alone

    def opinions(
        self, params: HybridParams, plan: HybridPlan, links: Query | Links
    ) -> tuple[Opinions, Opinions, Float[Array, "b features"]]:
        """Returns what spectra and powers of B links are said to be, and what tells whom to trust; of a scene with a mesh."""
        return self._said(params, plan, links.query, self.wave.render(params.wave, plan.wave, links))

    def with_shares(
        self, params: HybridParams, spectra: Shares | None = None, power: Shares | None = None, floor: float = 0.0
    ) -> HybridParams:
        """Returns parameters with other shares of the opinions, where they are given, and another floor under spectra."""
        trust = Trust(spectra or params.trust.spectra, power or params.trust.power, jnp.asarray(floor, jnp.float32))
        return dataclasses.replace(params, trust=trust)

    def _said(
        self, params: HybridParams, plan: HybridPlan, query: Query, coherent: Observation
    ) -> tuple[Opinions, Opinions, Float[Array, "b features"]]:
        """Returns what spectra and powers of B queries are said to be, and what tells whom to trust."""
        assert coherent.pas is not None and coherent.power_db is not None, "it knows both"
        nothing = jnp.zeros_like(coherent.pas)
        own, informed = (
            self.wideband.render(params.wideband, plan.wideband, query, given) for given in (nothing, coherent.pas)
        )
        told = features(query, plan.wave.receiver.position, coherent, own)
        assert own.power_db is not None, "as the coherent field does"
        met = coherent.power_db > NOT_HEARD_DB  # without any path the coherent field has no opinion
        powers = Opinions(jnp.where(met, coherent.power_db, own.power_db), own.power_db, informed.power_db)
        floor = jax.lax.stop_gradient(params.trust.floor)  # found, not trained
        clean, as_told = (without_floor(seen.pas, floor) for seen in (own, informed))
        spectra = Opinions(jnp.where(met[:, None, None], coherent.pas, clean), clean, as_told)
        return spectra, powers, told

    def as_observed(self, params: HybridParams, pas: Float[Array, "b 90 360"]) -> Float[Array, "b 90 360"]:
        """Returns spectra with what noise adds to them."""
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
        """Returns the sum of both losses. What the splatting field makes of the coherent one is no reason to change that."""
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
        """Returns the groups of both fields under their names; trust is not trained, but found afterwards."""
        groups, labels = super().param_groups(config, params)
        trust = None if params is None else jax.tree.map(lambda _: "trust", params.trust)
        return groups | {"trust": Group(0.0)}, None if params is None else replaced(labels, trust=trust)

    def inspect(self, params: HybridParams, plan: HybridPlan | None = None, links: Query | Links | None = None) -> Inspection:
        """Returns what is in both fields, the Gaussians informed of the coherent one."""
        found = super().inspect(params)
        if plan is None or links is None:
            return found
        given = None if self.wave is None else self.wave.render(params.wave, plan.wave, links).pas
        return found._replace(gaussians=gaussian_state(params.wideband, plan.wideband, links.query, given))


def _coherent(config: WaveConfig, scene: Scene, seed: int) -> WaveField | None:
    """Returns the coherent field of a scene; None, and a warning, where there is no mesh that it could use."""
    try:
        return WaveField.build(config, scene, seed)
    except UserError as why:
        reason = str(why).split(";")[0]  # what to do about it is for those who asked for a coherent field
        warnings.warn(f"the hybrid field is its wideband half alone: {reason}", stacklevel=1)  # of this line: it is said once
        return None


def _informed(batch: Batch) -> Bool[Array, "b 1 1"]:
    """Returns for which links the splatting field is to see what the coherent one says: half of them, drawn anew in each step,
    and the same ones however many devices divide the batch."""

    def drawn(tx: Any, frequency_hz: Any) -> Any:
        key = jax.random.fold_in(batch.key, tx)
        return jax.random.bernoulli(jax.random.fold_in(key, jax.lax.bitcast_convert_type(frequency_hz, jnp.uint32)))

    return jax.vmap(drawn)(batch.links.tx_index, batch.links.query.frequency_hz)[:, None, None]
