"""The hybrid field: the coherent field and the paper's splatting field side by side, and how far each is to be trusted.

    PAS = w PAS of the waves + (1 - w) PAS of the Gaussians

The coherent field is right to the phase where mesh and physics are, and can be far off where they are not; the splatting field
needs neither and blurs. Its networks see what the coherent field says, and so learn where that is wrong: behind furniture that
the mesh lacks, say. Both are trained on the same batches; the share w, query by query, is what explains validation transmitters
best (trust.py).
Without a mesh it is the splatting field by itself.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import from_leaves, pytree, static, with_leaves
from wbgs_jax.config import Settings
from wbgs_jax.fields.base import Aux, Electrical, Field, Group, Observation, Quantity, Splatted, register
from wbgs_jax.fields.losses import ssim
from wbgs_jax.fields.prepared_paths import PreparedPaths
from wbgs_jax.fields.trust import SHARES, Scored, Share, constant, features, learn_share, share_of
from wbgs_jax.fields.wave import WaveConfig, WaveField
from wbgs_jax.fields.wideband import WidebandConfig, WidebandField, WidebandParams, WidebandPlan
from wbgs_jax.radio.channel import NOT_HEARD_DB, Arrivals
from wbgs_jax.types import Batch, Links, Query, Receiver, Scene


@dataclass(frozen=True)
class HybridConfig:
    """Settings of the two fields."""

    wave: WaveConfig = field(default_factory=WaveConfig)
    wideband: WidebandConfig = field(default_factory=WidebandConfig)


@pytree
class Trust:
    """The coherent field's shares."""

    spectra: Share
    power: Share
    """Of the received power in decibels."""


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
    gives: ClassVar = WaveField.gives
    controls: ClassVar = ("wideband.density", "wave.search")
    seconds: ClassVar = {"cpu": 700.0, "smoke": 60.0}

    @classmethod
    def check(cls, config: HybridConfig) -> None:
        """Raises a `UserError` for settings that cannot work."""
        WaveField.check(config.wave)
        WidebandField.check(config.wideband)
        if not config.wave.coherent:
            raise UserError("--wave.no-coherent leaves nothing to mix; train --field wideband")

    @classmethod
    def make(cls, config: HybridConfig, scene: Scene, seed: int) -> "HybridField":
        """Returns the field of a scene."""
        cls.check(config)
        return cls(_coherent(config.wave, scene, seed), WidebandField.make(config.wideband, scene, seed), config)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any], config: HybridConfig) -> "HybridField":
        """Returns a field from its flattened arrays and its settings."""
        has_wave = any(key.startswith(".wave.") for key in arrays)
        wave = from_leaves(WaveField, arrays, {"config": config.wave}, ".wave") if has_wave else None
        return cls(wave, from_leaves(WidebandField, arrays, {"config": config.wideband}, ".wideband"), config)

    def known(self) -> tuple[Quantity, ...]:
        """Returns what it knows of a link: without a coherent field no snapshots and no paths."""
        return self.wideband.gives if self.wave is None else self.gives

    def init(self, key: Key[Array, ""]) -> HybridParams:
        """Returns initial parameters, both fields trusted alike."""
        wave = None if self.wave is None else self.wave.init(key)
        wideband = self.wideband.init(key, given=wave is not None)
        return HybridParams(wave, wideband, Trust(constant(0.5), constant(0.5)))

    def prepare(self, links: Links, receivers: Receiver) -> PreparedPaths | None:
        """Returns the paths of all transmitters of some links (host)."""
        return None if self.wave is None else self.wave.prepare(links, receivers)

    def plan(
        self, params: HybridParams, receiver: Receiver, limits: Any = None, cache: PreparedPaths | None = None
    ) -> HybridPlan:
        """Returns a receiver's mirror images (host, unless they are prepared) and the projected Gaussians."""
        wave = None if self.wave is None else self.wave.plan(params.wave, receiver, None, cache)
        return HybridPlan(wave, self.wideband.plan(params.wideband, receiver, limits))

    def render(self, params: HybridParams, plan: HybridPlan, query: Query) -> Observation:
        """Returns spectra and received power of B queries, and the coherent field's snapshots."""
        coherent = None if self.wave is None else self.wave.render(params.wave, plan.wave, query)
        return self._mixed(params, plan, query, coherent)

    def render_links(self, params: HybridParams, plan: HybridPlan, cache: PreparedPaths | None, links: Links) -> Observation:
        """Returns the same of links whose transmitters' paths are prepared."""
        coherent = None if self.wave is None else self.wave.render_links(params.wave, plan.wave, cache, links)
        return self._mixed(params, plan, links.query, coherent)

    def _mixed(self, params: HybridParams, plan: HybridPlan, query: Query, coherent: Observation | None) -> Observation:
        if coherent is None:
            return self.wideband.render(params.wideband, plan.wideband, query)
        blurred = self.wideband.render(params.wideband, plan.wideband, query, coherent.pas)
        told = features(query, plan.wave.receiver.position, coherent, blurred)
        spectra, power = (share_of(share, told) for share in (params.trust.spectra, params.trust.power))
        pas = spectra[:, None, None] * coherent.pas + (1 - spectra)[:, None, None] * blurred.pas
        assert coherent.power_db is not None and blurred.power_db is not None, "both fields know powers"
        return Observation(pas, coherent.snapshots, power * coherent.power_db + (1 - power) * blurred.power_db)

    def probe(self, params: HybridParams) -> Any:
        """Returns that of the splatting field."""
        return self.wideband.probe(params.wideband)

    def loss(
        self, params: HybridParams, cache: PreparedPaths | None, batch: Batch, limits: Any = None, probe: Any = ()
    ) -> tuple[Float[Array, ""], Aux]:
        """Returns the sum of both losses. What the splatting field makes of the coherent one is no reason to change that."""
        if self.wave is None:
            return self.wideband.loss(params.wideband, None, batch, limits, probe)
        seen = self.wave.render_links(params.wave, self.wave.plan(params.wave, batch.receiver, None, cache), cache, batch.links)
        coherent, other = self.wave.compared(params.wave, seen, batch)
        given = jax.lax.stop_gradient(seen.pas)
        loss, aux = self.wideband.loss(params.wideband, None, batch, limits, probe, given)
        figures = {f"{name}_wave": value for name, value in other.metrics.items()} | aux.metrics
        return loss + coherent, aux._replace(metrics=figures)

    def calibrate(self, params: HybridParams, cache: Any, batches: Sequence[Batch]) -> tuple[HybridParams, dict[str, Any]]:
        """Returns the parameters with the shares of the coherent field that explain best what neither field was trained on."""
        if self.wave is None or not batches:
            return params, {}
        receivers = {_receiver_of(batch): batch.receiver for batch in batches}
        plans = {number: self.plan(params, receiver, None, cache) for number, receiver in receivers.items()}
        seen = [jax.tree.map(np.asarray, _scores(self, params, plans[_receiver_of(batch)], cache, batch)) for batch in batches]
        told, *scores = (None if part[0] is None else np.concatenate(part) for part in zip(*seen, strict=True))
        assert told is not None
        tx_index = np.concatenate([np.asarray(batch.links.tx_index) for batch in batches])
        shares = [constant(1.0) if s is None else learn_share(Scored(told, s, tx_index)) for s in scores]
        report = {
            name: {"mean": round(float(share_of(share, jnp.asarray(told)).mean()), 3), "by_query": bool(np.any(share.weights))}
            for name, share in zip(("spectra", "power"), shares, strict=True)
        }
        return dataclasses.replace(params, trust=Trust(*shares)), {"coherent_share": report}

    def arrivals(self, params: HybridParams, plan: HybridPlan, query: Query) -> Arrivals:
        """Returns every path of B queries: amplitudes, directions, lengths."""
        if self.wave is None:
            raise UserError("this run knows no paths: its data had no mesh")
        return self.wave.arrivals(params.wave, plan.wave, query)

    def limits(self, params: HybridParams, receivers: Receiver) -> Any:
        """Returns those of the splatting field."""
        return self.wideband.limits(params.wideband, receivers)

    def grow(self, limits: Any, required: Int[np.ndarray, " k"]) -> Any:
        """Returns larger limits of the splatting field."""
        return self.wideband.grow(limits, required)

    def splatted(self, params: HybridParams, plan: HybridPlan, query: Query) -> Splatted:
        """Returns the Gaussians of the splatting field with their attenuation and signal."""
        given = None if self.wave is None else self.wave.render(params.wave, plan.wave, query).pas
        return self.wideband.splatted(params.wideband, plan.wideband, query, given)

    def electrical(self, params: HybridParams) -> Electrical | None:
        """Returns the materials of the coherent field."""
        return None if self.wave is None else self.wave.electrical(params.wave)

    def with_material(self, params: HybridParams, material: int, permittivity: float, conductivity: float) -> HybridParams:
        """Returns parameters with another material of the coherent field."""
        wave = self.wave.with_material(params.wave, material, permittivity, conductivity)
        return dataclasses.replace(params, wave=wave)

    def with_thickness(self, plan: HybridPlan, material: int, metres: float) -> tuple["HybridField", HybridPlan]:
        """Returns the field and the plan in which a material of the coherent field is that thick."""
        assert self.wave is not None, "a field without `electrical` has no materials"
        wave, planned = self.wave.with_thickness(plan.wave, material, metres)
        return dataclasses.replace(self, wave=wave), dataclasses.replace(plan, wave=planned)

    def portable(self, plan: HybridPlan) -> HybridPlan:
        """Returns the plan without what is cheaply computed again."""
        return dataclasses.replace(plan, wideband=self.wideband.portable(plan.wideband))

    def blurred(self, params: HybridParams, metres: Float[Array, ""] | float) -> HybridParams:
        """Returns parameters whose coherent part is a mean over transmitters nearby; the splatting one has no fringes."""
        if self.wave is None:
            return params
        return dataclasses.replace(params, wave=self.wave.blurred(params.wave, metres))

    def anywhere(self, params: HybridParams) -> tuple[Field, Any]:
        """Returns the coherent field: what the splatting one has learned is what its receiver sees."""
        return super().anywhere(params) if self.wave is None else self.wave.anywhere(params.wave)

    def displaced_surfaces(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns those of the coherent field."""
        return None if self.wave is None else self.wave.displaced_surfaces()

    def sizes(self, params: HybridParams) -> dict[str, int]:
        """Returns the sizes of both fields."""
        coherent = {} if self.wave is None else self.wave.sizes(params.wave)
        return self.wideband.sizes(params.wideband) | coherent

    @classmethod
    def groups(cls, config: HybridConfig) -> dict[str, Group]:
        """Returns the groups of both fields under their names; trust is not trained, but found afterwards."""
        parts = {"wave": WaveField.groups(config.wave), "wideband": WidebandField.groups(config.wideband)}
        named = {f"{part}.{name}": group for part, groups in parts.items() for name, group in groups.items()}
        return named | {"trust": Group(0.0)}

    @classmethod
    def labels(cls, params: HybridParams) -> Any:
        """Returns the group of every parameter."""
        coherent = [] if params.wave is None else jax.tree.leaves(WaveField.labels(params.wave))
        blurred = jax.tree.leaves(WidebandField.labels(params.wideband))
        names = [f"wave.{name}" for name in coherent] + [f"wideband.{name}" for name in blurred]
        return with_leaves(params, *names, *["trust"] * len(jax.tree.leaves(params.trust)))


def _coherent(config: WaveConfig, scene: Scene, seed: int) -> WaveField | None:
    """Returns the coherent field of a scene; None where there is no mesh that it could use."""
    try:
        return WaveField.make(config, scene, seed)
    except UserError:
        return None


def _receiver_of(batch: Batch) -> int:
    return int(batch.links.receiver_index[0])


@jax.jit
def _scores(
    hybrid: HybridField, params: HybridParams, plan: HybridPlan, cache: Any, batch: Batch
) -> tuple[Float[Array, "b features"], Float[Array, "b shares"] | None, Float[Array, "b shares"] | None]:
    """Returns the features of every link, and what every share of the coherent field is worth on it: SSIM, and the negative
    error of the power (dB)."""
    coherent: Any = hybrid.wave.render_links(params.wave, plan.wave, cache, batch.links)
    blurred: Any = hybrid.wideband.render(params.wideband, plan.wideband, batch.links.query, coherent.pas)
    told = features(batch.links.query, batch.receiver.position, coherent, blurred)
    shares, spectra, power = jnp.asarray(SHARES, jnp.float32), None, None
    if batch.pas is not None:
        spectra = jax.lax.map(lambda w: ssim(w * coherent.pas + (1 - w) * blurred.pas, batch.pas), shares).T
    if batch.received_db is not None:
        said = shares * coherent.power_db[:, None] + (1 - shares) * blurred.power_db[:, None]
        heard = (batch.received_db > NOT_HEARD_DB)[:, None]
        power = jnp.where(heard, -jnp.abs(said - batch.received_db[:, None]), 0)
    return told, spectra, power
