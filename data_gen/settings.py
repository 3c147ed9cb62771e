"""What decides the result of a solve, apart from the scene itself. Imports no simulator."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SolverSettings:
    """Settings of Sionna RT's path solver. Line of sight, specular reflection and transmission are always on."""

    max_depth: int = 4
    """Interactions a path may have."""
    samples_per_src: int = 400_000
    """Rays that search for paths, for every transmitter (see README.md for the convergence)."""
    diffraction: bool = True
    """First-order diffraction at the edges of furniture."""
    max_paths_per_src: int = 60_000
    """Room for candidate paths of one transmitter; a full buffer is an error, never a silent loss."""
    seed: int = 42
    """Of the solver's choice between reflection and transmission."""
    tx_per_call: int = 16
    """Transmitters traced together. It belongs to the settings: random numbers depend on the place in a batch."""
