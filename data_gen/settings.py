"""Settings that determine the result of a solve, apart from the scene itself. Does not import the simulator."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from wbgs_jax.radio.array import SPEED_OF_LIGHT, planar_array
from wbgs_jax.types import ElementUnit

Solver = Literal["project", "simulator"]
OF_THE_PROJECT = ("rays_per_face", "rays_per_mirrored_face", "diffraction_probability")
"""Settings of the project's own path search, unused by the simulator's solver."""
OF_ROUGHNESS = ("scattering", "samples_diffuse")
"""Settings that are unused if all surfaces are smooth."""


@dataclass(frozen=True)
class SolverSettings:
    """Settings of Sionna RT's path solver. Line of sight, specular reflection and transmission are always on."""

    max_depth: int = 5
    """Maximum number of interactions of a path. Crossing a wall counts as one, crossing a piece of furniture as two."""
    samples_per_src: int = 200_000
    """Rays from every transmitter, uniform over the sphere (the dataset card shows the convergence)."""
    rays_per_face: int = 32
    """Rays aimed at every triangle of every solid ..."""
    rays_per_mirrored_face: int = 4
    """... and at its mirror image in every wall, floor and ceiling (`rays.py`)."""
    diffraction: bool = True
    """First-order diffraction at the edges of solids."""
    diffraction_probability: float = 0.7
    """Probability in the path search that a ray at an edge is diffracted rather than reflected or transmitted."""
    max_paths_per_src: int = 400_000
    """Capacity for candidate paths of one transmitter; a full buffer is an error, never a silent loss."""
    seed: int = 42
    """Seed of the aimed rays and of the solver's choice between reflection and transmission."""
    tx_per_call: int = 8
    """Transmitters traced together. This is part of the settings because random numbers depend on the position in a batch."""
    solver: Solver = "project"
    """project: the path search, materials and diffraction of this package. simulator: the path solver, materials and
    diffraction of Sionna RT itself (`public_solver.py`)."""
    scattering: tuple[float, float] = (0.0, 0.0)
    """Scattering coefficients, 0 to 1, of single sheets (walls, floor, ceiling) and of solids. A surface scatters this fraction
    of the reflected amplitude into all directions (Lambertian, without change of polarisation); 0 is smooth."""
    samples_diffuse: int = 10_000
    """Uniform rays from every transmitter that search for diffuse paths; the simulator's own solver has a single search."""

    @property
    def rough(self) -> bool:
        """Whether any surface scatters."""
        return max(self.scattering) > 0

    def record(self) -> dict[str, Any]:
        """Returns the settings that affect the result, by name; settings without effect are omitted, so that adding a setting
        does not change earlier records."""
        idle = {"solver"} if self.solver == "project" else {*OF_THE_PROJECT, "samples_diffuse"}
        if not self.rough:
            idle |= {*OF_ROUGHNESS}
        return {key: value for key, value in asdict(self).items() if key not in idle}


@dataclass(frozen=True)
class ArraySettings:
    """The receiver's array. The default is that of the published sample (shapes and phases: `wbgs_jax/radio/array.py`)."""

    rows: int = 4
    columns: int = 4
    spacing: float = 0.5
    """Distance between neighbouring elements, in `unit`."""
    unit: ElementUnit = "wavelengths"
    """wavelengths: the array scales with the frequency, half a wavelength stays half a wavelength. metres: it has a fixed size,
    like a real one, and its resolution changes with the frequency."""
    plane: Literal["yz", "xy", "xz"] = "yz"
    """Plane of the receiver's local frame that the elements lie in."""
    pattern: Literal["tr38901", "iso", "dipole", "hw_dipole"] = "tr38901"
    """Pattern of every element, with boresight along local +x for every plane: directional (3GPP TR 38.901), isotropic, short
    or half-wavelength dipole."""
    polarization: Literal["V", "H"] = "V"

    def named_pattern(self) -> str:
        """Returns the pattern as named in scene files, which applies to vertically polarised elements; empty for others, whose
        pattern fields have to calibrate."""
        return self.pattern if self.polarization == "V" else ""

    def element_positions(self) -> Float[np.ndarray, "elements 3"]:
        """Returns the local positions in `unit`, centred on the origin.

        In the y-z plane columns run along +y and rows down -z; in the x-y plane rows run along -x, in the x-z plane columns
        along +x instead.
        """
        x, y, z = planar_array(self.rows, self.columns, self.spacing).T
        return np.stack({"yz": (x, y, z), "xy": (z, y, x), "xz": (y, x, z)}[self.plane], -1)

    def element_wavelengths(self, frequency_hz: float) -> Float[np.ndarray, "elements 3"]:
        """Returns the local positions in wavelengths at a frequency."""
        positions = self.element_positions()
        return positions if self.unit == "wavelengths" else positions * (frequency_hz / SPEED_OF_LIGHT)
