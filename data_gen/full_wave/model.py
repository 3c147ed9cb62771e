"""Input and output of the solver: blocks on a grid of cubic cells, a short vertical source, the field at points and
frequencies."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from data_gen.full_wave.cabin import AIR, METAL, Block
from data_gen.scenes.geometry import Vec3
from wbgs_jax.radio.array import SPEED_OF_LIGHT

PML_CELLS = 8
"""Thickness of the absorbing layer around the region, in cells."""
MARGIN = 0.03
"""Metres of air between the cabin and the absorbing layer."""
REFERENCE_HZ = 1.25e9
"""Frequency at which a conductivity is that of ITU-R P.2040; on the grid it is constant over frequency."""


class Medium(NamedTuple):
    """Medium of a block: relative permittivity, and conductivity c f^d in S/m with f in GHz (ITU-R P.2040-3, table 3)."""

    permittivity: float
    c: float
    d: float

    def conductivity(self, frequency_hz: float = REFERENCE_HZ) -> float:
        """Returns the conductivity in S/m."""
        return self.c * (frequency_hz / 1e9) ** self.d


MEDIA = {
    AIR: Medium(1.0, 0.0, 0.0),
    "plasterboard": Medium(2.73, 0.0085, 0.9395),
    "wood": Medium(1.99, 0.0047, 1.0718),
    "chipboard": Medium(2.58, 0.0217, 0.7800),
}
"""Media by name; `METAL` is a perfect conductor and has no entry."""


@dataclass(frozen=True)
class Model:
    """One room for the solver. Blocks, points and source have their corners on nodes, which are multiples of the cell."""

    blocks: tuple[Block, ...]
    low: Vec3
    high: Vec3
    """Corners (metres) of the region inside the absorbing layer."""
    cell: float
    """Metres."""
    points: Float[np.ndarray, "n 3"]
    """Points at which the vertical field is recorded, world frame, metres."""
    frequencies_hz: tuple[float, ...]
    duration: float
    """Seconds."""

    @property
    def time_step(self) -> float:
        """Time step in seconds, the longest one that is stable on cubic cells."""
        return self.cell / (SPEED_OF_LIGHT * math.sqrt(3))

    @property
    def steps(self) -> int:
        """Number of time steps."""
        return math.ceil(self.duration / self.time_step)

    def lines(self) -> tuple[list[float], list[float], list[float]]:
        """Returns the grid's nodes along x, y and z in metres, including those of the absorbing layer."""
        x, y, z = (self._axis(a, b) for a, b in zip(self.low, self.high, strict=True))
        return x, y, z

    def _axis(self, low: float, high: float) -> list[float]:
        first = math.floor(low / self.cell + 1e-6) - PML_CELLS
        last = math.ceil(high / self.cell - 1e-6) + PML_CELLS
        return [round(i * self.cell, 6) for i in range(first, last + 1)]

    @property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(len(axis) - 1 for axis in self.lines())

    def off_nodes(self, corners: Sequence[Vec3]) -> float:
        """Returns the largest distance (in cells) of coordinates from the nearest node."""
        scaled = np.asarray(corners, np.float64).reshape(-1) / self.cell
        return float(np.abs(scaled - np.round(scaled)).max(initial=0.0))


class Solution(NamedTuple):
    """Result of one run."""

    field: Complex[np.ndarray, "n freq"]
    """Vertical electric field at the points, in the solver's own units and phase: time factor exp(+j omega t)."""
    decay_db: float
    """Level of the recorded pulses at the end relative to their maximum, dB."""
    time_step: float
    """Time step in seconds, as chosen by the solver."""
    seconds: float
    """Computing time of the time steps, seconds."""


def fills(blocks: Sequence[Block], points: Float[np.ndarray, "n 3"]) -> list[str]:
    """Returns the material at every point (metres), air outside all blocks."""
    found = [AIR] * len(points)
    for block in blocks:
        inside = np.all((points > np.asarray(block.low)) & (points < np.asarray(block.high)), axis=1)
        for i in np.flatnonzero(inside):
            found[i] = block.material
    return found


def coarsest(model: Model) -> float:
    """Returns the number of cells per shortest wavelength in the densest material of the model."""
    names = {block.material for block in model.blocks} - {METAL}
    densest = max((MEDIA[name].permittivity for name in names), default=1.0)
    return SPEED_OF_LIGHT / max(model.frequencies_hz) / math.sqrt(densest) / model.cell
