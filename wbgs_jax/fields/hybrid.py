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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import from_leaves, pytree, static, with_leaves
from wbgs_jax.config import Settings
from wbgs_jax.fields.base import Aux, Electrical, Field, Group, Observation, Quantity, Splatted, register
from wbgs_jax.fields.coherent import WaveConfig, WaveField
from wbgs_jax.fields.coherent_model import PreparedPaths
from wbgs_jax.fields.mixture import (
    Opinions,
    Shares,
    at_first,
    coherent_alone,
    features,
    floor_of,
    learn_shares,
    mixed,
    nearness,
    observed_opinions,
    reported,
    similarity,
    with_floor,
    without_floor,
)
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
        return HybridParams(wave, wideband, Trust(at_first(), at_first(), jnp.zeros(())))

    def prepare(self, links: Links, receivers: Receiver) -> PreparedPaths | None:
        """Returns the paths of all transmitters of some links (host)."""
        return None if self.wave is None else self.wave.prepare(links, receivers)

    def cache_of(self, cache: Any, links: Links) -> PreparedPaths | None:
        """Returns the paths of some links."""
        return None if self.wave is None else self.wave.cache_of(cache, links)

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
        pas, power_db, told = self._said(params, plan, query, coherent)
        spectra, power = mixed(params.trust.spectra, told, pas), mixed(params.trust.power, told, power_db)
        return coherent._replace(pas=spectra, power_db=power, covariance=None)  # which is that of the coherent field alone

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
        given = jnp.where(_informed(batch), jax.lax.stop_gradient(seen.pas), 0)
        loss, aux = self.wideband.loss(params.wideband, None, batch, limits, probe, given)
        figures = {f"{name}_wave": value for name, value in other.metrics.items()} | aux.metrics
        return loss + coherent, aux._replace(metrics=figures)

    def calibrate(self, params: HybridParams, cache: Any, batches: Sequence[Batch]) -> tuple[HybridParams, dict[str, Any]]:
        """Returns the parameters with the shares that explain best what neither field was trained on; of what was not observed,
        spectra or powers, the coherent field's are taken. With them, the floor under noisy spectra is found (mixture.py)."""
        if self.wave is None or not batches:
            return params, {}
        raw = dataclasses.replace(params, trust=dataclasses.replace(params.trust, floor=jnp.zeros(())))
        receivers = {_receiver_of(batch): batch.receiver for batch in batches}
        plans = {number: self.plan(raw, receiver, None, cache) for number, receiver in receivers.items()}
        seen = [jax.tree.map(np.asarray, _opinions(self, raw, plans[_receiver_of(batch)], cache, batch)) for batch in batches]
        said, powers, told, pas, heard_db = jax.tree.map(lambda *parts: np.concatenate(parts), *seen)
        tx_index = np.concatenate([np.asarray(batch.links.tx_index) for batch in batches])
        floor, spectra = 0.0, coherent_alone()
        if pas is not None:
            floor = floor_of(said, pas, tx_index)
            spectra = learn_shares(told, tx_index, observed_opinions(said, floor), partial(similarity, pas))
        known = heard_db is not None and np.any(heard_db > NOT_HEARD_DB)
        power = coherent_alone() if not known else learn_shares(told, tx_index, powers, partial(nearness, heard_db))
        report = {name: reported(shares, told) for name, shares in (("spectra", spectra), ("power", power))}
        trust = Trust(spectra, power, jnp.asarray(floor, jnp.float32))
        return dataclasses.replace(params, trust=trust), {"shares": report, "noise_floor": floor}

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
        """Returns the Gaussians of the splatting field, informed of the coherent one, with their attenuation and signal."""
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
    """Returns the coherent field of a scene; None, and a warning, where there is no mesh that it could use."""
    try:
        return WaveField.make(config, scene, seed)
    except UserError as why:
        reason = str(why).split(";")[0]  # what to do about it is for those who asked for a coherent field
        warnings.warn(f"the hybrid field is its wideband half alone: {reason}", stacklevel=1)  # of this line: it is said once
        return None


def _receiver_of(batch: Batch) -> int:
    return int(batch.links.receiver_index[0])


def _informed(batch: Batch) -> Bool[Array, "b 1 1"]:
    """Returns for which links the splatting field is to see what the coherent one says: half of them, drawn anew in each step,
    and the same ones however many devices divide the batch."""

    def drawn(tx: Any, frequency_hz: Any) -> Any:
        key = jax.random.fold_in(batch.key, tx)
        return jax.random.bernoulli(jax.random.fold_in(key, jax.lax.bitcast_convert_type(frequency_hz, jnp.uint32)))

    return jax.vmap(drawn)(batch.links.tx_index, batch.links.query.frequency_hz)[:, None, None]


class _Seen(NamedTuple):
    """What is said of B links, and what was observed."""

    spectra: Opinions
    power: Opinions
    told: Float[Array, "b features"]
    """What tells whom to trust."""
    pas: Float[Array, "b 90 360"] | None
    power_db: Float[Array, " b"] | None


@jax.jit
def _opinions(hybrid: HybridField, params: HybridParams, plan: HybridPlan, cache: Any, batch: Batch) -> _Seen:
    """Returns what is said of spectra and powers of links, what tells whom to trust, and what was observed."""
    coherent = hybrid.wave.render_links(params.wave, plan.wave, cache, batch.links)
    return _Seen(*hybrid._said(params, plan, batch.links.query, coherent), batch.pas, batch.received_db)
