"""From the solver's fields to snapshots: the numerical wavelength, the short dipole in closed form, the scale of a source.

A snapshot's element is the voltage between two short vertical dipoles, scaled as everywhere in this project: in free space and
far away it is lambda / (4 pi d) exp(-j k d) times the amplitude gain sqrt(1.5) sin(zenith) of each. The time factor is
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
"""Zeniths and azimuths in one octant, over which the numerical wavelength is averaged."""
CALIBRATION_REACH = 0.45
"""Half the side in metres of the free space that a source is calibrated in."""
CALIBRATION_DURATION = 10e-9
"""Seconds: the pulse and its way out."""

Solver = Callable[[Model, Vec3], Solution]
"""Computes the field of a vertical source at some place at the points of a model, at the model's frequencies."""


def sampled_frequencies(model: Model) -> Float[np.ndarray, " freq"]:
    """Returns the frequencies (hertz) at which waves on the grid are as long as true ones are at the model's frequencies.

    Waves on a grid are a little too slow, and so too short, most along its axes and not at all along its diagonals. What counts
    for interference is their length in metres: in the mean over directions (weighted as a vertical dipole radiates) it is right
    at a frequency a few thousandths lower.
    """
    return np.array([_matched(f, model.cell, model.time_step) for f in model.frequencies_hz])


def _matched(frequency_hz: float, cell: float, time_step: float) -> float:
    wave_number = 2 * np.pi * frequency_hz / SPEED_OF_LIGHT
    frequencies, weights = _grid_frequencies(wave_number, cell, time_step)
    return float(np.average(frequencies, weights=weights))


def _grid_frequencies(
    wave_number: float, cell: float, time_step: float
) -> tuple[Float[np.ndarray, " directions"], Float[np.ndarray, " directions"]]:
    """Returns the frequencies of plane waves of one length on the grid in many directions, and the weights of these."""
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
    """What turns the solver's fields into snapshots."""

    factor: Complex[np.ndarray, " freq"]
    error: Float[np.ndarray, " freq"]
    """Of the scaled field in free space against the closed form: root mean square, relative."""


def calibrate(solve: Solver, cell: float, frequencies_hz: tuple[float, ...]) -> Scale:
    """Runs the source in free space and returns the scale that fits its field best to the closed form."""
    model = calibration_model(cell, frequencies_hz)
    field = solve(model, (0.0, 0.0, 0.0)).field
    truth = dipole_field(model.points, np.asarray(frequencies_hz))
    factor = (field.conj() * truth).sum(0) / (np.abs(field) ** 2).sum(0)
    error = np.linalg.norm(field * factor - truth, axis=0) / np.linalg.norm(truth, axis=0)
    return Scale(factor, error)
