"""The seam between models and everything else.

A field is a small frozen object: its settings and what never changes (where Gaussians start, the frame of its inputs, the
facets of a mesh). What is trained lives in `params`, a pytree of floats. All methods but those that say "host" are pure and
jittable; a field is itself a pytree, so it passes through `jax.jit` as an argument. Training, evaluation, predictors, export
and experiments ask a field nothing else.
"""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int, Key

from wbgs_jax._util.devices import over_all_links
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import from_leaves
from wbgs_jax.config import PRESETS, Settings
from wbgs_jax.fields.losses import LOSSES, image_loss
from wbgs_jax.observation_kinds import only_kind
from wbgs_jax.radio.channel import NOT_HEARD_DB, Arrivals
from wbgs_jax.types import Batch, Gaussians, Links, Query, Receiver, Scene

Quantity = Literal["pas", "snapshots", "power", "paths"]
"""What a field may know of a link."""


class Observation(NamedTuple):
    """What a field says of B links of one receiver."""

    pas: Float[Array, "b 90 360"]
    """Normalised power angular spectra."""
    snapshots: Complex[Array, "b elements"] | None = None
    """Complex array snapshots, of a field that knows phases."""
    power_db: Float[Array, " b"] | None = None
    """Received power relative to the transmitted power (dB), of a field that knows it."""
    covariance: Complex[Array, "b elements elements"] | None = None
    """Mean product y y^H of the snapshots, scaled to a trace of 1, of a field that knows how far to trust its phases."""


class Splatted(NamedTuple):
    """The Gaussians of a field that splats, and what its networks make of them for B queries."""

    gaussians: Gaussians
    attenuation: Float[Array, "n b"]
    """delta of the paper (section 4.5), 0..1."""
    signal: Float[Array, "n b"]
    """Sig of the paper (equation 3)."""


class Electrical(NamedTuple):
    """What a field knows of M materials (ITU-R P.2040): relative permittivity, conductivity c f^d with f in GHz, thickness."""

    permittivity: Float[np.ndarray, " m"]
    conductivity: Float[np.ndarray, " m"]
    """c, S/m."""
    slope: Float[np.ndarray, " m"]
    """d."""
    thickness: Float[np.ndarray, " m"]
    """Metres."""


class Aux(NamedTuple):
    """What a step reports beside its loss."""

    metrics: dict[str, Float[Array, ""]]
    """Figures for the curves; NaN where a figure means nothing."""
    required: Int[Array, " k"] | None = None
    """What the limits should have been; None for a field without limits."""
    overflow: Bool[Array, ""] | None = None
    """The limits were too small: the step must not be used."""


Optimizer = Literal["adam", "muon"]


class Group(NamedTuple):
    """How a group of parameters is optimised."""

    learning_rate: float
    optimizer: Optimizer = "adam"
    """"muon": matrices by Muon, whose steps have Adam's size, and everything else by Adam."""
    weight_decay: float = 0.0
    """Decoupled weight decay."""
    eps: float = 1e-15
    """Adam's epsilon."""


class Field(ABC):
    """A model. Subclasses are decorated with `pytree` and declare `config` as their static field."""

    name: ClassVar[str]
    """What command lines and files call it."""
    presets: ClassVar[Mapping[str, Settings]] = PRESETS
    """Settings by preset; `Settings.field` has the type of `config`."""
    gives: ClassVar[tuple[Quantity, ...]] = ("pas",)
    """What it knows of a link."""
    controls: ClassVar[tuple[str, ...]] = ()
    """Host controls between epochs that it asks for: names in `training.loop.CONTROLS`, "part.name" for one of a part alone."""
    seconds: ClassVar[Mapping[str, float]] = {}
    """How long trainings take on two cores of an AMD EPYC, by preset, search and compilation included (scenes 1 to 6)."""
    config: Any

    @classmethod
    def check(cls, config: Any) -> None:
        """Raises a `UserError` for settings that cannot work."""
        return

    @classmethod
    def make(cls, config: Any, scene: Scene, seed: int) -> "Field":
        """Returns the field of a scene (host)."""
        return cls(config)  # type: ignore[call-arg]

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any], config: Any) -> "Field":
        """Returns a field from its flattened arrays, `{".frame.centre": array, ...}`, and its settings."""
        return from_leaves(cls, arrays, {"config": config})

    @abstractmethod
    def init(self, key: Key[Array, ""]) -> Any:
        """Returns initial parameters: only what is trained, all floats."""

    @abstractmethod
    def plan(self, params: Any, receiver: Receiver, limits: Any = None, cache: Any = None) -> Any:
        """Returns what is independent of the query.

        A plan that is made outside of a differentiated function is a constant to its gradient: parameters that it holds get
        none, or a part. `pas` plans inside. Under jit a field with `limits` needs them, and one that plans on the host the
        `cache` of its links.
        """

    @abstractmethod
    def render(self, params: Any, plan: Any, query: Query) -> Observation:
        """Returns what the receiver of a plan observes for B queries."""

    def prepare(self, links: Links, receivers: Receiver) -> Any:
        """Returns what can be known of links before training (host); `receivers` has a leading axis."""
        return None

    def cache_of(self, cache: Any, links: Links) -> Any:
        """Returns what `prepare` found for B of its links alone, in a shape that depends on B and not on how many others
        there are."""
        return cache

    def render_links(self, params: Any, plan: Any, cache: Any, links: Links) -> Observation:
        """Returns what `render` does, for links that `prepare` has seen."""
        return self.render(params, plan, links.query)

    def probe(self, params: Any) -> Any:
        """Returns zeros that `loss` adds where a host control wants to know the gradient; nothing by default."""
        return ()

    def loss(self, params: Any, cache: Any, batch: Batch, limits: Any = None, probe: Any = ()) -> tuple[Float[Array, ""], Aux]:
        """Returns the loss of a batch. By default it compares spectra, and power where the data have nothing else."""
        plan = self.plan(params, batch.receiver, limits, cache)
        seen = self.render_links(params, plan, cache, batch.links)
        return compare(seen, batch)

    def limits(self, params: Any, receivers: Receiver) -> Any:
        """Returns the static sizes that planning needs under jit, with room to grow (host): a frozen dataclass of numbers, kept
        in checkpoints, with a method `scaled(factor)` if host controls add to the field; None if it needs none."""
        return None

    def grow(self, limits: Any, required: Int[np.ndarray, " k"]) -> Any:
        """Returns limits that hold what an overflowed step required (host)."""
        raise NotImplementedError("a field without limits does not overflow")

    def arrivals(self, params: Any, plan: Any, query: Query) -> Arrivals:
        """Returns what arrives over every path, of a field whose `gives` names "paths"."""
        raise NotImplementedError(f"the {self.name} field knows no paths")

    def splatted(self, params: Any, plan: Any, query: Query) -> Splatted | None:
        """Returns its Gaussians with their attenuation and signal for B queries; None of a field that has none."""
        return None

    def electrical(self, params: Any) -> Electrical | None:
        """Returns the properties of the scene's materials (host); None of a field that knows of none."""
        return None

    def with_material(self, params: Any, material: int, permittivity: float, conductivity: float) -> Any:
        """Returns parameters in which one material has another relative permittivity and conductivity at 1 GHz, S/m (host)."""
        raise NotImplementedError("a field without `electrical` has no materials")

    def with_thickness(self, plan: Any, material: int, metres: float) -> tuple["Field", Any]:
        """Returns the field and a plan in which all walls of one material are this thick, whatever data say (host)."""
        raise NotImplementedError("a field without `electrical` has no materials")

    def blurred(self, params: Any, metres: Float[Array, ""] | float) -> Any:
        """Returns parameters whose spectra and powers are means over transmitters that stand about so many metres (standard
        deviation along each axis) from where they are asked for: without the fringes of interference that change over less.
        By default, of a field that has none, the parameters as they are."""
        return params

    def portable(self, plan: Any) -> Any:
        """Returns the plan without what is cheaply computed again from the parameters: what a file holds of it."""
        return plan

    def calibrate(self, params: Any, cache: Any, batches: Sequence[Batch]) -> tuple[Any, dict[str, Any]]:
        """Returns parameters with what only links outside the training part can say, and figures for the curves (host, after
        the last step). By default nothing changes."""
        return params, {}

    def as_observed(self, params: Any, pas: Float[Array, "b 90 360"]) -> Float[Array, "b 90 360"]:
        """Returns its answers as they would appear in the data that it was trained on; by default as they are."""
        return pas

    def known(self) -> tuple[Quantity, ...]:
        """Returns what it knows of a link: what its class `gives`, unless the scene lacks what that takes."""
        return self.gives

    def anywhere(self, params: Any) -> tuple["Field", Any]:
        """Returns the part of a trained field that holds for receivers that it was not trained for, and its parameters.

        Raises:
            UserError: there is none.
        """
        raise UserError(
            f"the {self.name} field knows no receivers but those that it was trained for; "
            "train --field wave or hybrid, on data with a mesh"
        )

    def displaced_surfaces(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns the corners (f, k, 3) of the surfaces that it knows and by how much each was moved (f, 3), metres, where a
        training has moved any (host); None otherwise."""
        return None

    def sizes(self, params: Any) -> dict[str, int]:
        """Returns the numbers that tell how large a trained field is, for reports (host)."""
        return {"parameters": sum(int(np.size(leaf)) for leaf in jax.tree.leaves(params))}

    @classmethod
    def groups(cls, config: Any) -> dict[str, Group]:
        """Returns the optimiser's groups by name."""
        return {"all": Group(1e-2)}

    @classmethod
    def labels(cls, params: Any) -> Any:
        """Returns the group of every parameter: a tree of names, or a prefix of one."""
        return jax.tree.map(lambda _: "all", params)


def heard_alone(batch: Batch, seen: Observation) -> Batch:
    """Returns a batch whose black spectra are what was predicted."""
    if batch.pas is None:
        return batch
    black = jnp.max(batch.pas, (1, 2), keepdims=True) == 0
    spectra = jnp.where(black, jax.lax.stop_gradient(seen.pas), batch.pas)
    return batch.with_observations(**batch.observations | {"pas": spectra})


def compare(seen: Observation, batch: Batch, ssim_weight: float = 0.2, ssim_stride: int = 1) -> tuple[Float[Array, ""], Aux]:
    """Returns the image loss (paper, equation 5) of observed spectra, or the loss of a kind that has none (`LOSSES`).

    It is that of received power where the kind has no other, or the field says nothing else.
    """
    if batch.pas is not None:
        loss, similarity = image_loss(seen.pas, batch.pas, ssim_weight, ssim_stride)
        return loss, Aux({"batch_ssim": similarity})
    kind = only_kind(batch.observations, "the batch")
    error = LOSSES[kind.name](seen, batch.observations[kind.name]) if kind.name in LOSSES else None
    if error is None:  # the power that follows from what was observed
        error = LOSSES["power_db"](seen, batch.received_db)
    if error is None:
        raise UserError(f"these data are {kind.words}, of which this field knows nothing; choose another field")
    return error, Aux({})


def power_error_db(seen: Observation, batch: Batch) -> Float[Array, ""] | None:
    """Returns the mean absolute error of received power (dB) over the links that are heard; None where one side does not know
    it."""
    received = batch.received_db
    if seen.power_db is None or received is None:
        return None
    heard = received > NOT_HEARD_DB
    error, count = jnp.sum(jnp.abs(seen.power_db - received) * heard), jnp.sum(heard)
    return over_all_links(error) / jnp.maximum(over_all_links(count), 1)


def pas(field: Field, params: Any, receiver: Receiver, query: Query, limits: Any = None) -> Float[Array, "b 90 360"]:
    """Returns the power angular spectra of B queries: the differentiable function from parameters, receiver and query.

    Nothing is frozen: the plan is made inside. Under `jit` or `grad` a field with limits needs them given
    (`field.limits(params, receiver)`, on the host); too small ones give NaN, never a wrong spectrum. Reverse mode only.

    The wave field finds mirror images on the host: neither it nor the receiver's position can be traced, and spectra have no
    gradient with respect to that position.
    """
    return field.render(params, field.plan(params, receiver, limits), query).pas


_FIELDS: dict[str, type[Field]] = {}


def register(cls: type[Field]) -> type[Field]:
    """Makes a field known to command lines and run folders by its name; usable as a decorator."""
    _FIELDS[cls.name] = cls
    return cls


def field_names() -> list[str]:
    """Returns the names of all registered fields."""
    return list(_FIELDS)


def get_field(name: str) -> type[Field]:
    """Returns the class of a field by its name; an unknown name is a `UserError`."""
    if name not in _FIELDS:
        raise UserError(f"unknown field {name!r}; choose one of: {', '.join(_FIELDS)}")
    return _FIELDS[name]


def default_field() -> str:
    """Returns the name of the field that is trained where none is asked for."""
    return "hybrid"


def with_field(
    presets: Mapping[str, Settings], configs: Mapping[str, Any], **sections: Mapping[str, Any]
) -> dict[str, Settings]:
    """Returns presets with a field's settings in them, and other sections where given, by preset."""
    return {
        name: dataclasses.replace(base, field=configs[name], **{key: values[name] for key, values in sections.items()})
        for name, base in presets.items()
    }
