"""Fields that trace rays in the surfaces of a mesh, and can be calibrated: surfaces moved or left out, materials named, arrays
tuned.

`training.calibration` knows a field as this alone. What it changes is the field (where surfaces stand, what is absent, gains of
array elements) or its parameters (`WaveParams`); both come back as new objects.
"""

from abc import abstractmethod

import numpy as np
from jaxtyping import Array, Complex, Float, Int, Key

from wbgs_jax.fields.base import Field, MaterialProperties
from wbgs_jax.fields.coherent_model import PreparedPaths, WaveParams, WavePlan
from wbgs_jax.fields.coherent_settings import WaveConfig
from wbgs_jax.mesh.facets import Facets
from wbgs_jax.propagation.displacement import Motion
from wbgs_jax.types import Links, Receiver


class Calibratable(Field):
    """A field of rays; a base class of those that are."""

    facets: Facets
    """Surfaces, each of a material and of a mover: a rigid body."""
    known_thickness: Float[Array, " m"]
    """Thickness of every material, metres; 0 where it is not known, and learned."""
    motion: Motion
    """How far movers and receivers stand from where the data say, as far as that has been found out; the facets are there
    already."""
    tuning: Float[Array, "r elements 2"] | None
    """Logarithm of amplitude, and phase (radians), by which elements of the receivers' arrays differ from what their positions
    say; None: they are in tune."""
    first_clutter: Float[Array, "x y z 2"] | None
    """`WaveParams.clutter` before training; None: the field has no absorption grid."""
    config: WaveConfig

    @abstractmethod
    def init(self, key: Key[Array, ""]) -> WaveParams:
        """Returns initial parameters."""

    @abstractmethod
    def plan(
        self, params: WaveParams | None, receiver: Receiver, prepared: PreparedPaths | None = None, capacity: None = None
    ) -> WavePlan:
        """Returns what is independent of the query: geometry alone, no parameters."""

    @abstractmethod
    def prepare(self, links: Links, receivers: Receiver) -> PreparedPaths:
        """Returns the paths of all receivers and transmitters of some links (host)."""

    @abstractmethod
    def displaced(self, plan: WavePlan, motion: Motion) -> WavePlan:
        """Returns a plan in which things stand elsewhere, to first order, than where its paths were found; the motion has the
        shift and the turn of the plan's receiver alone."""

    @abstractmethod
    def moved(self, motion: Motion) -> "Calibratable":
        """Returns the field of a scene in which things stand elsewhere (host)."""

    @abstractmethod
    def without(self, movers: Int[np.ndarray, " k"]) -> "Calibratable":
        """Returns the field of a scene in which some movers are not there (host)."""

    @abstractmethod
    def with_gains(self, gains: Complex[np.ndarray, "r elements"]) -> "Calibratable":
        """Returns the field of receivers whose elements have these complex gains beside those that they have by now."""

    @abstractmethod
    def with_absorption(self) -> "Calibratable":
        """Returns the field that knows of clutter: none of it yet, anywhere around its surfaces and receivers (host)."""

    @abstractmethod
    def with_material(self, params: WaveParams, material: int, permittivity: float, conductivity: float) -> WaveParams:
        """Returns parameters in which one material has another relative permittivity (above 1) and conductivity at 1 GHz, S/m
        (host)."""

    @abstractmethod
    def with_thickness(self, plan: WavePlan, material: int, metres: float) -> tuple["Calibratable", WavePlan]:
        """Returns the field and a plan in which all walls of one material are this thick, whatever data say (host)."""

    @abstractmethod
    def material_properties(self, params: WaveParams) -> MaterialProperties:
        """Returns the properties of the materials, as far as they were learned (host)."""

    @abstractmethod
    def penalty(self, params: WaveParams) -> Float[Array, ""]:
        """Returns what its loss adds for parameters that stray from physics, whatever data say."""
