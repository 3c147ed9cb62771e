"""What decides the result of a solve, apart from the scene itself. Imports no simulator."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from wbgs_jax.radio.array import SPEED_OF_LIGHT, planar_array
from wbgs_jax.types import ElementUnit

Solver = Literal["project", "simulator"]
OF_THE_PROJECT = ("rays_per_face", "rays_per_mirrored_face", "diffraction_probability")
"""Settings of the project's own search, which mean nothing to the simulator's own solver."""
OF_ROUGHNESS = ("scattering", "samples_diffuse")
"""Settings that mean nothing while all surfaces are smooth."""


@dataclass(frozen=True)
class SolverSettings:
    """Settings of Sionna RT's path solver. Line of sight, specular reflection and transmission are always on."""

    max_depth: int = 5
    """Interactions a path may have. Passing through a wall is one, through a piece of furniture two."""
    samples_per_src: int = 200_000
    """Rays from every transmitter, even over the sphere (the dataset card has the convergence)."""
    rays_per_face: int = 32
    """Rays aimed at every triangle of every solid ..."""
    rays_per_mirrored_face: int = 4
    """... and at its mirror image in every wall, floor and ceiling (`rays.py`)."""
    diffraction: bool = True
    """First-order diffraction at the edges of solids."""
    diffraction_probability: float = 0.7
    """Of the search: how often a ray that meets an edge is diffracted rather than reflected or transmitted."""
    max_paths_per_src: int = 400_000
    """Room for candidate paths of one transmitter; a full buffer is an error, never a silent loss."""
    seed: int = 42
    """Of the aimed rays and of the solver's choice between reflection and transmission."""
    tx_per_call: int = 8
    """Transmitters traced together. It belongs to the settings: random numbers depend on the place in a batch."""
    solver: Solver = "project"
    """project: the search, materials and diffraction of this folder. simulator: the path solver, materials and diffraction
    that Sionna RT comes with (`public_solver.py`)."""
    scattering: tuple[float, float] = (0.0, 0.0)
    """Scattering coefficients, 0 to 1, of single sheets (walls, floor, ceiling) and of solids. A surface sends this share of
    the reflected amplitude into all directions (Lambertian, no change of polarisation); 0 is smooth."""
    samples_diffuse: int = 10_000
    """Evenly spread rays from every transmitter that search for diffuse paths; the simulator's own solver has one search."""

    @property
    def rough(self) -> bool:
        """Whether some surface scatters."""
        return max(self.scattering) > 0

    def record(self) -> dict[str, Any]:
        """Returns what decides a result, by name: what has no effect is left out, as if it had never been a setting."""
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
    """Between neighbouring elements, in `unit`."""
    unit: ElementUnit = "wavelengths"
    """wavelengths: the array follows the frequency, half a wavelength stays half a wavelength. metres: it has a fixed size, as
    a real one, and what it resolves changes with the frequency."""
    plane: Literal["yz", "xy", "xz"] = "yz"
    """Plane of the receiver's local frame that the elements lie in."""
    pattern: Literal["tr38901", "iso", "dipole", "hw_dipole"] = "tr38901"
    """Of every element, boresight along local +x whatever the plane: directional (3GPP TR 38.901), isotropic, short or
    half-wavelength dipole."""
    polarization: Literal["V", "H"] = "V"

    def named_pattern(self) -> str:
        """Returns the pattern as scene files name it, which is that of vertical elements; of others they say nothing, and
        fields look for what explains the spectra."""
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
