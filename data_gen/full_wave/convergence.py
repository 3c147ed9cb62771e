"""Discretisation error of the field: one element is computed again with smaller cells."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Complex

from data_gen.full_wave.calibration import Solver
from data_gen.full_wave.elements import ElementResult, element_file, get_element, get_scale, sources
from data_gen.full_wave.model import Model

ELEMENT = 0


def convergence(solve: Solver, fine: Model, coarse_result: ElementResult, folder: Path) -> dict[str, Any]:
    """Returns the agreement of the first element's result with that on a finer grid, by frequency (`agreement`).

    Args:
        solve: the solver.
        fine: the same cabin with smaller cells.
        coarse_result: of the first element.
        folder: for the finer result.
    """
    scale = get_scale(solve, fine, folder)
    result = get_element(solve, fine, scale, sources()[ELEMENT], element_file(folder, ELEMENT))
    found = agreement(coarse_result.values, result.values)
    by_frequency = {f"{f / 1e9:g}": row for f, row in zip(fine.frequencies_hz, found, strict=True)}
    return {"cell_m": fine.cell, "element": ELEMENT, "decay_db": round(result.decay_db, 1), "by_frequency_ghz": by_frequency}


def agreement(first: Complex[np.ndarray, "tx freq"], second: Complex[np.ndarray, "tx freq"]) -> list[dict[str, float]]:
    """Returns the agreement of the fields at the transmitters for every frequency: the correlation |y^H y'| / (|y| |y'|), the
    norm of the difference relative to that of the second, and the medians of the level difference and its magnitude in dB."""
    rows = []
    for a, b in zip(first.T, second.T, strict=True):
        level = 20 * np.log10(np.abs(a) / np.abs(b))
        values = {
            "correlation": np.abs(np.vdot(a, b)) / (np.linalg.norm(a) * np.linalg.norm(b)),
            "relative_difference": np.linalg.norm(a - b) / np.linalg.norm(b),
            "median_level_db": np.median(level),
            "median_absolute_level_db": np.median(np.abs(level)),
        }
        rows.append({key: round(float(value), 4) for key, value in values.items()})
    return rows
