"""Interface of fields that trace paths between the surfaces of a mesh and can be calibrated: surfaces are displaced or removed,
materials and gains of array elements are changed.

`training.calibration` uses a field through this interface only. It changes the field (positions of surfaces, absent bodies,
array gains) or its parameters (`WaveParams`); both are returned as new objects.
"""

from abc import abstractmethod
from typing import Any

import numpy as np
from jaxtyping import Array, Complex, Float, Int, Key

from wbgs_jax.fields.base import Field, MaterialProperties, Params
from wbgs_jax.fields.coherent_model import PreparedPaths, WaveConfig, WaveParams, WavePlan, element_gains
from wbgs_jax.mesh.facets import AnyArray, Facets
from wbgs_jax.propagation.displacement import Motion
from wbgs_jax.types import Links, Receiver


class Calibratable(Field):
    """Base class of fields that trace paths."""

    facets: Facets
    """Surfaces, each with the index of its material and of its rigid body (`Facets.mover`)."""
    known_thickness: Float[Array, " m"]
    """Thickness of every material, metres; 0 if the scene does not define it, in which case it is learned."""
    motion: Motion
    """Estimated displacements of rigid bodies and receivers from their nominal positions; the facets are already displaced."""
    tuning: Float[Array, "r elements 2"] | None
    """Array gains: logarithm of amplitude, and phase (radians), of the elements of all receivers relative to ideal elements;
    None for ideal elements."""
    first_clutter: Float[Array, "x y z 2"] | None
    """Initial `WaveParams.clutter`; None if the field has no absorption grid."""
    config: WaveConfig

    @abstractmethod
    def init(self, key: Key[Array, ""]) -> WaveParams:
        """Returns initial parameters."""

    @abstractmethod
    def plan(
        self, params: WaveParams | None, receiver: Receiver, prepared: PreparedPaths | None = None, capacity: None = None
    ) -> WavePlan:
        """Returns everything that is independent of the query: geometry only, no parameters."""

    @abstractmethod
    def prepare(self, links: Links, receivers: Receiver) -> PreparedPaths:
        """Returns the paths between the transmitters and receivers of links (host)."""

    @abstractmethod
    def displaced(self, plan: WavePlan, motion: Motion) -> WavePlan:
        """Returns a plan whose surfaces and receiver are displaced, to first order, from where its paths were traced.

        Args:
            plan: plan of one receiver.
            motion: displacements; those of receivers are of the plan's receiver only.
        """

    @abstractmethod
    def moved(self, motion: Motion) -> "Calibratable":
        """Returns the field with surfaces and receivers displaced further (host)."""

    @abstractmethod
    def without(self, rigid_bodies: Int[np.ndarray, " k"]) -> "Calibratable":
        """Returns the field without some rigid bodies, given by their indices (host)."""

    @abstractmethod
    def with_body(self, params: WaveParams, body: Facets, material: MaterialProperties) -> tuple["Calibratable", WaveParams]:
        """Returns the field and parameters with one more rigid body, the last one, of a material of its own (host)."""

    @abstractmethod
    def plan_movement(self, receiver: Receiver, tx_position: Float[AnyArray, "t 3"], motion: Motion) -> WavePlan:
        """Returns a plan for all instants of a movement, (t, m, 3) and (t, 3), of surfaces and receiver, and of a transmitter,
        for `coherent_model.moved_plan` (host)."""

    @abstractmethod
    def in_common_shapes(self, prepared: PreparedPaths, elements: int) -> tuple["Calibratable", PreparedPaths]:
        """Returns a field and paths that render as before, but share programs with those of a similar field: with a few bodies
        fewer, a material for every body, or array gains (host). Without prepared paths the field cannot be used.

        Args:
            prepared: paths of the field.
            elements: number of elements of a receiver.
        """

    @abstractmethod
    def params_in_common_shapes(self, params: WaveParams) -> WaveParams:
        """Returns parameters, whose leaves may have a leading axis, for `in_common_shapes` (host)."""

    @abstractmethod
    def with_gains(self, gains: Complex[np.ndarray, "r elements"]) -> "Calibratable":
        """Returns the field with the array gains of its receivers multiplied by these complex gains."""

    @abstractmethod
    def with_absorption(self) -> "Calibratable":
        """Returns the field with an absorption grid around its surfaces and receivers, which is nearly transparent at first
        (host)."""

    @abstractmethod
    def with_material(self, params: WaveParams, material: int, permittivity: float, conductivity: float) -> WaveParams:
        """Returns parameters with another relative permittivity (above 1) and conductivity (at 1 GHz, S/m) of one material
        (host)."""

    @abstractmethod
    def with_thickness(self, plan: WavePlan, material: int, metres: float) -> tuple["Calibratable", WavePlan]:
        """Returns the field and a plan with the thickness of one material fixed, in metres (host)."""

    @abstractmethod
    def material_properties(self, params: WaveParams) -> MaterialProperties:
        """Returns the learned properties of the materials (host)."""

    @abstractmethod
    def with_isotropic_elements(self, params: WaveParams) -> WaveParams:
        """Returns parameters without the calibrated pattern of the data's receivers, for other antennas that receive."""

    @abstractmethod
    def penalty(self, params: WaveParams) -> Float[Array, ""]:
        """Returns the regularisation of its loss, which depends on the parameters only."""


def gains_in(field: Field, plan: Any) -> Complex[Array, " elements"] | float:
    """Returns the complex gains of a receiver's calibrated elements from a field's plan; 1 for ideal elements."""
    own = field.ability(Calibratable)
    stored = None if own is None else own.of(plan).array_gains
    return 1.0 if stored is None else element_gains(stored)


def at_isotropic_antennas(field: Field, params: Params) -> tuple[Field, Params]:
    """Returns the receiver-independent part of a field, and its parameters for isotropic antennas that receive anywhere: those
    without the calibrated pattern of the data's receivers.

    Raises:
        UserError: the field predicts only the receivers that it was trained with.
    """
    field, params = field.receiver_independent(params)
    return field, field.with_isotropic_elements(params) if isinstance(field, Calibratable) else params
