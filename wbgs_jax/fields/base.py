"""The interface between models and everything else.

A field is a small frozen object: its settings and what never changes (where Gaussians start, the frame of its inputs, the
facets of a mesh). What is trained lives in `params`, a pytree of floats. All methods but those that say "host" are pure and
jittable; a field is itself a pytree, so it passes through `jax.jit` as an argument. Training, evaluation, predictors, export
and experiments ask a field nothing else.
"""

import contextlib
import dataclasses
import functools
import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Generic, Literal, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int, Key

from wbgs_jax._util.devices import over_all_links
from wbgs_jax._util.errors import UserError
from wbgs_jax._util.pytree import from_leaves, replaced
from wbgs_jax.config import PRESETS, Settings
from wbgs_jax.fields.losses import LOSSES, image_loss
from wbgs_jax.observation_kinds import only_kind
from wbgs_jax.radio.channel import NOT_HEARD_DB, Arrivals
from wbgs_jax.types import Batch, Gaussians, Links, Query, Receiver, Scene

T = TypeVar("T")
Params = Any
"""What is trained of a field: a pytree of floats whose structure is the field's own business."""
Output = Literal["pas", "snapshots", "power", "paths"]
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
    paths: Arrivals | None = None
    """Every path with its amplitude, delay and direction, leading axis B, of a field that knows paths. They take half as much
    memory as the spectra: whoever compiles a call and wants none replaces them by None inside."""


class GaussianState(NamedTuple):
    """The Gaussians of a field that splats, and what its networks make of them for B queries."""

    gaussians: Gaussians
    attenuation: Float[Array, "n b"]
    """delta of the paper (section 4.5), 0..1."""
    signal: Float[Array, "n b"]
    """Sig of the paper (equation 3)."""


class MaterialProperties(NamedTuple):
    """What a field knows of M materials (ITU-R P.2040): relative permittivity, conductivity c f^d with f in GHz, thickness."""

    permittivity: Float[np.ndarray, " m"]
    conductivity: Float[np.ndarray, " m"]
    """c, S/m."""
    slope: Float[np.ndarray, " m"]
    """d."""
    thickness: Float[np.ndarray, " m"]
    """Metres."""


class Inspection(NamedTuple):
    """What is in a trained field, for reports and pictures; None where it has nothing of the kind."""

    sizes: dict[str, int]
    """Numbers that tell how large it is."""
    materials: MaterialProperties | None = None
    """As far as they were learned."""
    displaced_surfaces: tuple[Float[np.ndarray, "f k 3"], Float[np.ndarray, "f 3"]] | None = None
    """Corners of its surfaces and by how much each was moved, metres, where a training has moved any."""
    gaussians: GaussianState | None = None
    """For the links that were asked for."""


class Prepared(Protocol):
    """What `Field.prepare` found out about links: a pytree."""

    def subset(self, links: Links) -> Any:
        """Returns what it holds of B of its links alone, in a shape that depends on B and not on how many others there are."""
        ...


class Capacity(Protocol):
    """Static sizes that planning needs under jit: a frozen dataclass of numbers, kept in checkpoints."""

    def scaled(self, factor: float) -> Any:
        """Returns sizes that hold so many times as much."""
        ...

    def grown_to(self, others: Any) -> Any:
        """Returns sizes that hold what these and others do."""
        ...


class Aux(NamedTuple):
    """What a step reports beside its loss."""

    metrics: dict[str, Float[Array, ""]]
    """Figures for the curves; NaN where a figure means nothing."""
    required: Int[Array, " k"] | None = None
    """What the capacity should have been; None for a field that needs none."""
    overflow: Bool[Array, ""] | None = None
    """The capacity was too small: the step must not be used."""


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
    """A model. Subclasses are decorated with `pytree` and declare `config` as their static field; `build`, `init`, `plan` and
    `render` make a field, and everything else has a default.

    A field that is made of others names them as `components`. Unless it overrides them, `prepare`, `capacity`, `ability` and
    `receiver_independent` are then those of the first component that has any, and `param_groups`, `smoothed` and `inspect` go
    through all of them. `init`, `plan`, `render` and `loss` are its own.
    """

    name: ClassVar[str]
    """What command lines and files call it."""
    presets: ClassVar[Mapping[str, Settings]] = PRESETS
    """Settings by preset; `Settings.field` has the type of `config`."""
    seconds: ClassVar[Mapping[str, float]] = {}
    """How long trainings take on two cores of an AMD EPYC, by preset, search and compilation included (scenes 1 to 6)."""
    outputs: ClassVar[tuple[Output, ...]] = ("pas",)
    """What it knows of a link; `outputs_of` says what a field of this class knows whose scene lacks a component."""
    hooks: ClassVar[tuple[str, ...]] = ()
    """Hooks between epochs that it asks for: names in `training.loop.HOOKS`, "component.name" for one of a component alone."""
    components: ClassVar[Mapping[str, type["Field"]]] = {}
    """Of a field that is made of others: their classes by name. Field, settings, parameters and plans then have an attribute of
    that name for each; that of field, parameters and plans is None where the scene does not allow the component."""
    config: Any
    """Its settings: a frozen dataclass, which may have a method `check(name)` (`Checked`)."""

    @classmethod
    @abstractmethod
    def build(cls, config: Any, scene: Scene, seed: int) -> "Field":
        """Returns the field of a scene (host)."""

    @abstractmethod
    def init(self, key: Key[Array, ""]) -> Params:
        """Returns initial parameters: only what is trained, all floats."""

    @abstractmethod
    def plan(self, params: Params, receiver: Receiver, prepared: Any = None, capacity: Any = None) -> Any:
        """Returns what is independent of the query.

        A plan that is made outside of a differentiated function is a constant to its gradient: parameters that it holds get
        none, or a part. `pas` plans inside. Under jit a field with a `capacity` needs it, and one that plans on the host what
        is `prepared` of its links: the plan carries it.
        """

    @abstractmethod
    def render(self, params: Params, plan: Any, links: Query | Links) -> Observation:
        """Returns what the receiver of a plan observes on B links.

        Both kinds have `tx_position` (b, 3) and `frequency_hz` (b,). A plan with something prepared is asked about `Links`.
        """

    def prepare(self, links: Links, receivers: Receiver) -> Any:
        """Returns what can be known of links before training (host), a `Prepared`; None: nothing. `receivers` has a leading
        axis."""
        found = (component.prepare(links, receivers) for component in components_of(self).values())
        return next((prepared for prepared in found if prepared is not None), None)

    def loss(
        self, params: Params, prepared: Any, batch: Batch, capacity: Any = None, probe: Any = None
    ) -> tuple[Float[Array, ""], Aux]:
        """Returns the loss of a batch. By default it compares spectra, and power where the data have nothing else.

        `probe` is zeros to be added where a hook wants to know the gradient (`training.hooks.Hook.probe`); None: nowhere.
        """
        return compare(self.render(params, self.plan(params, batch.receiver, prepared, capacity), batch.links), batch)

    def capacity(self, params: Params, receivers: Receiver, required: Int[np.ndarray, " k"] | None = None) -> Any:
        """Returns the static sizes that planning needs under jit, with room to grow (host): a `Capacity`, or None.

        Args:
            params: parameters.
            receivers: all of them, with a leading axis.
            required: what a step required that overflowed (`Aux.required`), if one did: the sizes are then to hold that.
        """
        parts = components_of(self).items()
        found = (component.capacity(getattr(params, name), receivers, required) for name, component in parts)
        return next((capacity for capacity in found if capacity is not None), None)

    @classmethod
    def param_groups(cls, config: Any, params: Params | None = None) -> tuple[dict[str, Group], Any]:
        """Returns the optimiser's groups by name, and the group of every parameter: a tree of names like the parameters, or a
        prefix of one; None without parameters. Groups of components are called "component.group"."""
        if not cls.components:
            return {"all": Group(1e-2)}, None if params is None else jax.tree.map(lambda _: "all", params)
        groups, labels = dict[str, Group](), {}
        for name, component in cls.components.items():
            own, names = component.param_groups(getattr(config, name), None if params is None else getattr(params, name))
            groups |= {f"{name}.{group}": value for group, value in own.items()}
            labels[name] = jax.tree.map(lambda group, name=name: f"{name}.{group}", names)
        return groups, None if params is None else replaced(params, **labels)

    def ability(self, kind: type[T]) -> "Ability[T] | None":
        """Returns what else can be done with it: itself, or the component that is of a kind (a class or a protocol that can be
        checked at run time, such as `calibratable.Calibratable`); None if nothing is."""
        if isinstance(self, kind):
            return Ability(self)
        found = ((name, component.ability(kind)) for name, component in components_of(self).items())
        return next((Ability(one.field, (name, *one.path)) for name, one in found if one is not None), None)

    def receiver_independent(self, params: Params) -> tuple["Field", Params]:
        """Returns the part of a trained field that holds for receivers that it was not trained for, and its parameters.

        Raises:
            UserError: there is none.
        """
        for name, component in components_of(self).items():
            with contextlib.suppress(UserError):
                return component.receiver_independent(getattr(params, name))
        raise UserError(
            f"the {self.name} field knows no receivers but those that it was trained for; "
            "train --field wave or hybrid, on data with a mesh"
        )

    def smoothed(self, params: Params, metres: Float[Array, ""] | float) -> Params:
        """Returns parameters whose spectra and powers are means over transmitters that stand about so many metres (standard
        deviation along each axis) from where they are asked for: without the fringes of interference that change over less.
        By default, of a field that has none, the parameters as they are."""
        parts = {name: component.smoothed(getattr(params, name), metres) for name, component in components_of(self).items()}
        return dataclasses.replace(params, **parts) if parts else params

    def inspect(self, params: Params, plan: Any = None, links: Query | Links | None = None) -> Inspection:
        """Returns what is in it (host); Gaussians for B links, where these and a plan are given."""
        parts = components_of(self).items()
        if not parts:
            return Inspection({"parameters": sum(int(np.size(leaf)) for leaf in jax.tree.leaves(params))})
        of_plan = {name: None if plan is None else getattr(plan, name) for name, _ in parts}
        found = [component.inspect(getattr(params, name), of_plan[name], links) for name, component in parts]
        sizes, *others = zip(*found, strict=True)
        first = (next((one for one in column if one is not None), None) for column in others)
        return Inspection(dict(itertools.chain.from_iterable(own.items() for own in sizes)), *first)


@dataclasses.dataclass(frozen=True)
class Ability(Generic[T]):
    """The part of a field that can do something, and where parameters and plans hold what belongs to it."""

    field: T
    """The field itself, or a component."""
    path: tuple[str, ...] = ()
    """Names of the components that lead to it."""

    def of(self, tree: Any) -> Any:
        """Returns its own part of the parameters, a plan, or the field."""
        return functools.reduce(getattr, self.path, tree)

    def put(self, tree: Any, own: Any) -> Any:
        """Returns the tree with its part replaced."""
        if not self.path:
            return own
        name, *rest = self.path
        return replaced(tree, **{name: Ability(self.field, tuple(rest)).put(getattr(tree, name), own)})


@runtime_checkable
class Checked(Protocol):
    """Settings that can tell whether they work."""

    def check(self, name: str) -> None:
        """Raises a `UserError` for settings that cannot; `name` is that of the field, for the option that is named."""
        ...


def check_config(name: str, config: Any) -> None:
    """Raises a `UserError` for settings of a field, by its name, that cannot work: before there is a scene."""
    if isinstance(config, Checked):
        config.check(name)


@runtime_checkable
class Noisy(Protocol):
    """A field that knows what noise has added to the spectra that it was trained on, and leaves it out of its answers."""

    def as_observed(self, params: Params, pas: Float[Array, "b 90 360"]) -> Float[Array, "b 90 360"]:
        """Returns its answers as they would appear in those data."""
        ...


def as_observed(field: Field, params: Params, pas: Float[Array, "b 90 360"]) -> Float[Array, "b 90 360"]:
    """Returns the answers of a field as they would appear in the data that it was trained on: as they are, unless it is
    `Noisy`."""
    noisy = field.ability(Noisy)
    return pas if noisy is None else noisy.field.as_observed(noisy.of(params), pas)


@runtime_checkable
class Portable(Protocol):
    """A plan, or a part of one, of which files hold less."""

    def portable(self) -> Any:
        """Returns it without what is cheaply computed again from the parameters."""
        ...


def portable(plan: Any) -> Any:
    """Returns a plan without what is cheaply computed again from the parameters: what a file holds of it."""

    def small(part: Any) -> Any:
        return part.portable() if isinstance(part, Portable) else part

    return jax.tree.map(small, plan, is_leaf=lambda part: isinstance(part, Portable))


def field_from_arrays(cls: type[Field], arrays: Mapping[str, Any], config: Any) -> Field:
    """Returns a field from its flattened arrays, `{".frame.centre": array, ...}`, and its settings. A field that is made of
    components has nothing else."""
    if not cls.components:
        return from_leaves(cls, arrays, {"config": config})
    parts = dict[str, Field | None]()
    for name, component in cls.components.items():
        own = {key.removeprefix(f".{name}"): leaf for key, leaf in arrays.items() if key.startswith(f".{name}.")}
        parts[name] = field_from_arrays(component, own, getattr(config, name)) if own else None
    return cls(**parts, config=config)  # type: ignore[call-arg]


@jax.jit
def paths_of(field: Field, params: Params, plan: Any, links: Query | Links) -> Arrivals:
    """Returns every path of B links, leading axis B, of a field whose `outputs` name "paths".

    Raises:
        UserError: it knows none.
    """
    paths = field.render(params, plan, links).paths
    if paths is None:
        raise UserError(f"the {field.name} field of this run knows no paths; train the default one on data with a mesh")
    return paths


def components_of(field: Field) -> dict[str, Field]:
    """Returns the components that a field of a scene has, by name."""
    found = {name: getattr(field, name) for name in field.components}
    return {name: component for name, component in found.items() if component is not None}


def outputs_of(field: Field) -> tuple[Output, ...]:
    """Returns what a field knows of a link: the `outputs` of its class, of which a missing component may leave fewer."""
    found = components_of(field)
    if len(found) == len(field.components):
        return field.outputs
    known = {output for component in found.values() for output in outputs_of(component)}
    return tuple(output for output in field.outputs if output in known)


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


def pas(field: Field, params: Params, receiver: Receiver, query: Query, capacity: Any = None) -> Float[Array, "b 90 360"]:
    """Returns the power angular spectra of B queries: the differentiable function from parameters, receiver and query.

    Nothing is frozen: the plan is made inside. Under `jit` or `grad` a field with a capacity needs it given
    (`field.capacity(params, receiver)`, on the host); too small a one gives NaN, never a wrong spectrum. Reverse mode only.

    The wave field finds mirror images on the host: neither it nor the receiver's position can be traced, and spectra have no
    gradient with respect to that position.
    """
    return field.render(params, field.plan(params, receiver, None, capacity), query).pas


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
