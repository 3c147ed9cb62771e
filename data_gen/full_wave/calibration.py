"""Conversion of the solver's fields to snapshots: the numerical wavelength, the short dipole in closed form, the scale of a
source.

An element of a snapshot is the voltage between two short vertical dipoles, scaled as everywhere in this project: in free space
and far away it is lambda / (4 pi d) exp(-j k d) times the amplitude gain sqrt(1.5) sin(zenith) of each. The time factor is
exp(+j omega t).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from data_gen.full_wave.model import Model, Solution
from data_gen.scenes.geometry import Vec3
from wbgs_jax.radio.array import SPEED_OF_LIGHT

DIRECTIONS = (24, 24)
"""Numbers of zenith and azimuth angles in one octant, over which the numerical wavelength is averaged."""
CALIBRATION_REACH = 0.45
"""Half the side of the free-space region in which a source is calibrated, metres."""
CALIBRATION_DURATION = 10e-9
"""Seconds: long enough for the pulse to leave the region."""

Solver = Callable[[Model, Vec3], Solution]
"""Computes the field of a vertical source at the points of a model, at the model's frequencies."""


def sampled_frequencies(model: Model) -> Float[np.ndarray, " freq"]:
    """Returns the frequencies (hertz) at which waves on the grid have the true wavelengths of the model's frequencies.

    Waves on a grid are slightly too slow, and hence too short, most along its axes and not at all along its diagonals.
    Interference depends on the wavelength in metres: averaged over directions (weighted like the radiation of a vertical
    dipole), it is correct at a frequency lower by a few thousandths.
    """
    return np.array([_matched(f, model.cell, model.time_step) for f in model.frequencies_hz])


def _matched(frequency_hz: float, cell: float, time_step: float) -> float:
    wave_number = 2 * np.pi * frequency_hz / SPEED_OF_LIGHT
    frequencies, weights = _grid_frequencies(wave_number, cell, time_step)
    return float(np.average(frequencies, weights=weights))


def _grid_frequencies(
    wave_number: float, cell: float, time_step: float
) -> tuple[Float[np.ndarray, " directions"], Float[np.ndarray, " directions"]]:
    """Returns the frequencies of plane waves of one wavelength on the grid in many directions, and their weights."""
    zenith, azimuth = np.meshgrid(*((np.arange(n) + 0.5) * np.pi / (2 * n) for n in DIRECTIONS), indexing="ij")
    k = wave_number * np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])
    sine = SPEED_OF_LIGHT * time_step / cell * np.sqrt((np.sin(k * cell / 2) ** 2).sum(0))
    return (np.arcsin(sine) / (np.pi * time_step)).reshape(-1), (np.sin(zenith) ** 3).reshape(-1)


def dipole_field(offset: Float[np.ndarray, "*n 3"], frequency_hz: Float[np.ndarray, " freq"]) -> Complex[np.ndarray, "*n freq"]:
    """Returns the snapshot's value between two short vertical dipoles in free space, near field included.

    It is lambda / (4 pi d) exp(-j k d) times 1.5 (sin^2 + (1 - 3 cos^2) (n + n^2)) with n = 1 / (j k d), sine and cosine those
    of the zenith of the line between the two.

    Args:
        offset: from one dipole to the other, metres.
        frequency_hz: true frequencies.
    """
    d = np.linalg.norm(offset, axis=-1)[..., None]
    square = (offset[..., 2:] / d) ** 2
    k = 2 * np.pi * frequency_hz / SPEED_OF_LIGHT
    near = 1 / (1j * k * d)
    shape = 1 - square + (1 - 3 * square) * (near + near**2)
    return 1.5 * shape * np.exp(-1j * k * d) / (2 * k * d)


def calibration_model(cell: float, frequencies_hz: tuple[float, ...]) -> Model:
    """Returns free space around a source at the origin, with points 0.3 to 0.42 m away, none of them near its axis."""
    step = 0.06
    axis = np.round(np.arange(-7, 8) * step, 6)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    far = np.linalg.norm(grid, axis=1)
    keep = (far >= 0.3 - 1e-9) & (far <= 0.42 + 1e-9) & (np.abs(grid[:, 2]) < 0.5 * far)
    reach = CALIBRATION_REACH
    return Model(
        blocks=(), low=(-reach,) * 3, high=(reach,) * 3, cell=cell, points=grid[keep][::5], frequencies_hz=frequencies_hz,
        duration=CALIBRATION_DURATION,
    )  # fmt: skip


class Scale(NamedTuple):
    """Conversion factor from the solver's fields to snapshots."""

    factor: Complex[np.ndarray, " freq"]
    error: Float[np.ndarray, " freq"]
    """Relative r.m.s. error of the scaled free-space field with respect to the closed form."""


def calibrate(solve: Solver, cell: float, frequencies_hz: tuple[float, ...]) -> Scale:
    """Computes the source in free space and returns the scale that best fits its field to the closed form."""
    model = calibration_model(cell, frequencies_hz)
    field = solve(model, (0.0, 0.0, 0.0)).field
    truth = dipole_field(model.points, np.asarray(frequencies_hz))
    factor = (field.conj() * truth).sum(0) / (np.abs(field) ** 2).sum(0)
    error = np.linalg.norm(field * factor - truth, axis=0) / np.linalg.norm(truth, axis=0)
    return Scale(factor, error)
