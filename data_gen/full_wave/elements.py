"""The long-running part: one run per element of the array, each stored as soon as it is done.

By reciprocity, the voltage at an element due to a current at a transmitter equals that at the transmitter due to the same
current at the element: 16 runs serve all transmitters. An element's result is a file, written atomically, in a folder whose
name contains a checksum of everything that determines it, so that a run finds the results of earlier ones with the same
settings.
"""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex

from data_gen.full_wave.cabin import FREQUENCIES_HZ, RX_POSITION, cabin_blocks, cabin_bounds, cabin_spec, element_positions
from data_gen.full_wave.calibration import CALIBRATION_DURATION, Scale, Solver, calibrate
from data_gen.full_wave.model import MARGIN, MEDIA, PML_CELLS, REFERENCE_HZ, Model
from data_gen.scenes.geometry import Vec3
from wbgs_jax._util.cli import say
from wbgs_jax._util.files import atomic_write


class ElementResult(NamedTuple):
    """Result of one element for all transmitters."""

    values: Complex[np.ndarray, "tx freq"]
    decay_db: float
    seconds: float


def cabin_model(cell: float, duration: float) -> Model:
    """Returns the solver's model of the cabin, with a point at every transmitter."""
    low, high = cabin_bounds()
    return Model(
        blocks=tuple(cabin_blocks()), low=_out(low, -MARGIN), high=_out(high, MARGIN), cell=cell,
        points=cabin_spec().tx_grid, frequencies_hz=FREQUENCIES_HZ, duration=duration,
    )  # fmt: skip


def sources(rx_position: Vec3 = RX_POSITION) -> list[Vec3]:
    """Returns the positions of the elements in the world frame, metres; the array is not rotated."""
    places = np.round(element_positions() + np.asarray(rx_position), 6)
    return [(x, y, z) for x, y, z in places.tolist()]


def digest(model: Model, solver: str) -> str:
    """Returns a checksum of the model, its discretisation and the solver's version."""
    decides = {
        "blocks": model.blocks, "low": model.low, "high": model.high, "cell": model.cell, "points": model.points.tolist(),
        "frequencies": model.frequencies_hz, "duration": model.duration, "media": MEDIA, "reference": REFERENCE_HZ,
        "pml": PML_CELLS, "calibration": CALIBRATION_DURATION, "solver": solver,
    }  # fmt: skip
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:16]


def get_scale(solve: Solver, model: Model, folder: Path) -> Scale:
    """Returns the scale of the source, from its file or from a run in free space."""
    file = folder / "scale.npz"
    if not file.exists():
        scale = calibrate(solve, model.cell, model.frequencies_hz)
        with atomic_write(file) as stream:
            np.savez(stream, **scale._asdict())
    with np.load(file) as archive:
        return Scale(archive["factor"], archive["error"])


def get_element(solve: Solver, model: Model, scale: Scale, source: Vec3, file: Path) -> ElementResult:
    """Returns the result of an element at `source` (metres), from its file or from a run."""
    if not file.exists():
        solution = solve(model, source)
        say(f"{file.stem}: decayed to {solution.decay_db:.1f} dB, {solution.seconds:.0f} s")
        with atomic_write(file) as stream:
            np.savez(stream, values=solution.field * scale.factor, decay_db=solution.decay_db, seconds=solution.seconds)
    with np.load(file) as archive:
        return ElementResult(archive["values"], float(archive["decay_db"]), float(archive["seconds"]))


def element_file(folder: Path, element: int) -> Path:
    """Returns the path of the result of an element."""
    return folder / f"element{element:02d}.npz"


def snapshots_of(results: Sequence[ElementResult]) -> Complex[np.ndarray, "tx 1 freq elements"]:
    """Returns the array's snapshots of all transmitters (complex64) from the results of its elements, in order."""
    return np.stack([result.values for result in results], -1)[:, None].astype(np.complex64)


def _out(corner: Vec3, by: float) -> Vec3:
    x, y, z = (round(value + by, 6) for value in corner)
    return x, y, z
