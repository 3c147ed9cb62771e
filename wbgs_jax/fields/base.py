"""The interface between models and everything else.

A field is a small frozen object: its settings and its constants (initial positions of Gaussians, the frame of its inputs, the
facets of a mesh). All trained values are in `params`, a pytree of floats. Methods are pure and can be compiled by `jax.jit`,
except those marked "(host)"; a field is itself a pytree, so it can be an argument of a compiled function. Training, evaluation,
predictors, export and experiments use a field through this interface only.
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
from wbgs_jax.radio.channel import NO_PATH_DB, Paths
from wbgs_jax.types import Batch, Gaussians, Links, Query, Receiver, Scene, check_query

T = TypeVar("T")
Params = Any
"""Trained parameters: a pytree of floats. Its structure is private to the field."""
Output = Literal["pas", "snapshots", "power", "paths"]
"""A quantity that a field may predict for a link."""


class TrainingTime(NamedTuple):
    """Seconds that a training takes on the reference machine."""

    steps: float
    """All steps of the preset."""
    others: float
    """Preparation, calibration and validation, with programs that have been compiled before."""
    compiling: float
    """Additional seconds if they have not."""


class Observation(NamedTuple):
    """A field's predictions for B links of one receiver."""

    pas: Float[Array, "b 90 360"]
    """Normalised power angular spectra."""
    snapshots: Complex[Array, "b elements"] | None = None
    """Complex array snapshots, if the field predicts phases."""
    power_db: Float[Array, " b"] | None = None
    """Received power relative to the transmitted power (dB), if the field predicts it."""
    covariance: Complex[Array, "b elements elements"] | None = None
    """Mean product y y^H of the snapshots, scaled to a trace of 1, if the field predicts the uncertainty of its phases."""
    paths: Paths | None = None
    """All paths with amplitude, length and direction, leading axis B, if the field predicts paths. They take half as much
    memory as the spectra; a compiled function that does not need them should replace them by None."""


class GaussianState(NamedTuple):
    """The Gaussians of a splatting field, with the outputs of its networks for B queries."""

    gaussians: Gaussians
    attenuation: Float[Array, "n b"]
    """delta of the paper (section 4.5), 0..1."""
    signal: Float[Array, "n b"]
    """Sig of the paper (equation 3)."""


class MaterialProperties(NamedTuple):
    """Properties of M materials (ITU-R P.2040): relative permittivity, conductivity c f^d with f in GHz, thickness."""

    permittivity: Float[np.ndarray, " m"]
    conductivity: Float[np.ndarray, " m"]
    """c, S/m."""
    slope: Float[np.ndarray, " m"]
    """d."""
    thickness: Float[np.ndarray, " m"]
    """Metres."""


class Inspection(NamedTuple):
    """Contents of a trained field, for reports and pictures; None for what the field does not have."""

    sizes: dict[str, int]
    """Counts that describe the field's size, by name."""
    materials: MaterialProperties | None = None
    """Learned properties of the materials."""
    displaced_surfaces: tuple[Float[np.ndarray, "f k 3"], Float[np.ndarray, "f 3"]] | None = None
    """Corners and displacements of its surfaces, metres, if training has displaced any."""
    gaussians: GaussianState | None = None
    """State for the queried links."""


@runtime_checkable
class Prepared(Protocol):
    """The result of `Field.prepare` for some links: a pytree."""

    def subset(self, links: Links) -> Any:
        """Returns the data of B of its links; the shapes depend on B only, not on the number of prepared links."""
        ...


class Capacity(Protocol):
    """Static sizes that planning needs under jit: a frozen dataclass of numbers, stored in checkpoints."""

    def scaled(self, factor: float) -> Any:
        """Returns these sizes multiplied by a factor."""
        ...

    def grown_to(self, others: Any) -> Any:
        """Returns sizes that are sufficient for both these and others."""
        ...


class Aux(NamedTuple):
    """The outputs of a training step in addition to its loss."""

    metrics: dict[str, Float[Array, ""]]
    """Values for the training curves, by name; NaN if undefined."""
    required: Int[Array, " k"] | None = None
    """The sizes that the step needed; None for a field without a capacity."""
    overflow: Bool[Array, ""] | None = None
    """Whether the capacity was too small; the step must then be discarded."""


Optimizer = Literal["adam", "muon"]


class Group(NamedTuple):
    """Optimiser settings of a group of parameters."""

    learning_rate: float
    optimizer: Optimizer = "adam"
    """"muon" uses Muon for matrices, with steps scaled to those of Adam, and Adam for everything else."""
    weight_decay: float = 0.0
    """Decoupled weight decay."""
    eps: float = 1e-15
    """Adam's epsilon."""


class Field(ABC):
    """A model. Subclasses are decorated with `pytree` and declare `config` as a static attribute. They must define `build`,
    `init`, `plan` and `render`; everything else has a default.

    A field composed of other fields lists them in `components`. Unless it overrides them, `prepare`, `capacity`, `ability` and
    `receiver_independent` then return the result of the first component that has one, and `param_groups`, `smoothed` and
    `inspect` combine those of all components. It always defines `init`, `plan`, `render` and `loss` itself.
    """

    name: ClassVar[str]
    """Name in command lines and files."""
    presets: ClassVar[Mapping[str, Settings]] = PRESETS
    """Settings by preset; `Settings.field` has the type of `config`."""
    seconds: ClassVar[Mapping[str, TrainingTime]] = {}
    """Training times on two cores of an AMD EPYC at 2 GHz, by preset (scenes 1 to 6)."""
    outputs: ClassVar[tuple[Output, ...]] = ("pas",)
    """Quantities that it predicts for a link; `outputs_of` returns those of a field whose scene lacks a component."""
    hooks: ClassVar[tuple[str, ...]] = ()
    """Hooks that training runs between epochs: names in `training.loop.HOOKS`, "component.name" for one that acts on a single
    component."""
    components: ClassVar[Mapping[str, type["Field"]]] = {}
    """Classes of the fields that it is composed of, by name. The field, its settings, parameters and plans have an attribute of
    that name for each; in the field, its parameters and plans it is None if the scene does not support the component."""
    config: Any
    """Settings: a frozen dataclass, which may have a method `check(name)` (`Checked`)."""

    @classmethod
    @abstractmethod
    def build(cls, config: Any, scene: Scene, seed: int) -> "Field":
        """Returns the field of a scene (host).

        Args:
            config: settings.
            scene: scene, with the receivers of the data.
            seed: seed of everything random in the field itself.
        """

    @abstractmethod
    def init(self, key: Key[Array, ""]) -> Params:
        """Returns initial parameters: trained values only, all of them floats."""

    @abstractmethod
    def plan(self, params: Params, receiver: Receiver, prepared: Any = None, capacity: Any = None) -> Any:
        """Returns everything that is independent of the query.

        A plan made outside a differentiated function is a constant there: parameters that enter through the plan receive no
        gradient, or only part of it. `pas` makes its plan inside.

        Args:
            params: parameters.
            receiver: one receiver.
            prepared: result of `prepare`, which the plan then carries; needed under jit by a field that plans on the host.
            capacity: static sizes; needed under jit by a field with a `capacity`.
        """

    @abstractmethod
    def render(self, params: Params, plan: Any, links: Query) -> Observation:
        """Returns the predicted observations of a plan's receiver on B links.

        Args:
            params: parameters.
            plan: result of `plan`.
            links: transmitter positions `tx_position` (b, 3) and frequencies `frequency_hz` (b,), which both classes have; a
                plan with prepared data requires `Links`.
        """

    def prepare(self, links: Links, receivers: Receiver) -> Any:
        """Returns everything about links that can be computed before training (host), a `Prepared`, or None if there is nothing
        to prepare.

        Args:
            links: links of the data.
            receivers: all receivers, with a leading axis.
        """
        found = (component.prepare(links, receivers) for component in components_of(self).values())
        return next((prepared for prepared in found if prepared is not None), None)

    def loss(
        self, params: Params, prepared: Any, batch: Batch, capacity: Any = None, probe: Any = None
    ) -> tuple[Float[Array, ""], Aux]:
        """Returns the loss of a batch. By default it compares spectra, or received power if the data contain nothing else.

        Args:
            params: parameters.
            prepared: result of `prepare`.
            batch: links of one receiver, with observations.
            capacity: static sizes.
            probe: zeros to be added at the place where a hook needs the gradient (`training.hooks.Hook.probe`), or None.
        """
        return compare(self.render(params, self.plan(params, batch.receiver, prepared, capacity), batch.links), batch)

    def capacity(self, params: Params, receivers: Receiver, required: Int[np.ndarray, " k"] | None = None) -> Any:
        """Returns the static sizes that planning needs under jit, with a margin (host): a `Capacity`, or None.

        Args:
            params: parameters.
            receivers: all receivers, with a leading axis.
            required: sizes needed by a step that overflowed (`Aux.required`), if any; the result then suffices for that step.
        """
        parts = components_of(self).items()
        found = (component.capacity(getattr(params, name), receivers, required) for name, component in parts)
        return next((capacity for capacity in found if capacity is not None), None)

    @classmethod
    def param_groups(cls, config: Any, params: Params | None = None) -> tuple[dict[str, Group], Any]:
        """Returns the optimiser's groups by name, and the group of every parameter: a tree of names with the structure of the
        parameters or a prefix of it; None without parameters. Groups of components are called "component.group"."""
        if not cls.components:
            return {"all": Group(1e-2)}, None if params is None else jax.tree.map(lambda _: "all", params)
        groups, labels = dict[str, Group](), {}
        for name, component in cls.components.items():
            own, names = component.param_groups(getattr(config, name), None if params is None else getattr(params, name))
            groups |= {f"{name}.{group}": value for group, value in own.items()}
            labels[name] = jax.tree.map(lambda group, name=name: f"{name}.{group}", names)
        return groups, None if params is None else replaced(params, **labels)

    def ability(self, kind: type[T]) -> "Ability[T] | None":
        """Returns the field itself, or its component, that is an instance of a class or of a protocol that can be checked at
        run time, such as `calibratable.Calibratable`; None if there is none."""
        if isinstance(self, kind):
            return Ability(self)
        found = ((name, component.ability(kind)) for name, component in components_of(self).items())
        return next((Ability(one.field, (name, *one.path)) for name, one in found if one is not None), None)

    def receiver_independent(self, params: Params) -> tuple["Field", Params]:
        """Returns the part of a trained field that is valid for receivers it was not trained with, and its parameters.

        Raises:
            UserError: the field has no such part.
        """
        for name, component in components_of(self).items():
            with contextlib.suppress(UserError):
                return component.receiver_independent(getattr(params, name))
        raise UserError(
            f"the {self.name} field predicts only the receivers that it was trained with; "
            "train --field wave or hybrid, on data with a mesh"
        )

    def smoothed(self, params: Params, metres: Float[Array, ""] | float) -> Params:
        """Returns parameters whose spectra and powers are means over transmitter positions, normally distributed about the
        queried one, which removes interference fringes that are finer. By default, for fields without fringes, the parameters
        are returned unchanged.

        Args:
            params: parameters.
            metres: standard deviation of the position along each axis.
        """
        parts = {name: component.smoothed(getattr(params, name), metres) for name, component in components_of(self).items()}
        return dataclasses.replace(params, **parts) if parts else params

    def inspect(self, params: Params, plan: Any = None, links: Query | None = None) -> Inspection:
        """Returns the contents of the field (host), including its Gaussians for B links if links and a plan are given."""
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
    """A part of a field with certain methods, and its location in parameters and plans."""

    field: T
    """The field itself, or a component."""
    path: tuple[str, ...] = ()
    """Names of the nested components, outermost first."""

    def of(self, tree: Any) -> Any:
        """Returns the part of the parameters, of a plan or of the field that belongs to it."""
        return functools.reduce(getattr, self.path, tree)

    def put(self, tree: Any, own: Any) -> Any:
        """Returns the tree with this part replaced."""
        if not self.path:
            return own
        name, *rest = self.path
        return replaced(tree, **{name: Ability(self.field, tuple(rest)).put(getattr(tree, name), own)})


@runtime_checkable
class Checked(Protocol):
    """Settings that can be validated."""

    def check(self, name: str) -> None:
        """Raises a `UserError` for invalid settings; the message names the option with the field's `name`."""
        ...


def check_config(name: str, config: Any) -> None:
    """Raises a `UserError` for invalid settings of the field of this name; no scene is needed."""
    if isinstance(config, Checked):
        config.check(name)


@runtime_checkable
class Noisy(Protocol):
    """A field that has estimated the noise floor of the spectra it was trained on, and predicts spectra without it."""

    def as_observed(self, params: Params, pas: Float[Array, "b 90 360"]) -> Float[Array, "b 90 360"]:
        """Returns predicted spectra with the noise floor of those data."""
        ...


def as_observed(field: Field, params: Params, pas: Float[Array, "b 90 360"]) -> Float[Array, "b 90 360"]:
    """Returns predicted spectra as they would appear in the data that the field was trained on: with the noise floor if it is
    `Noisy`, unchanged otherwise."""
    noisy = field.ability(Noisy)
    return pas if noisy is None else noisy.field.as_observed(noisy.of(params), pas)


@runtime_checkable
class Portable(Protocol):
    """A plan, or a part of one, that has a smaller form for files."""

    def portable(self) -> Any:
        """Returns it without the parts that are cheap to recompute from the parameters."""
        ...


def portable(plan: Any) -> Any:
    """Returns a plan in its form for files: without the parts that are cheap to recompute from the parameters."""

    def small(part: Any) -> Any:
        return part.portable() if isinstance(part, Portable) else part

    return jax.tree.map(small, plan, is_leaf=lambda part: isinstance(part, Portable))


def field_from_arrays(cls: type[Field], arrays: Mapping[str, Any], config: Any) -> Field:
    """Returns a field from its flattened arrays and its settings. A field with components has no further arrays of its own.

    Args:
        cls: class of the field.
        arrays: flattened arrays, `{".frame.centre": array, ...}`.
        config: settings.
    """
    if not cls.components:
        return from_leaves(cls, arrays, {"config": config})
    parts = dict[str, Field | None]()
    for name, component in cls.components.items():
        own = {key.removeprefix(f".{name}"): leaf for key, leaf in arrays.items() if key.startswith(f".{name}.")}
        parts[name] = field_from_arrays(component, own, getattr(config, name)) if own else None
    return cls(**parts, config=config)  # type: ignore[call-arg]


def paths_of(field: Field, params: Params, plan: Any, links: Query) -> Paths:
    """Returns all paths of B links, leading axis B, from a field whose `outputs` include "paths".

    Raises:
        ValueError: positions or frequencies are invalid.
        UserError: the field predicts no paths.
    """
    check_query(links)  # here: under `jit` there are no values to check
    return _paths_of(field, params, plan, links)


@jax.jit
def _paths_of(field: Field, params: Params, plan: Any, links: Query) -> Paths:
    paths = field.render(params, plan, links).paths
    if paths is None:
        raise UserError(f"the {field.name} field of this run predicts no paths; train the default one on data with a mesh")
    return paths


def components_of(field: Field) -> dict[str, Field]:
    """Returns the components of a field that its scene supports, by name."""
    found = {name: getattr(field, name) for name in field.components}
    return {name: component for name, component in found.items() if component is not None}


def outputs_of(field: Field) -> tuple[Output, ...]:
    """Returns the quantities that a field predicts for a link: the `outputs` of its class, without those that only missing
    components predict."""
    found = components_of(field)
    if len(found) == len(field.components):
        return field.outputs
    predicted = {output for component in found.values() for output in outputs_of(component)}
    return tuple(output for output in field.outputs if output in predicted)


def without_unreceived(batch: Batch, seen: Observation) -> Batch:
    """Returns a batch with its all-zero spectra (nothing received) replaced by the predicted ones, so that they add no loss."""
    if batch.pas is None:
        return batch
    black = jnp.max(batch.pas, (1, 2), keepdims=True) == 0
    spectra = jnp.where(black, jax.lax.stop_gradient(seen.pas), batch.pas)
    return batch.with_observations(**batch.observations | {"pas": spectra})


def compare(seen: Observation, batch: Batch, ssim_weight: float = 0.2, ssim_stride: int = 1) -> tuple[Float[Array, ""], Aux]:
    """Returns the loss of predictions on a batch: the image loss (paper, equation 5) if the batch has spectra, else the loss of
    its kind of observation (`LOSSES`), or that of received power if the kind has no loss or the field does not predict it.

    Args:
        seen: predictions.
        batch: links and observations.
        ssim_weight: lambda of equation 5.
        ssim_stride: stride of the SSIM windows along both axes.

    Raises:
        UserError: the field predicts nothing that can be compared with the observations.
    """
    if batch.pas is not None:
        loss, similarity = image_loss(seen.pas, batch.pas, ssim_weight, ssim_stride)
        return loss, Aux({"batch_ssim": similarity})
    kind = only_kind(batch.observations, "the batch")
    error = LOSSES[kind.name](seen, batch.observations[kind.name]) if kind.name in LOSSES else None
    if error is None:  # the received power that follows from the observations
        error = LOSSES["power_db"](seen, batch.received_db)
    if error is None:
        raise UserError(f"these data are {kind.words}, which this field does not predict; choose another field")
    return error, Aux({})


def power_error_db(seen: Observation, batch: Batch) -> Float[Array, ""] | None:
    """Returns the mean absolute error of received power (dB) over the links on which a signal was received; None if the field
    does not predict it or the batch does not contain it."""
    received = batch.received_db
    if seen.power_db is None or received is None:
        return None
    measured = received > NO_PATH_DB
    error, count = jnp.sum(jnp.abs(seen.power_db - received) * measured), jnp.sum(measured)
    return over_all_links(error) / jnp.maximum(over_all_links(count), 1)


def pas(field: Field, params: Params, receiver: Receiver, query: Query, capacity: Any = None) -> Float[Array, "b 90 360"]:
    """Returns the power angular spectra of B queries, as a differentiable function of parameters, receiver and query (reverse
    mode only).

    The plan is made inside, so that all gradients are complete. The wave field finds mirror images on the host: neither the
    field nor the receiver's position can be traced, and spectra have no gradient with respect to that position.

    Args:
        field: field.
        params: its parameters.
        receiver: one receiver.
        query: transmitter positions (metres) and frequencies (hertz).
        capacity: static sizes, which a field with a capacity needs under `jit` or `grad`, found on the host:
            `field.capacity(params, stack_receivers([receiver]))`. One that is too small gives NaN, never a wrong spectrum.

    Returns:
        Spectra (b, 90, 360), amplitudes with a maximum of 1.
    """
    plan, query = field.plan(params, receiver, None, capacity), jax.tree.map(jnp.asarray, query)
    check_query(query)  # here: under `jit` there are no values to check
    return _spectra(field, params, plan, query)


@jax.jit
def _spectra(field: Field, params: Params, plan: Any, query: Query) -> Float[Array, "b 90 360"]:
    """Returns the spectra of B queries; compiled, since outside of `jit` every operation would be dispatched by itself."""
    return field.render(params, plan, query).pas


_FIELDS: dict[str, type[Field]] = {}


def register(cls: type[Field]) -> type[Field]:
    """Registers a field by its name for command lines and run folders; usable as a decorator.

    Args:
        cls: the class, with `name` and `presets`.

    Returns:
        The class itself.
    """
    _FIELDS[cls.name] = cls
    return cls


def field_names() -> list[str]:
    """Returns the names of all registered fields.

    Returns:
        Names, for `get_field` and `--field`.
    """
    return list(_FIELDS)


def get_field(name: str) -> type[Field]:
    """Returns the class of a field by its name.

    Args:
        name: "hybrid", "wideband", "wave", "wrfgs", "nerf2", or that of a registered class.

    Returns:
        The class; its `presets` hold settings, and `build` makes a field of a scene.

    Raises:
        UserError: no field of this name is registered.

    Example:
        >>> get_field("nerf2").outputs
        ('pas',)
    """
    if name not in _FIELDS:
        raise UserError(f"unknown field {name!r}; choose one of: {', '.join(_FIELDS)}")
    return _FIELDS[name]


def default_field() -> str:
    """Returns the name of the field that is trained by default.

    Returns:
        A name, for `get_field`.
    """
    return "hybrid"


def with_field(
    presets: Mapping[str, Settings], configs: Mapping[str, Any], **sections: Mapping[str, Any]
) -> dict[str, Settings]:
    """Returns presets with the settings of a field inserted, and with other sections replaced where given; all mappings are by
    the name of the preset."""
    return {
        name: dataclasses.replace(base, field=configs[name], **{key: values[name] for key, values in sections.items()})
        for name, base in presets.items()
    }
